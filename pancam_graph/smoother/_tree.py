"""GTSAM's iSAM2, told what its thresholds mean."""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from pancam_graph.errors import SolveError
from pancam_graph.geometry import FloatArray
from pancam_graph.smoother._options import SmootherOptions

__all__ = ["Tree"]

_WILDFIRE = 1e-8
"""Changes of the solution that are passed on through the tree, radians and metres: far below any sigma."""


_ANY = 1e-15
"""A threshold that every variable exceeds but one that has not moved at all."""


class Tree:
    """The Bayes tree of all stops, its point of linearisation `theta` and its `estimate`."""

    def __init__(self, options: SmootherOptions) -> None:
        self._options = options
        parameters = gtsam.ISAM2Params()
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        steps = gtsam.ISAM2GaussNewtonParams()
        steps.setWildfireThreshold(_WILDFIRE)
        parameters.setOptimizationParams(steps)
        # Which variables move is decided by `over`, and GTSAM told by its list of those that must not: it has
        # one vector of thresholds for a letter, but angles of stops have as many entries as there are frames.
        parameters.setRelinearizeThreshold(_ANY)
        self._isam = gtsam.ISAM2(parameters)
        self.theta, self.estimate = gtsam.Values(), gtsam.Values()
        self._delta: dict[int, FloatArray] = {}

    def over(self) -> set[int]:
        """Variables that are too far from where they were linearised."""
        return {
            key for key, delta in self._delta.items() if np.any(np.abs(delta) > self._limit(key, len(delta)))
        }

    def _limit(self, key: int, n: int) -> FloatArray | float:
        o, letter = self._options, chr(gtsam.symbolChr(key))
        if letter == "M":
            return np.repeat([o.relinearise_rad, o.relinearise_m], 3)
        return o.relinearise_rad if letter == "A" else o.relinearise_rig

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

    def delta(self, keys: Iterable[int]) -> FloatArray:
        """How far variables are from where they were linearised, one after the other."""
        return np.concatenate([np.zeros(0), *(self._delta[key] for key in keys)])

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """Joint covariance of variables, one after the other, all else marginalised."""
        if len(keys) == 1:
            return np.asarray(self._isam.marginalCovariance(keys[0]))
        found = self._isam.jointMarginalCovariance(list(keys))
        return np.block([[found.at(a, b) for b in keys] for a in keys])
