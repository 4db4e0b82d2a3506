"""Landmarks eliminated: Levenberg-Marquardt on the cameras' variables, landmarks follow."""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph._optimise import InOrder, Iteration, Outcome, StopRule, optimise
from pancam_graph._problem import Problem, Solver
from pancam_graph.elimination import LandmarkSystem
from pancam_graph.errors import SolveError
from pancam_graph.factors import LandmarkBlocks
from pancam_graph.geometry import BoolArray, IntArray
from pancam_graph.graph import HardTemplate, SoftTemplate, read_variable
from pancam_graph.landmarks import Landmarks, evaluate, refine
from pancam_graph.losses import SQUARED, Loss

__all__ = ["EliminatedSolver", "system_of"]

_RETRIES = 3


class EliminatedSolver(Solver):
    """Landmark blocks (factors/landmark_blocks.py): landmarks follow the variables of the graph."""

    def __init__(self, on_iteration: Callable[[Iteration], None] | None) -> None:
        super().__init__(on_iteration)
        self._is_near = False

    def approach(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> Problem:
        """The same as `adjust`, but for the loss: unit 4-vectors do not go astray from afar."""
        return self._fit(problem, rule, loss, stage)[0]

    def adjust(self, problem: Problem, rule: StopRule) -> tuple[Problem, Outcome]:
        """Levenberg-Marquardt; observations of landmarks behind their camera are no longer accepted."""
        problem, outcome = self._fit(problem, rule, SQUARED, "solve")
        ahead = _in_front(problem)
        return replace(problem, accepted=problem.accepted & ahead), outcome

    def _fit(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> tuple[Problem, Outcome]:
        costs: list[float] = []
        if not self._is_near and isinstance(problem.template, SoftTemplate):
            problem, outcome = self._fit_rigid(problem, loss, stage)
            costs += outcome.costs
        self._is_near = True
        ahead = _in_front(problem)
        for _ in range(_RETRIES):
            problem, outcome = self._fit_ahead(problem, ahead, rule, loss, stage)
            costs += outcome.costs[1:] if costs else outcome.costs
            # What was behind its camera at the start may now be where the camera sees it.
            before, ahead = ahead, _in_front(problem)
            if not np.any(problem.kept & ahead & ~before):
                break
        return problem, replace(outcome, costs=tuple(costs))

    def _fit_rigid(self, problem: Problem, loss: Loss, stage: str) -> tuple[Problem, Outcome]:
        """The problem with cameras where a rigid mast fits best.

        A step from afar bends a firm tie by more than its sigma: a straight step of poses leaves the circle.
        """
        no_landmarks = np.zeros((0, 3))
        rigid = HardTemplate(problem.template.traverse)
        values = rigid.values(problem.template.state(problem.values, no_landmarks))
        start = replace(problem, template=rigid, factors=rigid.factors(), values=values)
        rule = StopRule(max_iterations=20, relative_decrease=1e-4)
        found, outcome = self._fit_ahead(start, _in_front(start), rule, loss, stage)
        values = problem.template.values(rigid.state(found.values, no_landmarks))
        return problem.at(values, found.landmarks), outcome

    def _fit_ahead(
        self, problem: Problem, ahead: BoolArray, rule: StopRule, loss: Loss, stage: str
    ) -> tuple[Problem, Outcome]:
        """Levenberg-Marquardt over the observations that have their landmarks in front."""
        template = problem.template
        system, rows = system_of(problem, ahead, loss)
        if not template.linkage.touched.any():
            return _only_landmarks(problem, loss)
        blocks = LandmarkBlocks(system, read_variable, template.posture)
        graph = gtsam.NonlinearFactorGraph(problem.factors)
        for factor in blocks.factors():
            graph.push_back(factor)
        outcome = optimise(
            graph,
            problem.values,
            rule,
            InOrder(blocks.ordering()),
            stage=stage,
            on_iteration=self.on_iteration,
        )
        blocks.settle(outcome.values)
        found = system.landmarks()
        vector = problem.landmarks.vector.copy()
        vector[rows] = found.vector
        return problem.at(outcome.values, replace(problem.landmarks, vector=vector)), outcome


def system_of(problem: Problem, ahead: BoolArray, loss: Loss = SQUARED) -> tuple[LandmarkSystem, IntArray]:
    """The landmark system of what takes part and is in front, and its rows among the landmarks.

    Raises SolveError where nothing is left.
    """
    m = problem.measurements
    take = problem.kept & ahead
    take &= (np.bincount(m.landmark, take, minlength=m.n_landmarks) >= 2)[m.landmark]
    if not take.any():
        raise SolveError("observations: expected tracks that agree in two or more images, found none")
    rows = np.flatnonzero(np.bincount(m.landmark, take, minlength=m.n_landmarks))
    if not take.all():
        m = m.part(np.flatnonzero(take))
    landmarks = Landmarks(vector=problem.landmarks.vector[rows], origin_m=problem.landmarks.origin_m[rows])
    template = problem.template
    return LandmarkSystem(template.linkage, m, landmarks, loss, cliques=template.cliques), rows


def _in_front(problem: Problem) -> BoolArray:
    return evaluate(problem.landmarks, problem.measurements, problem.views)[2]


def _only_landmarks(problem: Problem, loss: Loss) -> tuple[Problem, Outcome]:
    """Where telemetry holds every camera there are only landmarks to place."""
    weight = problem.accepted.astype(float)
    placed = refine(
        problem.landmarks, problem.measurements, problem.views, weight, loss, beyond_infinity=True
    )
    found = replace(problem, landmarks=placed)
    costs = (problem.cost(loss), found.cost(loss))
    return found, Outcome(
        values=problem.values, converged=True, reason="nothing but landmarks to place", costs=costs
    )
