"""Landmark blocks: factors on the variables of cameras alone, with the landmarks eliminated.

Linearised, with A, B the whitened Jacobians of all observations by cameras and landmarks, V = B'B, E = A'B:

    S = A'A - sum E V^-1 E'        s = A'r - sum E V^-1 g        g = B'r

Each group of variables (a stop) has one factor. With a square root R'R = S and R'e = s, the factor holds the
rows of R and e that belong to its group; these are fewer than the group's columns where S is singular. All
factors together represent S exactly. Landmarks follow a step dx of the variables by dp = -V^-1 (g + E' dx),
and the error of a factor is the true cost of its block. So GTSAM's Levenberg-Marquardt takes the exact joint
step of cameras and landmarks, as sparse bundle adjustment does (thesis section 3.8).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination import LandmarkSystem, Panels, Posture, Root

__all__ = ["LandmarkBlocks"]

Reader = Callable[[gtsam.Values, int], Any]
"""Takes values and a key to a gtsam.Pose3, a vector or a number."""


class LandmarkBlocks:
    """All landmark blocks of a problem; they are linearised together and share the result.

    The landmarks are not variables of the graph but state of this object, which changes when GTSAM linearises
    at new values. A graph with these factors therefore serves one optimiser at a time.
    """

    def __init__(
        self, system: LandmarkSystem, read: Reader, posture: Callable[[gtsam.Values], Posture]
    ) -> None:
        """Take a system, a reader of variables by values and key, and a function that gives the cameras."""
        self.system, self._posture = system, posture
        link, structure = system.linkage, system.structure
        self._touched = np.flatnonzero(link.touched).tolist()
        self._read = read
        begin = link.group_column
        self._slice = {
            v: slice(c, c + int(link.dim[v]))
            for v in self._touched
            for c in [int(begin[link.group[v]] + link.variable_column[v])]
        }
        self._n_columns = int(begin[-1])
        self._members = [
            [v for v in range(link.group_begin[g], link.group_begin[g + 1]) if link.touched[v]]
            for g in range(link.n_groups)
        ]
        self._groups = [g for g in structure.order if self._members[g]]
        self._owner = np.array([b.groups[0] if b.groups else self._groups[0] for b in system.blocks])
        self._linearised: _Place | None = None
        """Linearisation point of the system and its landmarks"""
        self._evaluated: _Place | None = None
        """Values evaluated last: the linearisation point, or the end of a step from it"""
        self._cost = np.zeros(0)
        self._panels: Panels | None = None
        self._root: Root | None = None

    def factors(self) -> list[gtsam.CustomFactor]:
        """The factors, in the order of elimination."""
        return [self._factor(g) for g in self._groups]

    def ordering(self) -> list[int]:
        """Keys in an order of elimination without fill-in beyond the factors."""
        link = self.system.linkage
        return [
            link.key[v]
            for g in self.system.structure.order
            for v in range(link.group_begin[g], link.group_begin[g + 1])
        ]

    def settle(self, values: gtsam.Values) -> bool:
        """Move the landmarks along with a step to these values; return whether they moved."""
        self._evaluate(values, self._touched)
        moved = self._linearised is not self._evaluated
        if moved:
            self.system.adopt()
            self._linearised = self._evaluated = None
            self._panels, self._root = None, None
        return moved

    def _factor(self, group: int) -> gtsam.CustomFactor:
        link, structure = self.system.linkage, self.system.structure
        members = [
            (v, begin + int(link.variable_column[v]))
            for g, begin in zip(structure.after[group], structure.begin[group], strict=False)
            for v in self._members[g]
        ]
        variables = [v for v, _ in members]
        columns = [slice(c, c + int(link.dim[v])) for v, c in members]
        of_group = self._owner == group
        first = group == self._groups[0]

        def evaluate(
            _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
        ) -> FloatArray:
            self._evaluate(values, variables)
            if jacobians is None:
                return np.array([np.sqrt(2 * self._cost[of_group].sum())])
            root = self._square_root()
            rows = root.rows[group]
            error = np.empty(len(rows) + first)
            error[: len(rows)] = rows[:, -1]
            if first:
                error[-1] = self._remainder(root)
            for i, column in enumerate(columns):
                jacobian = np.zeros((len(error), column.stop - column.start), order="F")
                jacobian[: len(rows)] = rows[:, column]
                jacobians[i] = jacobian
            return error

        # No noise model: rows are whitened, and their number depends on the rank.
        no_noise: Any = None
        return gtsam.CustomFactor(no_noise, [link.key[v] for v in variables], evaluate)

    def _evaluate(self, values: gtsam.Values, variables: Sequence[int]) -> None:
        """Evaluate costs at these values, unless the given variables are unchanged."""
        known = self._evaluated
        if known is not None and all(_same(known.value[v], self._value(values, v)) for v in variables):
            return
        place = _Place(
            value={v: self._value(values, v) for v in self._touched}, posture=self._posture(values)
        )
        self._evaluated = place
        if self._linearised is None:
            self._linearise()
            return
        step = np.zeros(self._n_columns)
        for v in self._touched:
            step[self._slice[v]] = _difference(self._linearised.value[v], place.value[v])
        self._cost = self.system.try_step(place.posture, step)

    def _value(self, values: gtsam.Values, variable: int) -> Any:
        return self._read(values, self.system.linkage.key[variable])

    def _square_root(self) -> Root:
        """The square root at the last values evaluated."""
        self._adopt()
        if self._root is None:
            assert self._panels is not None
            self._root, self._panels = self._panels.root(), None
        return self._root

    def _adopt(self) -> None:
        """Move the landmarks to the values evaluated last, and linearise there."""
        if self._linearised is not self._evaluated:
            self.system.adopt()
            self._linearise()

    def _linearise(self) -> None:
        assert self._evaluated is not None
        self._panels, self._root = self.system.linearise(self._evaluated.posture), None
        self._cost = self.system.block_costs()
        self._linearised = self._evaluated

    def _remainder(self, root: Root) -> float:
        """Residual of one more row: its square makes the sum of squares twice the true cost."""
        return float(np.sqrt(max(2 * (float(self._cost.sum()) - root.gain()), 0.0)))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Place:
    """Values of the variables, and the cameras there."""

    value: dict[int, Any]
    """Value of each variable that cameras depend on, by its index"""
    posture: Posture


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, gtsam.Pose3):
        return bool(a.equals(b, 0.0))
    return bool(a.tobytes() == b.tobytes() if isinstance(a, np.ndarray) else a == b)


def _difference(a: Any, b: Any) -> FloatArray:
    """Local coordinates of b at a."""
    if isinstance(a, gtsam.Pose3):
        return np.asarray(a.localCoordinates(b))
    return np.asarray(b - a)
