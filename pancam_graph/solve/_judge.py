"""Stage 4, judge: how sure an optimum is, what speaks against it, and the verdict."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.data import State, Verdict
from pancam_graph.elimination import Covariance
from pancam_graph.landmarks import refine
from pancam_graph.solve._considered import considered
from pancam_graph.solve._constraint_tests import ConstraintTest, constraint_tests
from pancam_graph.solve._constraints import constrained
from pancam_graph.solve._covariance import Uncertainty, uncertainty
from pancam_graph.solve._diagnose import connection_warnings, listed
from pancam_graph.solve._fit import Fitted, regular
from pancam_graph.solve._let_go import parts_let_go, sentence
from pancam_graph.solve._prepare import triangulated
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._reduced import ReducedSystem
from pancam_graph.solve._verdict import Optimum, verdict

__all__ = ["Judged", "judge", "reduced_of", "regular_problem", "state_of"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """A fit with its uncertainties and warnings."""

    fitted: Fitted
    state: State
    """Poses, angles and landmarks at the optimum."""
    uncertainty: Uncertainty
    """As the problem has it, for tests; a rig that was held counts as exact."""
    stated: Uncertainty
    """As the solution states it: with the uncertainty of a rig that is considered; else the same."""
    used: BoolArray
    """(observations,) whether each took part in the fit."""
    regular: Problem
    """The problem as covariances are taken from it."""
    first: Problem
    """The start, with the measurements of the optimum and the landmarks that fit the start best: what is
    gained from there to the optimum is due to the cameras alone."""
    constraints: tuple[ConstraintTest, ...]
    """A test of each constraint; none where covariances are unknown."""
    verdict: Verdict
    warnings: tuple[str, ...]
    """Warnings of all stages, a sentence each."""


def judge(fitted: Fitted) -> Judged:
    """Covariances at the optimum, and warnings of what a user should know before believing it."""
    prepared, problem = fitted.screened.prepared, fitted.problem
    state = state_of(problem)
    covariances, regular, reduced, warnings = _uncertainty(fitted, state)
    m, used = problem.measurements, np.zeros(len(prepared.observations), dtype=bool)
    used[m.row[problem.kept]] = True
    first = _first(fitted)
    stated = covariances
    if prepared.options.rig == "considered" and reduced is not None:
        places = problem.landmarks if prepared.options.landmark_covariances else None
        stated = considered(fitted, regular, state, covariances, landmarks=places)
    let_go = parts_let_go(prepared.traverse, problem.template.let_go, state)
    constraints = tuple(constraint_tests(regular, reduced, covariances.variables))
    return Judged(
        fitted=fitted,
        state=state,
        uncertainty=covariances,
        stated=stated,
        used=used,
        regular=regular,
        first=first,
        constraints=constraints,
        verdict=verdict(
            Optimum(
                fitted=fitted,
                problem=regular,
                reduced=reduced,
                uncertainty=covariances,
                used=used,
                cost_initial=first.cost(),
                let_go=let_go,
                constraints=constraints,
            )
        ),
        warnings=(
            *prepared.warnings,
            *(f"{sentence(part)}: let go" for part in let_go),
            *(f"{one.says}: let go" for one in constraints if one.let_go),
            *warnings,
            *_fit_warnings(fitted, used, reduced, covariances),
            *connection_warnings(prepared.traverse, m.image[problem.kept], m.landmark[problem.kept]),
        ),
    )


def state_of(problem: Problem) -> State:
    """The state of a problem; points that take no part are NaN."""
    points = np.where(problem.present[:, None], problem.points_m(), np.nan)
    return problem.template.state(problem.values, points, problem.views)


def regular_problem(fitted: Fitted) -> Problem:
    """The problem as covariances are taken from it."""
    problem = regular(fitted.screened.prepared, fitted.problem)
    return problem if fitted.expected is None else problem.at(problem.values, fitted.expected)


def reduced_of(fitted: Fitted, problem: Problem) -> ReducedSystem:
    """`regular_problem` with landmarks eliminated; the fit's own system where the problem is the fit's."""
    if fitted.ended is not None and fitted.ended.problem is problem:
        return fitted.ended.reduced()
    return ReducedSystem.of(problem, without=fitted.doubt)


def _uncertainty(
    fitted: Fitted, state: State
) -> tuple[Uncertainty, Problem, ReducedSystem | None, list[str]]:
    """Covariances, the problem and reduced system that they are of, and warnings of what is badly known.

    Where a direction is free, covariances are NaN and there is no reduced system.
    """
    prepared, problem = fitted.screened.prepared, regular_problem(fitted)
    places = fitted.problem.landmarks if prepared.options.landmark_covariances else None
    # Radii of circles are free unasked: what holds them is then no news.
    asked = prepared.given_sharing is not None
    try:
        reduced = reduced_of(fitted, problem)
        if places is None:
            reduced.system.rest()
        covariances = uncertainty(problem, state, reduced, landmarks=places, unseen=asked)
        reduced.system.rest()
    except SolveError as error:
        return _unknown(fitted), problem, None, [f"no uncertainties: {error}"]
    warnings = []
    if covariances.unseen:
        warnings.append(
            f"images say next to nothing of {listed(covariances.unseen, 'direction')} of the rig: telemetry "
            "and priors hold them, and their sigmas are as good as these"
        )
    tracks = [str(track) for track in prepared.landmark_track[covariances.undetermined]]
    if tracks:
        warnings.append(
            f"{listed(tracks, 'track')}: their rays leave the place of the point open; "
            "they tell where cameras point, and a weak prior holds the point"
        )
    return covariances, problem, reduced, warnings


def _first(fitted: Fitted) -> Problem:
    """`Judged.first` of a fit."""
    prepared, problem = fitted.screened.prepared, fitted.problem
    first, m = constrained(prepared.problem, placed=False), problem.measurements
    if problem.template.let_go:
        first = first.letting_go(problem.template.let_go)
    if m is first.measurements and problem.accepted.all():
        return first
    return triangulated(first.having(measurements=m, accepted=problem.accepted)).placed()


def _unknown(fitted: Fitted) -> Uncertainty:
    """NaN for every covariance."""
    prepared = fitted.screened.prepared
    t, n = prepared.traverse, len(prepared.landmark_track)
    return Uncertainty(
        stop_covariance=np.full((len(t.stops), 6, 6), np.nan),
        angle_sigma_rad=np.full((len(t.frames), 2), np.nan),
        landmark_covariance_m2=np.full((n, 3, 3), np.nan) if prepared.options.landmark_covariances else None,
        undetermined=np.zeros(n, dtype=bool),
        rig_sigmas=None,
    )


def _fit_warnings(
    fitted: Fitted, used: BoolArray, reduced: ReducedSystem | None, covariances: Uncertainty
) -> list[str]:
    """Warnings of observations that a fit gave up, or keeps against the odds."""
    prepared, warnings = fitted.screened.prepared, []
    n_behind = int(fitted.behind.sum())
    if n_behind:
        warnings.append(f"{n_behind} observations of landmarks behind a camera: left out")
    beyond = _diverging(fitted.problem, reduced, covariances.variables)
    diverging = [str(track) for track in prepared.landmark_track[beyond]]
    if diverging:
        warnings.append(
            f"{listed(diverging, 'track')}: rays diverge by more than noise, as wrong matches do; "
            "kept, as points beyond infinity"
        )
    share = 1 - used.sum() / len(used)
    if prepared.options.loss != "none" and share > 0.3:
        warnings.append(
            f"{share:.0%} of the observations were rejected; check matches, rig and telemetry sigmas"
        )
    return warnings


def _diverging(problem: Problem, reduced: ReducedSystem | None, variables: Covariance | None) -> BoolArray:
    """Landmarks (landmarks,) that would fit worse by 3 sigma if they were no further than infinity.

    Sigmas are those of noise and cameras together, where the covariance of the cameras' variables is known.
    """
    beyond = problem.present & (problem.landmarks.vector[:, 3] < 0)
    if beyond.any():
        m, rows = problem.measurements, np.flatnonzero(beyond)
        weight = problem.accepted.astype(float)
        bound = problem.having(
            landmarks=refine(problem.landmarks, m, problem.views, weight, only=rows)
        ).residuals[0]
        excess = weight * np.sum(bound**2 - problem.residuals[0] ** 2, axis=1)
        square = np.bincount(m.landmark, excess, minlength=m.n_landmarks)
        beyond &= square > 9.0
        if beyond.any() and reduced is not None and variables is not None:
            beyond &= square > 9.0 * _by_cameras(problem, reduced, variables, beyond)
    return beyond


def _by_cameras(
    problem: Problem, reduced: ReducedSystem, variables: Covariance, only: BoolArray
) -> FloatArray:
    """Variance (landmarks,) of the range of landmarks, over what it would be if cameras were exact.

    1 for those that are not among `only` (landmarks,).
    """
    of_system = only[reduced.rows]
    along = problem.landmarks.vector[reduced.rows, :3]
    with_cameras, alone = (
        np.einsum("ni,nij,nj->n", along, reduced.system.landmark_covariance_m2(c, only=of_system), along)
        for c in (variables, None)
    )
    out = np.ones(len(problem.landmarks.vector))
    known = np.isfinite(with_cameras) & (alone > 0) & np.isfinite(alone)
    out[reduced.rows[known]] = with_cameras[known] / alone[known]
    return out
