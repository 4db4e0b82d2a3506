"""Slots of a custom factor: each is a variable of the graph, given by its key, or a fixed value.

A held stop, a calibrated mount or a known radius is then simply not a variable: it stays bit for
bit what it was, and costs the solver nothing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from pancam_graph.geometry import FloatArray

__all__ = ["Fixed", "Key", "Slot", "custom_factor"]


@dataclass(frozen=True)
class Key:
    """A slot that the graph estimates."""

    key: int


@dataclass(frozen=True)
class Fixed:
    """A slot with a value that nothing changes."""

    value: Any


Slot = Key | Fixed

Residual = Callable[..., tuple[FloatArray, tuple[FloatArray, ...]]]
"""Takes one value per slot, returns the residual (m,) and one Jacobian (m, tangent) per slot."""


def custom_factor(
    noise: gtsam.noiseModel.Base,
    slots: Sequence[tuple[Slot, Callable[[gtsam.Values, int], Any]]],
    residual: Residual,
) -> gtsam.CustomFactor:
    """A GTSAM factor from a pure residual, over those of its slots that are variables.

    `slots` pairs each slot with the reader of its value from gtsam.Values. An exception in the
    residual reaches the caller of the optimiser with its own type and message.
    """
    variable = [(i, slot.key) for i, (slot, _) in enumerate(slots) if isinstance(slot, Key)]

    def evaluate(
        _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        arguments = [read(values, slot.key) if isinstance(slot, Key) else slot.value for slot, read in slots]
        error, derivatives = residual(*arguments)
        if jacobians is not None:
            for j, (i, _) in enumerate(variable):
                jacobians[j] = np.asfortranarray(derivatives[i])
        return error

    return gtsam.CustomFactor(noise, [key for _, key in variable], evaluate)
