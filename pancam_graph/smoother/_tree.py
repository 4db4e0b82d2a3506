"""GTSAM's iSAM2, with the variables to relinearise chosen by the caller."""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import FloatArray

__all__ = ["Tree", "UnevenError"]

_WILDFIRE = 1e-8
"""Changes of the solution below this are not propagated in the tree, radians and metres: far below any
sigma."""


_ANY = 1e-15
"""A relinearisation threshold that every variable with any change exceeds."""


class UnevenError(SolveError):
    """Cholesky fails on the system of a tree: a direction is undetermined, or the scales are too uneven."""


class Tree:
    """The Bayes tree of all stops, its point of linearisation `theta` and its `estimate`."""

    def __init__(self, *, by_qr: bool = False) -> None:
        """`by_qr`: factorised by QR, which is slower than Cholesky but bears uneven scales."""
        self._by_qr = by_qr
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization("QR" if by_qr else "CHOLESKY")
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        steps = gtsam.ISAM2GaussNewtonParams()
        steps.setWildfireThreshold(_WILDFIRE)
        parameters.setOptimizationParams(steps)
        # `Engine` chooses the variables to linearise again; `noRelinKeys` names all others to GTSAM.
        parameters.setRelinearizeThreshold(_ANY)
        self._isam = gtsam.ISAM2(parameters)
        self.theta, self.estimate = gtsam.Values(), gtsam.Values()
        self._delta: dict[int, FloatArray] = {}

    @property
    def moved(self) -> dict[int, FloatArray]:
        """Tangent vector from linearisation point to estimate of each variable, by key."""
        return self._delta

    def next_theta(self, new: gtsam.Values, moving: Iterable[int]) -> gtsam.Values:
        """Linearisation point after an update that adds `new` variables and moves the keys `moving`."""
        values = gtsam.Values(self.theta)
        values.insert(new)
        moved = gtsam.VectorValues()
        for key in moving:
            moved.insert(key, self._delta[key])
        return values.retract(moved) if moved.size() else values

    def update(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        removed: Sequence[int],
        moving: set[int],
    ) -> list[int]:
        """Remove and add factors, and linearise the keys `moving` again; return the slots of new factors.

        Raises SolveError where a direction is undetermined; of that UnevenError, unless by QR. The tree is of
        no use then.
        """
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.push_back(factor)
        parameters = gtsam.ISAM2UpdateParams()
        parameters.removeFactorIndices = list(removed)
        parameters.force_relinearize = True
        still = gtsam.KeyList()
        for key in self._delta:
            if key not in moving:
                still.push_back(key)
        parameters.noRelinKeys = still
        try:
            result = self._isam.update(graph, values, parameters)
        except RuntimeError as error:
            kind = SolveError if self._by_qr else UnevenError
            raise kind(
                "stop by stop: nothing holds a direction of the drive, or sigmas of observations are too far "
                f"below what telemetry resolves; all at once bears these: {_in_a_line(error)}"
            ) from error
        self.theta, self.estimate = self._isam.getLinearizationPoint(), self._isam.calculateEstimate()
        delta = self._isam.getDelta()
        self._delta = {key: delta.at(key) for key in self.theta.keys()}  # noqa: SIM118  gtsam.Values
        return list(result.getNewFactorsIndices())

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """Joint marginal covariance of variables, in the order of the keys."""
        if len(keys) == 1:
            return np.asarray(self._isam.marginalCovariance(keys[0]))
        joint = self._isam.jointMarginalCovariance(list(keys))
        return np.block([[joint.at(a, b) for b in keys] for a in keys])


def _in_a_line(error: RuntimeError) -> str:
    """The first sentence of GTSAM's message."""
    return " ".join(str(error).split(".")[0].split())
