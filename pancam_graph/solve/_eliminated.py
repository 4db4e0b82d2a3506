"""The solver with landmarks eliminated: Levenberg-Marquardt on the variables of cameras."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.geometry import IntArray
from pancam_graph.elimination import Root
from pancam_graph.graph import HardTemplate
from pancam_graph.landmarks import SQUARED, CameraViews, Loss
from pancam_graph.solve._joint import JointSystem, OnLastGroup
from pancam_graph.solve._optimise import Iteration, Outcome, optimise
from pancam_graph.solve._problem import EliminatedLandmarks, Problem, Solver, system_of
from pancam_graph.solve._reduced import ReducedSystem
from pancam_graph.solve._stopping import LEFT_SIGMAS, StopRule

__all__ = ["EliminatedSolver", "Ended"]


_FOLLOWING = 1e-4
"""Landmarks count as settled where placing strays anew lowers the cost by at most this share."""


class EliminatedSolver(Solver):
    """Levenberg-Marquardt with landmark blocks (factors/landmark_blocks.py)."""

    def __init__(self, on_iteration: Callable[[Iteration], None] | None, *, is_near: bool = False) -> None:
        """`is_near`: initial cameras are good, so that no rigid mast is fitted first."""
        super().__init__(on_iteration)
        self._is_near = is_near
        self._last: Ended | None = None

    def approach(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> Problem:
        """As `adjust`, with a robust loss: unit 4-vectors converge from poor initial values too."""
        return self._fit(problem, rule, loss, stage)[0]

    def adjust(self, problem: Problem, rule: StopRule) -> tuple[Problem, Outcome]:
        """Levenberg-Marquardt; observations of landmarks behind their camera are then rejected."""
        problem, outcome = self._fit(problem, rule, SQUARED, "solve", LEFT_SIGMAS)
        if self._last is None or not self._last.system.any_behind:
            return problem, outcome
        _, in_front = problem.residuals
        problem, again = self._fit(
            problem.having(accepted=problem.accepted & in_front), rule, SQUARED, "solve", LEFT_SIGMAS
        )
        return problem, replace(again, costs=outcome.costs + again.costs[1:])

    def _fit(
        self, problem: Problem, rule: StopRule, loss: Loss, stage: str, left_sigmas: float = np.inf
    ) -> tuple[Problem, Outcome]:
        costs: tuple[float, ...] = ()
        if not self._is_near and problem.template.has_cameras:
            problem, outcome = self._fit_rigid(problem, loss, stage)
            costs = outcome.costs[:-1]
        self._is_near = True
        problem, outcome = self._from_near(problem, rule, loss, stage, left_sigmas)
        return problem, replace(outcome, costs=costs + outcome.costs)

    def _from_near(
        self, problem: Problem, rule: StopRule, loss: Loss, stage: str, left_sigmas: float
    ) -> tuple[Problem, Outcome]:
        """Minimise from good initial cameras, without a fit of a rigid mast."""
        return self._minimise(problem, rule, loss, stage, left_sigmas)

    def _fit_rigid(self, problem: Problem, loss: Loss, stage: str) -> tuple[Problem, Outcome]:
        """The problem with its cameras at the optimum of a rigid mast.

        From poor initial values a linear step of camera poses leaves the circle of the mast's rotation by
        more than the sigma of a firm tie. The rigid mast has no such poses.
        """
        rule = StopRule(max_iterations=20, relative_decrease=1e-4)
        template = problem.template
        rigid = HardTemplate(template.traverse, template.rig_variables.sharing)
        rigid_problem, outcome = self._minimise(problem.on(rigid), rule, loss, stage)
        return rigid_problem.on(problem.template), outcome

    def _minimise(
        self, problem: Problem, rule: StopRule, loss: Loss, stage: str, left_sigmas: float = np.inf
    ) -> tuple[Problem, Outcome]:
        template = problem.template
        if not template.linkage.touched.any():
            return _only_landmarks(problem, loss)
        system, rows = system_of(problem, loss)
        # Images alone leave directions of a free rig next to undetermined, and rounding in their square root
        # exceeds what priors say of these: stops are eliminated with all priors in the system.
        joint = JointSystem(problem, system)
        outcome = optimise(
            lambda: OnLastGroup(joint, rule),
            rule,
            n_observations=int(problem.kept.sum()),
            stage=stage,
            on_iteration=self.on_iteration,
            gain_ahead=lambda _values: _gain_ahead(system, joint.root),
            left_sigmas=left_sigmas,
        )
        return self._ended(problem, outcome, system, rows, joint.known_root, joint.views), outcome

    def _ended(
        self,
        problem: Problem,
        outcome: Outcome,
        system: EliminatedLandmarks,
        rows: IntArray,
        joint: Root | None = None,
        views: CameraViews | None = None,
    ) -> Problem:
        """The problem at the end of a fit, which is kept as `last`; `views` are its cameras, if known."""
        vector = problem.landmarks.vector.copy()
        vector[rows] = system.landmarks().vector
        fitted = problem.at(outcome.values, replace(problem.landmarks, vector=vector), views)
        self._last = Ended(problem=fitted, system=system, rows=rows, joint=joint)
        return fitted

    @property
    def last(self) -> "Ended | None":
        """End of the last fit; None before the first."""
        return self._last


@dataclass(frozen=True, kw_only=True, eq=False)
class Ended:
    """End of a fit."""

    problem: Problem
    """The problem with its values at the optimum."""
    system: EliminatedLandmarks
    """The eliminated system of the observations that take part."""
    rows: IntArray
    """(n,) rows of the system's landmarks among all."""
    joint: Root | None
    """Square root of the whole system at the problem's values, where the iterations computed it; the landmark
    system is then linearised there."""

    def reduced(self) -> ReducedSystem:
        """The reduced system, linearised at the end of the fit.

        Raises SolveError where a direction is undetermined.
        """
        if self.joint is None:
            return ReducedSystem.of(self.problem, (self.system, self.rows))
        return ReducedSystem.by_root(self.system, self.rows, self.joint).firm(self.problem)


def _gain_ahead(system: EliminatedLandmarks, root: Callable[[], Root]) -> float | None:
    """Decrease of the linearised cost by the next step; None while strays are still placed anew."""
    if system.regained > _FOLLOWING * system.moved_cost:
        return None
    return root().gain() + system.gain_alone


def _only_landmarks(problem: Problem, loss: Loss) -> tuple[Problem, Outcome]:
    """Optimum of the landmarks alone, where telemetry holds every camera."""
    placed = problem.placed(loss)
    costs = (problem.cost(loss), placed.cost(loss))
    return placed, Outcome(
        values=problem.values, converged=True, reason="nothing but landmarks to place", costs=costs
    )
