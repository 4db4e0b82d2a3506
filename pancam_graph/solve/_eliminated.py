"""Landmarks eliminated: Levenberg-Marquardt on the cameras' variables, landmarks follow."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam

from pancam_graph.base.geometry import IntArray
from pancam_graph.elimination import LandmarkSystem, Root
from pancam_graph.factors import LandmarkBlocks
from pancam_graph.graph import HardTemplate, read_variable
from pancam_graph.landmarks import SQUARED, Loss
from pancam_graph.solve._joint import JointSystem, OnLastGroup
from pancam_graph.solve._optimise import InOrder, Iteration, OnGraph, Outcome, optimise, parameters_of
from pancam_graph.solve._problem import Problem, Solver, system_of
from pancam_graph.solve._reduced import ReducedSystem, joint_root
from pancam_graph.solve._stopping import StopRule

__all__ = ["EliminatedSolver", "Ended"]


_FOLLOWING = 1e-4
"""Landmarks follow the cameras where placing strays anew lowers the cost by no more than this share."""


class EliminatedSolver(Solver):
    """Landmark blocks (factors/landmark_blocks.py): landmarks follow the variables of the graph."""

    def __init__(self, on_iteration: Callable[[Iteration], None] | None, *, is_near: bool = False) -> None:
        """`is_near`: cameras start where they were given, and no rigid mast is fitted first."""
        super().__init__(on_iteration)
        self._is_near = is_near
        self._last: Ended | None = None

    def approach(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> Problem:
        """The same as `adjust`, but for the loss: unit 4-vectors do not go astray from afar."""
        return self._fit(problem, rule, loss, stage)[0]

    def adjust(self, problem: Problem, rule: StopRule) -> tuple[Problem, Outcome]:
        """Levenberg-Marquardt; observations of landmarks behind their camera are no longer accepted."""
        problem, outcome = self._fit(problem, rule, SQUARED, "solve")
        if self._last is None or not self._last.system.any_behind:
            return problem, outcome
        _, in_front = problem.residuals()
        problem, again = self._fit(
            replace(problem, accepted=problem.accepted & in_front), rule, SQUARED, "solve"
        )
        return problem, replace(again, costs=outcome.costs + again.costs[1:])

    def _fit(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> tuple[Problem, Outcome]:
        costs: tuple[float, ...] = ()
        if not self._is_near and problem.template.has_cameras:
            problem, outcome = self._fit_rigid(problem, loss, stage)
            costs = outcome.costs[:-1]
        self._is_near = True
        problem, outcome = self._from_near(problem, rule, loss, stage)
        return problem, replace(outcome, costs=costs + outcome.costs)

    def _from_near(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> tuple[Problem, Outcome]:
        """Least cost where a rigid mast is no better place to start from."""
        return self._minimise(problem, rule, loss, stage)

    def _fit_rigid(self, problem: Problem, loss: Loss, stage: str) -> tuple[Problem, Outcome]:
        """The problem with its cameras where a rigid mast fits best.

        From afar a straight step of camera poses leaves the circle on which a mast turns them, by more than
        the sigma of a firm tie. The rigid mast has no such poses.
        """
        rule = StopRule(max_iterations=20, relative_decrease=1e-4)
        template = problem.template
        rigid = HardTemplate(template.traverse, template.rig_variables.sharing)
        found, outcome = self._minimise(problem.on(rigid), rule, loss, stage)
        return found.on(problem.template), outcome

    def _minimise(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> tuple[Problem, Outcome]:
        template = problem.template
        if not template.linkage.touched.any():
            return _only_landmarks(problem, loss)
        system, rows = system_of(problem, loss)
        minimise = self._by_groups if template.has_cameras else self._by_blocks
        outcome, joint = minimise(problem, system, rule, stage)
        return self._ended(problem, outcome, system, rows, joint), outcome

    def _by_groups(
        self, problem: Problem, system: LandmarkSystem, rule: StopRule, stage: str
    ) -> tuple[Outcome, Root | None]:
        """Least cost on the last group, all others eliminated: where each image has a variable of its own."""
        joint = JointSystem(problem, system)

        outcome = optimise(
            lambda: OnLastGroup(joint, rule),
            rule,
            n_observations=int(problem.kept.sum()),
            stage=stage,
            on_iteration=self.on_iteration,
            gain_ahead=lambda _values: _gain_ahead(system, joint.root),
        )
        return outcome, joint.known_root

    def _by_blocks(
        self, problem: Problem, system: LandmarkSystem, rule: StopRule, stage: str
    ) -> tuple[Outcome, Root | None]:
        """Least cost by GTSAM on landmark blocks: where few variables move many images."""
        template = problem.template
        blocks = LandmarkBlocks(system, read_variable, template.posture)
        graph = gtsam.NonlinearFactorGraph(problem.factors.graph)
        for factor in blocks.factors():
            graph.push_back(factor)
        joint: Root | None = None

        def root(values: gtsam.Values) -> Root:
            nonlocal joint
            joint = joint_root(template, problem.factors, values, blocks.panels(values))
            return joint

        parameters = parameters_of(rule, InOrder(blocks.ordering()))
        outcome = optimise(
            lambda: OnGraph(graph, problem.values, parameters, template.held_columns()),
            rule,
            n_observations=int(problem.kept.sum()),
            stage=stage,
            on_iteration=self.on_iteration,
            gain_ahead=lambda values: _gain_ahead(system, lambda: root(values)),
        )
        if blocks.settle(outcome.values):
            joint = None  # it was that of another point
        return outcome, joint

    def _ended(
        self,
        problem: Problem,
        outcome: Outcome,
        system: LandmarkSystem,
        rows: IntArray,
        joint: Root | None = None,
    ) -> Problem:
        """The problem where a fit ended; where it ended is kept as `last`."""
        vector = problem.landmarks.vector.copy()
        vector[rows] = system.landmarks().vector
        found = problem.at(outcome.values, replace(problem.landmarks, vector=vector))
        self._last = Ended(problem=found, system=system, rows=rows, joint=joint)
        return found

    @property
    def last(self) -> "Ended | None":
        """Where the last fit ended; None before the first."""
        return self._last


@dataclass(frozen=True, kw_only=True, eq=False)
class Ended:
    """Where a fit ended."""

    problem: Problem
    system: LandmarkSystem
    rows: IntArray
    """The system's landmarks among all."""
    joint: Root | None
    """Of the whole system at the problem's values, where the iterations ended by it; the system is
    linearised there then."""

    def reduced(self) -> ReducedSystem:
        """The problem with landmarks eliminated, linearised where the fit ended.

        Raises SolveError where a direction is held by nothing.
        """
        if self.joint is None:
            return ReducedSystem.of(self.problem, (self.system, self.rows))
        return ReducedSystem(system=self.system, rows=self.rows, root=self.joint)


def _gain_ahead(system: LandmarkSystem, root: Callable[[], Root]) -> float | None:
    """As the linearised system has it; told once landmarks follow without being placed anew."""
    if system.regained > _FOLLOWING * system.moved_cost:
        return None
    return root().gain() + system.gain_alone


def _only_landmarks(problem: Problem, loss: Loss) -> tuple[Problem, Outcome]:
    """Where telemetry holds every camera there are only landmarks to place."""
    found = problem.placed(loss)
    costs = (problem.cost(loss), found.cost(loss))
    return found, Outcome(
        values=problem.values, converged=True, reason="nothing but landmarks to place", costs=costs
    )
