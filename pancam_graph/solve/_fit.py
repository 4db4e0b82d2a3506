"""Stage 3, fit: least squares over the observations that are used."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.data import FIXED, PixelNoise
from pancam_graph.graph import HardTemplate
from pancam_graph.landmarks import Landmarks
from pancam_graph.solve._constraints import constrained
from pancam_graph.solve._eliminated import EliminatedSolver, Ended
from pancam_graph.solve._far_terrain import FarTerrain, far_terrain
from pancam_graph.solve._optimise import Outcome
from pancam_graph.solve._prepare import Prepared, solver_for
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._screen import Screened

__all__ = ["Fitted", "fit", "fitted_elsewhere", "refitted", "regular"]

_ROUNDS = 6


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """The least-squares optimum of a screened problem."""

    screened: Screened
    problem: Problem
    """The problem with its values at the optimum."""
    outcome: Outcome
    """How the iterations ended; costs of all rounds."""
    noise: PixelNoise
    """Noise of all observations, rescaled where residuals decide how large it is."""
    behind: BoolArray
    """(observations,) whether each was given up because its landmark came to lie behind the camera."""
    ended: Ended | None
    """The solver's own record of where it ended; None where landmarks are explicit, or no fit was made."""
    expected: Landmarks | None = None
    """Landmarks at the inverse ranges where covariances are linearised; None: at those fitted."""
    doubt: Mapping[int, FloatArray] = field(default_factory=dict)
    """By group of variables, (n, n) information there that covariances do without."""


def fit(screened: Screened) -> Fitted:
    """Least squares over what is accepted, until the noise scale does not move any more.

    Where smooth distortion fields are free, once without them and from there once with them. Raises
    SolveError where the system has a direction that nothing holds however much it is damped.
    """
    prepared, problem = screened.prepared, constrained(screened.problem)
    solver = solver_for(prepared.options, prepared.on_iteration, is_near=screened.is_near)
    noise, behind = prepared.noise, np.zeros(len(prepared.observations), dtype=bool)
    costs: list[float] = []
    templates = [problem.template]
    if prepared.sharing.field != FIXED:
        templates.append(HardTemplate(prepared.traverse, prepared.sharing))
    for template in templates:
        problem = problem if template is problem.template else problem.on(template)
        for _ in range(_ROUNDS):
            before = problem.accepted
            problem, outcome = solver.adjust(problem, prepared.options)
            behind[problem.measurements.row[before & ~problem.accepted]] = True
            costs += outcome.costs[1:] if costs else outcome.costs
            if not prepared.rescales_noise:
                break
            factor = noise_factor(problem)
            noise = noise.scaled(factor)
            problem = problem.having(measurements=problem.measurements.scaled(factor))
            if not (abs(factor - 1) > 1e-3 and outcome.converged):
                break
    return _without_range_bias(
        Fitted(
            screened=screened,
            problem=problem,
            outcome=replace(outcome, costs=tuple(costs)),
            noise=noise,
            behind=behind,
            ended=solver.last if isinstance(solver, EliminatedSolver) else None,
        )
    )


def fitted_elsewhere(
    screened: Screened, costs: Sequence[float], reason: str, *, is_optimum: bool = True
) -> Fitted:
    """A problem that was fitted elsewhere, over what it accepts: `costs` on the way, and why that ended.

    Where it is not the optimum of what it accepts, residuals decide how large the noise is, fields are
    free, or there are constraints, the rounds of `fit` follow.
    """
    prepared, problem = screened.prepared, screened.problem
    has_more = prepared.rescales_noise or prepared.sharing.field != FIXED or prepared.traverse.constraints
    if not is_optimum or has_more:
        fitted = fit(screened)
        outcome = fitted.outcome
        return replace(
            fitted,
            outcome=replace(outcome, reason=f"{reason}; {outcome.reason}", costs=(*costs, *outcome.costs)),
        )
    return _without_range_bias(
        Fitted(
            screened=screened,
            problem=problem,
            outcome=Outcome(values=problem.values, converged=True, reason=reason, costs=tuple(costs)),
            noise=prepared.noise,
            behind=np.zeros(len(prepared.observations), dtype=bool),
            ended=None,
        )
    )


def _without_range_bias(fitted: Fitted) -> Fitted:
    """The fit where far terrain's ranges, which are fitted to noise, do not bias it; most often the same."""
    problem, outcome = fitted.problem, fitted.outcome
    if not problem.kept.any():
        return fitted
    far = far_terrain(regular(fitted.screened.prepared, problem))
    if far is None:
        return fitted
    moved = _back(far, problem)
    # Where least squares ended matters no more: it is only where corrections began.
    reason = f"far terrain: corrections of the solution {'settled' if far.converged else 'do not settle'}"
    return replace(
        fitted,
        problem=moved,
        outcome=replace(
            outcome,
            values=moved.values,
            converged=far.converged,
            reason=reason,
            costs=(*outcome.costs, moved.cost()),
        ),
        ended=None,
        expected=far.expected,
        doubt=far.doubt,
    )


def _back(far: FarTerrain, problem: Problem) -> Problem:
    """The corrected problem on the template of the problem that was to be corrected."""
    moved = far.problem
    return moved if moved.template is problem.template else moved.on(problem.template).placed()


def regular(prepared: Prepared, problem: Problem) -> Problem:
    """A problem as its normal equations are taken from it: without a tie so firm that digits are lost."""
    if prepared.options.firm_tie == "hard" and problem.template.has_cameras:
        # The inverse of a system with a tie of 1e-8 would have lost half its digits.
        return problem.on(HardTemplate(prepared.traverse, prepared.sharing))
    return problem


def refitted(fitted: Fitted, landmarks: BoolArray) -> tuple[Problem, Outcome]:
    """Least squares over some landmarks (landmarks,), from where a fit ended.

    From there, so that of several optima it is the one near by; anew from afar where that does not converge,
    since steps with a firm tie are short.
    """
    prepared, whole = fitted.screened.prepared, fitted.problem
    part = replace(whole, accepted=whole.accepted & landmarks[whole.measurements.landmark])
    for is_near in (True, False):
        problem, outcome = solver_for(prepared.options, is_near=is_near).adjust(part, prepared.options)
        if outcome.converged:
            break
    far = far_terrain(regular(prepared, problem)) if fitted.expected is not None else None
    if far is None:
        return problem, outcome
    return _back(far, problem), replace(outcome, converged=far.converged)


def noise_factor(problem: Problem) -> float:
    """By how much residuals exceed the noise assumed: the square root of the variance factor."""
    rows = problem.kept
    residual, _ = problem.residuals
    # Priors add as many equations as they have unknowns, but for what observations say on top of them.
    freedom = 2 * int(rows.sum()) - 3 * int(problem.present.sum())
    if freedom < 1:
        return 1.0
    return float(np.sqrt(np.sum(residual[rows] ** 2) / freedom).clip(1e-3))
