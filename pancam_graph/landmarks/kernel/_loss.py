"""Robust losses of whitened residuals, which compiled code tells by numbers."""

import math

from pancam_graph.base.compiled import part
from pancam_graph.base.geometry import FloatArray
from pancam_graph.landmarks.kernel._compiling import entry

__all__ = ["BEHIND_COST", "CAUCHY", "HUBER", "NONE", "loss_cost", "loss_costs", "loss_weight", "loss_weights"]

NONE, HUBER, CAUCHY = 0, 1, 2
"""The numbers of the losses."""

BEHIND_COST = 0.5 * 1000.0**2
"""Cost of an observation whose landmark is behind its camera: that of a residual of 1000 sigma.

Its gradient is taken as zero, so that one bad match does not hold back all cameras. The solver sets aside and
counts observations that end like this."""


@part
def loss_cost(kind: int, width: float, squared: float) -> float:
    """Loss of a whitened residual by its squared length; about half of that near zero."""
    if kind == HUBER and squared > width * width:
        return width * (math.sqrt(squared) - 0.5 * width)
    if kind == CAUCHY:
        return 0.5 * width * width * math.log1p(squared / (width * width))
    return 0.5 * squared


@part
def loss_weight(kind: int, width: float, squared: float) -> float:
    """Weight of a residual by its squared length; it gives least squares the gradient of the loss."""
    if kind == HUBER and squared > width * width:
        return width / math.sqrt(squared)
    if kind == CAUCHY:
        return 1.0 / (1.0 + squared / (width * width))
    return 1.0


@entry
def loss_costs(kind: int, width: float, squared: FloatArray, first: int, last: int, out: FloatArray) -> None:
    """Losses of squared lengths (n,), rows first to last, to `out` (n,)."""
    for i in range(first, last):
        out[i] = loss_cost(kind, width, squared[i])


@entry
def loss_weights(
    kind: int, width: float, squared: FloatArray, first: int, last: int, out: FloatArray
) -> None:
    """Weights of squared lengths (n,), rows first to last, to `out` (n,)."""
    for i in range(first, last):
        out[i] = loss_weight(kind, width, squared[i])
