"""Slots of a custom factor: a variable of the graph, a fixed value, or a known pose with a correction.

A held stop, a calibrated mount or a known radius is then simply not a variable: it stays bit for
bit what it was, and costs the solver nothing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from pancam_graph.geometry import FloatArray, corrected_poses, correction_twists

__all__ = ["Corrected", "Fixed", "Key", "PoseSlot", "Slot", "custom_factor"]


@dataclass(frozen=True)
class Key:
    """A slot that the graph estimates."""

    key: int


@dataclass(frozen=True)
class Fixed:
    """A slot with a value that nothing changes."""

    value: Any


@dataclass(frozen=True)
class Corrected:
    """A pose slot of which the graph estimates a correction (geometry.corrected_poses): a vector variable."""

    key: int
    nominal: gtsam.Pose3
    free: tuple[int, ...]
    """Entries of the correction (6) that the variable has; the others are 0."""

    def pose(self, values: gtsam.Values) -> tuple[gtsam.Pose3, FloatArray]:
        """The pose at the values, and its body-frame twist by the variable (6, n)."""
        correction, free = np.zeros(6), list(self.free)
        correction[free] = values.atVector(self.key)
        nominal = self.nominal.rotation().matrix(), self.nominal.translation()
        rotation, translation = corrected_poses(*nominal, correction)
        return gtsam.Pose3(gtsam.Rot3(rotation), translation), correction_twists(correction)[:, free]


Slot = Key | Fixed
PoseSlot = Key | Fixed | Corrected

Residual = Callable[..., tuple[FloatArray, tuple[FloatArray, ...]]]
"""Takes one value per slot, returns the residual (m,) and one Jacobian (m, tangent) per slot."""


def custom_factor(
    noise: gtsam.noiseModel.Base,
    slots: Sequence[tuple[PoseSlot, Callable[[gtsam.Values, int], Any]]],
    residual: Residual,
) -> gtsam.CustomFactor:
    """A GTSAM factor from a pure residual, over those of its slots that are variables.

    `slots` pairs each slot with the reader of its value from gtsam.Values, which a corrected pose does not
    need. An exception in the residual reaches the caller of the optimiser with its own type and message.
    """
    variable = [(i, slot.key) for i, (slot, _) in enumerate(slots) if not isinstance(slot, Fixed)]

    def evaluate(
        _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        arguments: list[Any] = []
        twists: dict[int, FloatArray] = {}
        for i, (slot, read) in enumerate(slots):
            if isinstance(slot, Corrected):
                pose, twists[i] = slot.pose(values)
                arguments.append(pose)
            else:
                arguments.append(read(values, slot.key) if isinstance(slot, Key) else slot.value)
        error, derivatives = residual(*arguments)
        if jacobians is not None:
            for j, (i, _) in enumerate(variable):
                derivative = derivatives[i] @ twists[i] if i in twists else derivatives[i]
                jacobians[j] = np.asfortranarray(derivative)
        return error

    return gtsam.CustomFactor(noise, [key for _, key in variable], evaluate)
