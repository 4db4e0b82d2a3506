"""The solver with landmarks as variables of the graph."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.graph import ExplicitLandmarks, SoftTemplate
from pancam_graph.landmarks import SQUARED, Loss, point_sigma_m, refine
from pancam_graph.solve._optimise import Elimination, Iteration, OnGraph, Outcome, optimise
from pancam_graph.solve._problem import Problem, Solver
from pancam_graph.solve._stopping import LEFT_SIGMAS, StopRule

__all__ = ["ExplicitSolver"]

_WEAK_RANGE_SIGMA = 0.3
"""Relative sigma of its range above which a landmark gets the weak prior."""
_STRETCHED = 500.0
"""Ratio of the sigmas of a landmark in range and sideways that GTSAM's Cholesky does not bear."""
_ROUNDS = 6
"""Largest number of optimisations, each with the weak priors centred anew."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Weak:
    """Landmarks whose range is hardly determined."""

    needs_prior: BoolArray
    """(landmarks,) whether it needs the weak prior for a regular system"""
    prior_m: FloatArray
    """(landmarks,) sigma of that prior: ten times the distance, far above the information of images"""
    stretched: BoolArray
    """(landmarks,) whether its sigma in range is too large for GTSAM's Cholesky"""
    bearable_m: FloatArray
    """(landmarks,) sigma of a prior that Cholesky bears, for steps after which landmarks are placed anew"""


class ExplicitSolver(Solver):
    """Each landmark is a variable `L`: simple, slow, and independent of the eliminated solver."""

    def __init__(self, on_iteration: Callable[[Iteration], None] | None) -> None:
        super().__init__(on_iteration)
        self._is_near = False

    def approach(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> Problem:
        """Gauss-Newton on all variables; see `_approach`."""
        return self._approach(problem, rule, loss, stage)[0]

    def _approach(
        self, problem: Problem, rule: StopRule, loss: Loss, stage: str
    ) -> tuple[Problem, list[float]]:
        """Gauss-Newton on all variables, with landmarks placed anew after every step.

        Far from the optimum the linear step of a landmark may lead behind a camera or beyond infinity, and
        would shorten the steps of all others. So a step is judged with landmarks optimised for its cameras.
        """
        problem = _placed(problem, loss)
        template = _soft(problem)
        explicit, present = ExplicitLandmarks(template, problem.measurements), problem.present
        observed = explicit.beside_landmarks(problem.factors.given)
        observed.push_back(explicit.factors(problem.kept, loss))

        def values_of(p: Problem) -> gtsam.Values:
            return explicit.with_landmarks(p.values, p.points_m(), present)

        cost = float(observed.error(values_of(problem)))
        costs = [cost]
        elimination = Elimination(observed, values_of(problem))
        for number in range(1, rule.max_iterations + 1):
            weak = _weak(problem)
            graph = gtsam.NonlinearFactorGraph(observed)
            graph.push_back(explicit.proximal_factors(problem.points_m(), weak.bearable_m, weak.stretched))
            step = elimination.step(graph, values_of(problem))
            before = cost
            for shrink in (1.0, 0.25, 0.0625, 0.0156):
                moved = explicit.retract(problem.values, step, shrink)
                trial = _placed(replace(problem, values=moved), loss)
                cost = float(observed.error(values_of(trial)))
                if cost < before:
                    break
            else:
                break
            problem = trial
            costs.append(cost)
            if self.on_iteration is not None:
                self.on_iteration(Iteration(stage=stage, number=number, cost=cost))
            if before - cost <= rule.relative_decrease * cost:
                break
        return problem, costs

    def adjust(self, problem: Problem, rule: StopRule) -> tuple[Problem, Outcome]:
        """Levenberg-Marquardt on all variables, repeated while landmarks under a weak prior still move.

        The first call begins with `approach`, and then rejects observations of landmarks behind their camera.
        """
        costs: list[float] = []
        if not self._is_near:
            rule_afar = StopRule(max_iterations=20, relative_decrease=1e-4)
            problem, costs = self._approach(problem, rule_afar, SQUARED, "approach")
            _, in_front = problem.residuals
            problem = replace(problem, accepted=problem.accepted & in_front)
            self._is_near = True
        for _ in range(_ROUNDS):
            problem, outcome = self._adjust(problem, rule)
            gained = outcome.costs[0] - outcome.costs[-1]
            costs += outcome.costs[1:] if costs else outcome.costs
            if not outcome.converged:
                break
            if gained <= 1e-6 * costs[-1] or not _weak(problem).needs_prior.any():
                break
        return problem, replace(outcome, costs=tuple(costs))

    def _adjust(self, problem: Problem, rule: StopRule) -> tuple[Problem, Outcome]:
        problem = _placed(problem, SQUARED)
        template = _soft(problem)
        explicit, present, weak = (
            ExplicitLandmarks(template, problem.measurements),
            problem.present,
            _weak(problem),
        )
        points = problem.points_m()
        graph = explicit.beside_landmarks(problem.factors.given)
        graph.push_back(explicit.factors(problem.kept))
        graph.push_back(explicit.proximal_factors(points, weak.prior_m, weak.needs_prior))
        values = explicit.with_landmarks(problem.values, points, present)
        elimination = Elimination(graph, values, by_qr=bool(weak.stretched.any()))
        held = explicit.calibrations.held(template.held_columns())
        outcome = optimise(
            lambda: OnGraph(graph, values, rule, elimination, held),
            rule,
            n_observations=int(problem.kept.sum()),
            on_iteration=self.on_iteration,
            left_sigmas=LEFT_SIGMAS,
        )
        points = np.where(present[:, None], explicit.points_m(outcome.values, present), points)
        adjusted = problem.at(explicit.only_cameras(outcome.values), problem.landmarks.moved_to(points))
        if explicit.calibrations.any and not adjusted.residuals[1][problem.kept].all():
            raise SolveError(
                "explicit landmarks: expected all in front of their cameras, found some behind, which "
                "GTSAM's factor of a free calibration does not count; eliminated landmarks bear it"
            )
        return adjusted, outcome


def _soft(problem: Problem) -> SoftTemplate:
    assert isinstance(problem.template, SoftTemplate)
    return problem.template


def _placed(problem: Problem, loss: Loss) -> Problem:
    """The problem with landmarks optimised for the present cameras."""
    if not problem.kept.any():
        raise SolveError("observations: expected tracks that agree in two or more images, found none")
    m, weight = problem.measurements, problem.accepted.astype(float)
    return replace(problem, landmarks=refine(problem.landmarks, m, problem.views, weight, loss))


def _weak(problem: Problem) -> _Weak:
    """Landmarks with a poorly determined range, and those that need the weak prior."""
    m, views, points, present = problem.measurements, problem.views, problem.points_m(), problem.present
    distance = np.linalg.norm(points - problem.landmarks.origin_m, axis=1)
    sigma = point_sigma_m(points, m, views, problem.accepted)
    sideways = distance * m.typical_sigma_px / float(np.median(views.calibration[:, 0, 0]))
    return _Weak(
        needs_prior=present & (sigma > _WEAK_RANGE_SIGMA * distance),
        prior_m=10 * distance,
        stretched=present & (sigma > _STRETCHED * sideways),
        bearable_m=2 * _STRETCHED * sideways,
    )
