"""Robust losses of whitened residuals, by number."""

import math

from pancam_graph.base.compiled import entry, part
from pancam_graph.base.geometry import FloatArray

__all__ = ["BEHIND_COST", "CAUCHY", "HUBER", "NONE", "loss_cost", "loss_costs", "loss_weight", "loss_weights"]

NONE, HUBER, CAUCHY = 0, 1, 2
"""Kinds of losses."""

BEHIND_COST = 0.5 * 1000.0**2
"""What an observation of a landmark behind its camera costs: as much as one that is 1000 sigma off. It pulls
nowhere, so that one bad match holds back nobody; the solver sets aside and counts what ends there."""


@part
def loss_cost(kind: int, width: float, squared: float) -> float:
    """Loss rho of a whitened residual's squared length; rho is half of it near zero."""
    if kind == HUBER and squared > width * width:
        return width * (math.sqrt(squared) - 0.5 * width)
    if kind == CAUCHY:
        return 0.5 * width * width * math.log1p(squared / (width * width))
    return 0.5 * squared


@part
def loss_weight(kind: int, width: float, squared: float) -> float:
    """The weight that makes the square's gradient that of the loss."""
    if kind == HUBER and squared > width * width:
        return width / math.sqrt(squared)
    if kind == CAUCHY:
        return 1.0 / (1.0 + squared / (width * width))
    return 1.0


@entry
def loss_costs(kind: int, width: float, squared: FloatArray, first: int, last: int, out: FloatArray) -> None:
    """Costs (n,) of squared lengths (n,)."""
    for i in range(first, last):
        out[i] = loss_cost(kind, width, squared[i])


@entry
def loss_weights(
    kind: int, width: float, squared: FloatArray, first: int, last: int, out: FloatArray
) -> None:
    """Weights (n,) of squared lengths (n,)."""
    for i in range(first, last):
        out[i] = loss_weight(kind, width, squared[i])
