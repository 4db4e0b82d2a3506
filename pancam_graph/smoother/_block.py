"""A block of landmarks, eliminated: one factor of iSAM2 on the variables of the stops that see them.

The block is linearised at the point of linearisation that iSAM2 has of these variables, and handed over as the
quadratic that is left there: GTSAM's own container of a linear factor. It is taken out and put in again when
its landmarks are seen again, and when iSAM2 moves a variable of it to another point.
"""

from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.elimination import LandmarkSystem, Panels
from pancam_graph.geometry import FloatArray
from pancam_graph.graph import read_variable
from pancam_graph.smoother._placing import Placed
from pancam_graph.smoother._station import Postures, copied

__all__ = ["LandmarkBlock", "difference"]


class LandmarkBlock:
    """Landmarks, where they are at the point of linearisation, and what is left of them there."""

    def __init__(self, placed: Placed) -> None:
        self._placed, self.patch = placed, placed.patch
        self.system = LandmarkSystem(placed.patch.linkage, placed.measurements, placed.landmarks)
        self.slot = -1
        """Of its factor in iSAM2."""
        self.cost = 0.0
        """At the last estimate that it was evaluated at."""
        self.delta = np.zeros(0)
        """Of its variables at that estimate, as iSAM2 has it."""
        self.factor: gtsam.LinearContainerFactor | None = None
        self._here: gtsam.Values | None = None
        self._at: Postures | None = None

    @property
    def placed(self) -> Placed:
        """Its landmarks as they were linearised."""
        return replace(self._placed, landmarks=self.system.landmarks())

    def replace(self, placed: Placed) -> None:
        """Put the same landmarks elsewhere; the block must then be linearised anew."""
        self._placed = placed
        self.system = LandmarkSystem(self.patch.linkage, placed.measurements, placed.landmarks)

    @property
    def keys(self) -> tuple[int, ...]:
        """Variables that it touches."""
        return self.system.linkage.key

    def linearise(self, theta: Postures) -> None:
        """Make the factor at a point of linearisation; landmarks stay where they are."""
        link = self.system.linkage
        panels = self.system.linearise(self.patch.posture(theta))
        panels.hold(self.patch.held_columns())
        self.cost = float(self.system.reduced.cost.sum())
        self._here, self._at = copied(theta.values, link.key), None
        self.factor = gtsam.LinearContainerFactor(_quadratic(panels, self.system, self.cost), self._here)

    def follow(self, estimate: Postures) -> float:
        """Landmarks follow the cameras to an estimate; the true cost there."""
        link = self.system.linkage
        step = np.zeros(int(link.group_column[-1]))
        begin = link.group_column[link.group] + link.variable_column
        for key, first, dim in zip(link.key, begin, link.dim, strict=True):
            step[first : first + dim] = difference(self._here, estimate.values, key)
        self.cost = float(self.system.try_step(self.patch.posture(estimate), step).sum())
        self._at = estimate
        return self.cost

    def settle(self, estimate: Postures) -> None:
        """Landmarks move to where they follow the cameras; the block must then be linearised anew."""
        if self._at is not estimate:
            self.follow(estimate)
        self.system.adopt()
        self._at = None

    def modelled_cost(self, values: gtsam.Values) -> float:
        """Cost at an estimate as the block was linearised."""
        assert self.factor is not None
        return float(self.factor.error(values))


def difference(here: gtsam.Values | None, there: gtsam.Values, key: int) -> FloatArray:
    """Local coordinates of a variable's value at another."""
    a, b = read_variable(here, key), read_variable(there, key)
    return np.asarray(a.localCoordinates(b) if isinstance(a, gtsam.Pose3) else b - a)


def _quadratic(panels: Panels, system: LandmarkSystem, cost: float) -> gtsam.HessianFactor:
    """What is left of all landmarks, as one factor.

    GTSAM takes three variables at a time, so it is summed up from such parts: cost + s'x + x'Sx / 2.
    """
    link, structure = system.linkage, system.structure
    graph = gtsam.GaussianFactorGraph()
    dims = link.dim.tolist()
    zeros = {(a, b): np.zeros((a, b)) for a in set(dims) for b in set(dims)}
    zero = {a: np.zeros(a) for a in set(dims)}
    constant = 2 * cost
    members = [list(range(link.group_begin[g], link.group_begin[g + 1])) for g in range(link.n_groups)]
    column = link.variable_column
    for g, panel in enumerate(panels.panel):
        n = int(link.group_dim[g])
        upper = np.triu(panel[:, :n])
        own = upper + np.triu(upper, 1).T
        for i, v in enumerate(members[g]):
            a = slice(column[v], column[v] + dims[v])
            graph.push_back(gtsam.HessianFactor(link.key[v], own[a, a], -panel[a, -1], constant))
            constant = 0.0
            rest = [(w, own, int(column[w])) for w in members[g][i + 1 :]]
            after, begin = structure.after[g], structure.begin[g]
            for h, first in zip(after[1:], begin[1:-1], strict=True):
                rest += [(w, panel, int(first) + int(column[w])) for w in members[h]]
            for j in range(0, len(rest), 2):
                pair = rest[j : j + 2]
                keys = [link.key[v], *(link.key[w] for w, _, _ in pair)]
                p = [source[a, c : c + dims[w]] for w, source, c in pair]
                d = [dims[v], *(dims[w] for w, _, _ in pair)]
                if len(pair) == 2:
                    graph.push_back(
                        gtsam.HessianFactor(
                            *keys,
                            zeros[d[0], d[0]],
                            p[0],
                            p[1],
                            zero[d[0]],
                            zeros[d[1], d[1]],
                            zeros[d[1], d[2]],
                            zero[d[1]],
                            zeros[d[2], d[2]],
                            zero[d[2]],
                            0.0,
                        )
                    )
                else:
                    graph.push_back(
                        gtsam.HessianFactor(
                            *keys, zeros[d[0], d[0]], p[0], zero[d[0]], zeros[d[1], d[1]], zero[d[1]], 0.0
                        )
                    )
    return gtsam.HessianFactor(graph)
