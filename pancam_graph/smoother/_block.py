"""A block of landmarks, eliminated: one factor of iSAM2 on the variables of the stops that observe them.

The block is linearised at iSAM2's linearisation point of these variables. Its Schur complement there is one
linear factor, which iSAM2 gets in a gtsam.LinearContainerFactor. The factor is removed and added again
when the block's landmarks are observed again, and when iSAM2 moves the linearisation point of one of its
variables.
"""

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination import LandmarkSystem, Panels, Room
from pancam_graph.graph import read_variable
from pancam_graph.landmarks import Landmarks
from pancam_graph.smoother._frame import CommonMotion, carried, posture_in
from pancam_graph.smoother._placing import Placed
from pancam_graph.smoother._station import Postures, copied

__all__ = ["LandmarkBlock"]


class LandmarkBlock:
    """Landmarks eliminated together: their places at the linearisation point, and the factor that remains."""

    def __init__(self, placed: Placed, room: Room) -> None:
        """Take landmarks placed at the estimate of the cameras, and scratch memory that blocks share."""
        self._room = room
        self.patch = placed.patch
        self.slot = -1
        """Slot of its factor in iSAM2; -1 before it has one."""
        self.cost = 0.0
        """Half the sum of squared whitened residuals at the estimate evaluated last."""
        self.factor: gtsam.LinearContainerFactor | None = None
        self.replace(placed)

    def replace(self, placed: Placed) -> None:
        """Take other places of its landmarks; the caller must linearise the block again afterwards."""
        self._placed = placed
        self.system = LandmarkSystem(
            self.patch.linkage, placed.measurements, placed.landmarks, room=self._room
        )
        self._frame = gtsam.Pose3()

    @property
    def placed(self) -> Placed:
        """Its landmarks at their linearised places, moved with the common motion to the current estimate."""
        return replace(self._placed, landmarks=carried(self.system.landmarks(), self._frame.inverse()))

    @property
    def keys(self) -> tuple[int, ...]:
        """Keys of the variables that its observations depend on."""
        return self.system.linkage.key

    def linearise(
        self, theta: Postures, estimate: gtsam.Values, unit: FloatArray, *, by_rows: bool = False
    ) -> None:
        """Make the factor at the linearisation point `theta`, with landmarks moved there from `estimate`.

        `unit` (6,) are rotations, radians, and shifts, metres, of a mast that count as equally large.
        `by_rows`: a factor of rows, for QR, which takes the square root of a quadratic factor by a Cholesky
        that fails where images leave a direction free.
        """
        link, stations, system = self.system.linkage, self.patch.stations, self.system
        there = [s.world_T_mast(theta.values) for s in stations]
        self._common = CommonMotion(
            there, unit, held=any(s.mast is None or len(s.held_of_mast) for s in stations)
        )
        apart = [a.localCoordinates(s.world_T_mast(estimate)) for a, s in zip(there, stations, strict=True)]
        frame = gtsam.Pose3.Expmap(-self._common.of(np.concatenate(apart))[0])
        moved = carried(
            Landmarks(vector=system.vector, origin_m=system.origin_m), frame * self._frame.inverse()
        )
        system.vector, system.origin_m, self._frame = moved.vector, moved.origin_m, frame
        panels = system.linearise(self.patch.posture(theta))
        panels.hold(self.patch.held_columns())
        self.cost = float(system.reduced.cost.sum())
        self._here = copied(theta.values, link.key)
        self._theta = there
        linear = _rows(panels, system, self._here) if by_rows else _quadratic(panels, system)
        self.factor = gtsam.LinearContainerFactor(linear, self._here)

    def apart(self, estimate: gtsam.Values) -> float:
        """Largest motion of a mast since its linearisation, less the common motion, in the given units."""
        stations = self.patch.stations
        delta = [
            a.localCoordinates(s.world_T_mast(estimate)) for a, s in zip(self._theta, stations, strict=True)
        ]
        twist, largest = self._common.of(np.concatenate(delta))
        self._frame = gtsam.Pose3.Expmap(-twist)
        return largest

    def left_apart(self, theta: gtsam.Values, estimate: gtsam.Values, moving: set[int]) -> float:
        """The value of `apart` if only the masts among the keys `moving` were linearised at the estimate."""
        stations = self.patch.stations
        there = [s.world_T_mast(estimate if s.mast in moving else theta) for s in stations]
        delta = [a.localCoordinates(s.world_T_mast(estimate)) for a, s in zip(there, stations, strict=True)]
        return self._common.of(np.concatenate(delta))[1]

    def follow(self, estimate: Postures) -> float:
        """Move landmarks along with the cameras to an estimate; return the true (nonlinear) cost there."""
        link = self.system.linkage
        self.apart(estimate.values)
        posture = posture_in(self.patch.posture(estimate), self._frame)
        step = np.zeros(int(link.group_column[-1]))
        begin = link.group_column[link.group] + link.variable_column
        for key, first, dim in zip(link.key, begin, link.dim, strict=True):
            here, there = read_variable(self._here, key), read_variable(estimate.values, key)
            is_pose = isinstance(here, gtsam.Pose3)
            step[first : first + dim] = (
                here.localCoordinates(self._frame * there) if is_pose else there - here
            )
        self.cost = float(self.system.try_step(posture, step).sum())
        return self.cost

    def settle(self, estimate: Postures) -> None:
        """Adopt the landmarks moved by `follow`; the caller must linearise the block again afterwards."""
        self.follow(estimate)
        self.system.adopt()

    def modelled_cost(self, values: gtsam.Values) -> float:
        """Cost at `values` by the block's linear model."""
        return 0.0 if self.factor is None else float(self.factor.error(values))


def _cost_of_cameras(system: LandmarkSystem) -> float:
    """The linearised cost with the cameras held and the landmarks at their optimum."""
    return float(system.reduced.cost.sum()) - system.gain_alone


def _rows(panels: Panels, system: LandmarkSystem, here: gtsam.Values) -> gtsam.JacobianFactor:
    """The factor of `_quadratic` as rows of the square root of S, which may be singular. Destroys the panels.

    A last row without variables has what the cost has beyond the squares of these rows.
    """
    link, structure, root = system.linkage, system.structure, panels.root()
    first_row = np.cumsum([0, *(len(rows) for rows in root.rows)])
    jacobian = [np.zeros((int(first_row[-1]) + 1, int(dim)), order="F") for dim in link.dim]
    error = np.zeros(int(first_row[-1]) + 1)
    for g, rows in enumerate(root.rows):
        of_group = slice(first_row[g], first_row[g + 1])
        error[of_group] = rows[:, -1]
        for h, begin in zip(structure.after[g], structure.begin[g], strict=False):
            for v in range(link.group_begin[h], link.group_begin[h + 1]):
                first = int(begin) + int(link.variable_column[v])
                jacobian[v][of_group] = rows[:, first : first + int(link.dim[v])]
    error[-1] = np.sqrt(max(2 * (_cost_of_cameras(system) - root.gain()), 0.0))

    def evaluate(
        _this: gtsam.CustomFactor, _values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        if jacobians is not None:
            for i, columns in enumerate(jacobian):
                jacobians[i] = columns
        return error

    # GTSAM's constructors of linear factors take three variables at most; no noise model: rows are whitened.
    no_noise: Any = None
    linear = gtsam.CustomFactor(no_noise, list(link.key), evaluate).linearize(here)
    assert isinstance(linear, gtsam.JacobianFactor)
    return linear


def _quadratic(panels: Panels, system: LandmarkSystem) -> gtsam.HessianFactor:
    """The Schur complement of the landmarks as one Hessian factor f + s'x + x'Sx / 2.

    Here f is the cost with the cameras held and the landmarks at their optimum. GTSAM's constructors take
    three variables at most, so the factor is a sum of such parts.
    """
    link, structure = system.linkage, system.structure
    graph = gtsam.GaussianFactorGraph()
    dims = link.dim.tolist()
    zeros = {(a, b): np.zeros((a, b)) for a in set(dims) for b in set(dims)}
    zero = {a: np.zeros(a) for a in set(dims)}
    constant = 2 * _cost_of_cameras(system)
    members = [list(range(link.group_begin[g], link.group_begin[g + 1])) for g in range(link.n_groups)]
    column = link.variable_column
    for g, panel in enumerate(panels.panel):
        n = int(link.group_dim[g])
        upper = np.triu(panel[:, :n])
        diagonal_block = upper + np.triu(upper, 1).T
        for i, v in enumerate(members[g]):
            a = slice(column[v], column[v] + dims[v])
            graph.push_back(gtsam.HessianFactor(link.key[v], diagonal_block[a, a], -panel[a, -1], constant))
            constant = 0.0
            rest = [(w, diagonal_block, int(column[w])) for w in members[g][i + 1 :]]
            after, begin = structure.after[g], structure.begin[g]
            for h, first in zip(after[1:], begin[1:-1], strict=True):
                rest += [(w, panel, int(first) + int(column[w])) for w in members[h]]
            for j in range(0, len(rest), 2):
                w, source, c = rest[j]
                diagonal_zero, right = zeros[dims[v], dims[v]], zero[dims[v]]
                one, keys = source[a, c : c + dims[w]], (link.key[v], link.key[w])
                a1 = dims[w]
                if j + 1 == len(rest):
                    part = gtsam.HessianFactor(*keys, diagonal_zero, one, right, zeros[a1, a1], zero[a1], 0.0)
                else:
                    x, source, c = rest[j + 1]
                    a2 = dims[x]
                    two = source[a, c : c + a2]
                    part = gtsam.HessianFactor(
                        *(*keys, link.key[x]),
                        *(diagonal_zero, one, two, right),
                        *(zeros[a1, a1], zeros[a1, a2], zero[a1], zeros[a2, a2], zero[a2], 0.0),
                    )
                graph.push_back(part)
    return gtsam.HessianFactor(graph)
