"""Factors as a caller would write them."""

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray


def distance_factor(a: int, b: int, distance_m: float, sigma_m: float) -> gtsam.CustomFactor:
    """Distance between two masts, with its analytic Jacobians by body-frame tangents."""

    def error(
        _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        one, two = values.atPose3(a), values.atPose3(b)
        arm = two.translation() - one.translation()
        length = float(np.linalg.norm(arm))
        if jacobians is not None:
            along = arm / length
            for i, (pose, sign) in enumerate(((one, -1.0), (two, 1.0))):
                row = np.concatenate([np.zeros(3), sign * along @ pose.rotation().matrix()])
                jacobians[i] = np.asfortranarray(row[None])
        return np.array([length - distance_m])

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma_m), [a, b], error)


def custom(
    keys: list[int],
    rows: int,
    error: Callable[[gtsam.Values], object],
    jacobian: Callable[[int], FloatArray] | None = None,
    sigma: float = 1.0,
) -> gtsam.CustomFactor:
    """A factor from an error function; `jacobian` gives that of each key by its place, None: none is set."""

    def evaluate(_this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> Any:
        if jacobians is not None and jacobian is not None:
            for i in range(len(keys)):
                jacobians[i] = np.asfortranarray(jacobian(i))
        return error(values)

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(rows, sigma), keys, evaluate)
