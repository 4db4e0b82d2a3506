"""GTSAM's iSAM2, with the variables to relinearise chosen by the caller."""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import FloatArray

__all__ = ["Tree"]

_WILDFIRE = 1e-8
"""Changes of the solution that are passed on through the tree, radians and metres: far below any sigma."""


_ANY = 1e-15
"""A threshold that every variable exceeds but one that has not moved at all."""


class Tree:
    """The Bayes tree of all stops, its point of linearisation `theta` and its `estimate`."""

    def __init__(self) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        steps = gtsam.ISAM2GaussNewtonParams()
        steps.setWildfireThreshold(_WILDFIRE)
        parameters.setOptimizationParams(steps)
        # Which variables move is decided elsewhere, and GTSAM told by its list of those that must not.
        parameters.setRelinearizeThreshold(_ANY)
        self._isam = gtsam.ISAM2(parameters)
        self.theta, self.estimate = gtsam.Values(), gtsam.Values()
        self._delta: dict[int, FloatArray] = {}

    @property
    def moved(self) -> dict[int, FloatArray]:
        """By how much each variable is from where it was linearised."""
        return self._delta

    def next_theta(self, new: gtsam.Values, moving: Iterable[int]) -> gtsam.Values:
        """The point of linearisation after an update that adds variables and moves some."""
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
        """Take factors out, put others in, and move some variables; the new factors' slots.

        Raises SolveError where a direction is held by nothing.
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
            raise SolveError(f"nothing holds a direction of the drive: {str(error).split('.')[0]}") from error
        self.theta, self.estimate = self._isam.getLinearizationPoint(), self._isam.calculateEstimate()
        delta = self._isam.getDelta()
        self._delta = {key: delta.at(key) for key in self.theta.keys()}  # noqa: SIM118  gtsam.Values
        return list(result.getNewFactorsIndices())

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """Joint covariance of variables, one after the other, all else marginalised."""
        if len(keys) == 1:
            return np.asarray(self._isam.marginalCovariance(keys[0]))
        found = self._isam.jointMarginalCovariance(list(keys))
        return np.block([[found.at(a, b) for b in keys] for a in keys])
