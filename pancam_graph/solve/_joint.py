"""A problem for GTSAM's Levenberg-Marquardt with all groups of variables but the last one eliminated.

GTSAM's elimination takes a tenth of a solve where stops are many, and ten times as long as all other work in
models with variables per image. So groups (stops) are eliminated here, as landmarks are, with the damping
that GTSAM is about to use. GTSAM gets the square root of the Schur complement, in the columns of the last
group, and decides on the damping and on whether to take a step. The other groups follow by back
substitution. The result is the step of the whole system with the same damping of all variables. After each
step the problem moves there, and GTSAM's vector begins at 0 again.
"""

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.elimination import Linkage, Panels, Posture, Root
from pancam_graph.landmarks import CameraViews
from pancam_graph.solve._optimise import MOST_DAMPING, InOrder, parameters_of
from pancam_graph.solve._problem import EliminatedLandmarks, Problem
from pancam_graph.solve._reduced import joint_panels
from pancam_graph.solve._stopping import StopRule

__all__ = ["JointSystem", "OnLastGroup", "all_columns", "retracted"]

_KEY = 0
"""Key of GTSAM's only variable: a step of the columns of the last group, and one number for all other
groups."""
_UNIT = 1e-7
"""Value of that number which stands for the whole step of the other groups: too short for damping to
matter."""


def retracted(linkage: Linkage, values: gtsam.Values, step: FloatArray) -> gtsam.Values:
    """Values after a step (columns,) of all variables, group by group."""
    vector = gtsam.VectorValues()
    for key, group in zip(linkage.key, linkage.group, strict=True):
        columns, begin = linkage.columns_of(key), int(linkage.group_column[group])
        vector.insert(key, step[begin + columns.start : begin + columns.stop])
    return values.retract(vector)


def all_columns(linkage: Linkage, columns: dict[int, IntArray]) -> IntArray:
    """Columns by group as columns (n,) among all."""
    begin = linkage.group_column
    return np.concatenate(
        [np.zeros(0, dtype=np.int64), *(begin[g] + in_group for g, in_group in columns.items())]
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Trial:
    """A step of all variables from the values of a joint system, and what it leads to."""

    last_step: FloatArray
    """(columns,) of the last group: what was asked for."""
    damping: float
    """Damping of the other groups."""
    step: FloatArray
    """(columns,)"""
    values: gtsam.Values
    posture: Posture
    cost: float


class JointSystem:
    """The values of a problem, its linearisation there, and its cost at other values.

    The landmarks are state of this object, as in LandmarkBlocks, so it serves one optimiser at a time.
    """

    def __init__(self, problem: Problem, system: EliminatedLandmarks) -> None:
        self.template, self.factors, self.system = problem.template, problem.factors, system
        self.values = problem.values
        """Values of the variables at which it is linearised"""
        link = self.template.linkage
        self.last = next(g for g in reversed(system.structure.order) if link.group_dim[g])
        """Index of the group that is not eliminated"""
        self._held = all_columns(link, self.template.held_by_group)
        self._posture = self.template.posture(self.values)
        self._forget()
        self.panels()  # the first step needs them too
        self.cost = system.linearised_cost + self.factors.error(self.values)
        """Cost at these values"""

    def _forget(self) -> None:
        self._panels: Panels | None = None
        self._root: Root | None = None
        self._damped: tuple[float, Root] | None = None
        self._tried: _Trial | None = None

    @property
    def views(self) -> CameraViews | None:
        """Cameras at these values; None where sensors are among them."""
        return self._posture.views if self.template.sensors is None else None

    def panels(self) -> Panels:
        """The system (S, s) at these values, landmarks eliminated, all other factors included."""
        if self._panels is None:
            panels = self.system.linearise(self._posture)
            self._panels = joint_panels(self.template, self.factors, self.values, panels)
        return self._panels

    def root(self) -> Root:
        """Square root of that system."""
        if self._root is None:
            self._root = self.panels().copy().root()
        return self._root

    @property
    def known_root(self) -> Root | None:
        """The value of `root` if it was computed already, else None."""
        return self._root

    def damped_root(self, damping: float) -> Root:
        """Square root with damping added to the diagonal of all groups except the last."""
        if self._damped is None or self._damped[0] != damping:
            self._damped = self._root = None  # a step follows, and neither is needed any more
            panels = self.panels().copy()
            for g, panel in enumerate(panels.panel):
                if g != self.last:
                    diagonal = np.arange(len(panel))
                    panel[diagonal, diagonal] += damping
            self._damped = damping, panels.root()
        return self._damped[1]

    def gradient(self) -> float:
        """Largest component of the gradient at these values; held components are 0."""
        return float(np.abs(self.panels().right()).max(initial=0.0))

    def cost_after(self, last_step: FloatArray, damping: float) -> float:
        """True cost after a step of the last group (columns,); other groups and landmarks follow it."""
        tried = self._tried
        if tried is not None and tried.damping == damping and np.array_equal(tried.last_step, last_step):
            return tried.cost
        step = self.damped_root(damping).step(known={self.last: last_step})
        step[self._held] = 0.0  # held values stay exactly the same
        if tried is not None and np.array_equal(tried.step, step):
            self._tried = replace(tried, last_step=last_step.copy(), damping=damping)
        else:
            values = retracted(self.template.linkage, self.values, step)
            posture = self.template.posture(values)
            cost = float(self.system.try_step(posture, step).sum()) + self.factors.error(values)
            self._tried = _Trial(
                last_step=last_step.copy(),
                damping=damping,
                step=step,
                values=values,
                posture=posture,
                cost=cost,
            )
        return self._tried.cost

    def move(self, last_step: FloatArray, damping: float) -> None:
        """Take the step of `cost_after`."""
        self.cost = self.cost_after(last_step, damping)
        assert self._tried is not None
        self.values, self._posture = self._tried.values, self._tried.posture
        self.system.adopt()
        self._forget()


class OnLastGroup:
    """GTSAM's Levenberg-Marquardt on the last group of a joint system: an Optimiser."""

    def __init__(self, joint: JointSystem, rule: StopRule) -> None:
        self._joint = joint
        self._rule, self._elimination = rule, InOrder([_KEY])
        self._damping = float(parameters_of(rule, self._elimination).getlambdaInitial())
        self._start = gtsam.Values()
        self._start.insert(_KEY, np.zeros(int(joint.template.linkage.group_dim[joint.last]) + 1))

    def _graph(self) -> gtsam.NonlinearFactorGraph:
        """The graph of the one factor.

        Nothing keeps it: Python frees no cycle that runs through a function which GTSAM holds.
        """
        # No noise model: rows are whitened, and their number depends on the rank.
        no_noise: Any = None
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(gtsam.CustomFactor(no_noise, [_KEY], self._evaluate))
        return graph

    def _evaluate(
        self, _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        joint = self._joint
        if jacobians is None:
            vector = values.atVector(_KEY)
            cost = joint.cost_after(vector[:-1], self._damping) if vector.any() else joint.cost
            return np.array([np.sqrt(2 * cost)])
        root = joint.damped_root(self._damping)
        rows = root.rows[joint.last]
        n, last2 = len(rows), float(np.sum(rows[:, -1] ** 2))
        # Without the landmarks' own gain GTSAM would expect none where cameras have nothing left to gain, and
        # refuse every step.
        gain = root.gain() + joint.system.gain_alone
        others2 = 2 * gain - last2
        error, jacobian = np.zeros(n + 2), np.zeros((n + 2, rows.shape[1]), order="F")
        jacobian[:n, :-1], error[:n] = rows[:, :-1], rows[:, -1]
        # Decrease by other groups and by landmarks, and the part of the cost beyond the squares of all e.
        error[n] = np.sqrt(max(others2, 0.0))
        jacobian[n, -1] = error[n] / _UNIT
        error[n + 1] = np.sqrt(max(2 * (joint.cost - gain), 0.0))
        jacobians[0] = jacobian
        return error

    def iterate(self) -> None:
        """Take the next step that lowers the cost.

        GTSAM makes one trial at a time, since the elimination of the other groups depends on the damping.
        """
        graph = self._graph()
        while True:
            tried, parameters = self._damping, parameters_of(self._rule, self._elimination)
            parameters.setlambdaInitial(tried)
            parameters.setlambdaUpperBound(2 * tried)
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, self._start, parameters)
            optimizer.iterate()
            vector = optimizer.values().atVector(_KEY)
            if not vector.any() and self._elimination.turns_to_qr(graph, self._start, tried):
                continue
            if vector.any():
                self._joint.move(vector[:-1], tried)
            self._damping = optimizer.lambda_()
            if vector.any() or not tried < self._damping < MOST_DAMPING:
                return

    def error(self) -> float:
        """Cost at the current values."""
        return self._joint.cost

    def damping(self) -> float:
        """Damping (lambda) of the next step."""
        return self._damping

    def values(self) -> gtsam.Values:
        """Current values."""
        return self._joint.values

    def gradient(self) -> float:
        """Largest component of the gradient at the current values, except held ones."""
        return self._joint.gradient()
