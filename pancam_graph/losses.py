"""Robust losses, in NumPy and as GTSAM's noise models.

All take the length of a whitened residual; `scale` widens them where the noise is larger than its sigma.
"""

from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np

from pancam_graph.errors import InputError
from pancam_graph.geometry import FloatArray

__all__ = ["SQUARED", "Loss", "LossName", "loss_of"]

LossName = Literal["none", "huber", "cauchy"]

_WIDTH: dict[LossName, float] = {
    # 95 % efficient for Gaussian noise: Huber 1981; Holland and Welsch 1977.
    "none": np.inf,
    "huber": 1.345,
    "cauchy": 2.3849,
}


@dataclass(frozen=True)
class Loss:
    """A loss rho(|r|) with rho about |r|^2 / 2 near zero."""

    name: LossName
    width: float
    """Where it bends away from the square, in sigmas."""

    def cost(self, residual: FloatArray) -> FloatArray:
        """Costs (n,) of whitened residuals (n, m)."""
        squared = np.einsum("ni,ni->n", residual, residual)
        if self.name == "huber":
            length = np.sqrt(squared)
            beyond = self.width * (length - self.width / 2)
            return np.asarray(np.where(length <= self.width, squared / 2, beyond))
        if self.name == "cauchy":
            return np.asarray(0.5 * self.width**2 * np.log1p(squared / self.width**2))
        return np.asarray(squared / 2)

    def weight(self, residual: FloatArray) -> FloatArray:
        """Weights (n,) that make the square's gradient that of the loss."""
        squared = np.einsum("ni,ni->n", residual, residual)
        if self.name == "huber":
            return np.asarray(np.minimum(1.0, self.width / np.sqrt(squared.clip(1e-300))))
        if self.name == "cauchy":
            return np.asarray(1 / (1 + squared / self.width**2))
        return np.ones(len(residual))

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
