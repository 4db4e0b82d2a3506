"""Robust losses, for arrays and as GTSAM's noise models.

All take the length of a whitened residual; `scale` widens them where the noise is larger than its sigma.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.base.threads import in_parallel
from pancam_graph.landmarks import kernel

__all__ = ["SQUARED", "Loss", "LossName", "loss_of"]

LossName = Literal["none", "huber", "cauchy"]

_WIDTH: dict[LossName, float] = {
    # The estimate keeps 95 % efficiency for Gaussian noise: Huber 1981; Holland and Welsch 1977.
    "none": np.inf,
    "huber": 1.345,
    "cauchy": 2.3849,
}

_KIND: dict[LossName, int] = {"none": kernel.NONE, "huber": kernel.HUBER, "cauchy": kernel.CAUCHY}
_GRAIN = 65536


@dataclass(frozen=True)
class Loss:
    """A loss rho(|r|) with rho about |r|^2 / 2 near zero."""

    name: LossName
    width: float
    """Length of a residual, in sigmas, from which on the loss grows more slowly than the square."""

    @property
    def kind(self) -> int:
        """The loss's number in compiled code."""
        return _KIND[self.name]

    def cost(self, residual: FloatArray) -> FloatArray:
        """Costs (n,) of whitened residuals (n, m)."""
        return self._each(kernel.loss_costs, residual)

    def weight(self, residual: FloatArray) -> FloatArray:
        """Weights (n,) of whitened residuals (n, m), which give least squares the gradient of the loss."""
        return self._each(kernel.loss_weights, residual)

    def _each(self, loop: Callable[..., None], residual: FloatArray) -> FloatArray:
        squared = np.einsum("ni,ni->n", residual, residual)
        out = np.empty(len(squared))
        in_parallel(
            lambda first, last: loop(self.kind, self.width, squared, first, last, out), len(out), grain=_GRAIN
        )
        return out

    def noise_model(self, gaussian: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """GTSAM's noise model of this loss over a Gaussian one."""
        if self.name == "none":
            return gaussian
        estimators = gtsam.noiseModel.mEstimator
        if self.name == "huber":
            return gtsam.noiseModel.Robust.Create(estimators.Huber.Create(self.width), gaussian)
        return gtsam.noiseModel.Robust.Create(estimators.Cauchy.Create(self.width), gaussian)


SQUARED = Loss("none", np.inf)
"""Plain least squares."""


def loss_of(name: LossName, scale: float = 1.0) -> Loss:
    """The loss of a name, its width times `scale`. Raises InputError for an unknown name."""
    if name not in _WIDTH:
        raise InputError(f"loss: expected one of {', '.join(_WIDTH)}; found {name!r}")
    return Loss(name, _WIDTH[name] * scale)
