"""Stage 6, solution: an optimum beside what was there before, as data that users read."""

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.data import PixelNoise, RigTreatment, Solution, StereoCovariance
from pancam_graph.rigs import RigCovariance
from pancam_graph.solve._fit import Fitted
from pancam_graph.solve._judge import Judged, state_of
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._stereo import stereo_covariance

__all__ = ["solution_of"]


def solution_of(judged: Judged) -> Solution:
    """The solution, without the seconds that it took."""
    fitted, outcome, covariances = judged.fitted, judged.fitted.outcome, judged.stated
    screened, problem = fitted.screened, fitted.problem
    prepared, first = screened.prepared, judged.first
    n, present = len(prepared.observations), problem.present
    return Solution(
        traverse=prepared.traverse,
        model=prepared.options.model,
        landmarks=prepared.options.landmarks,
        method=prepared.options.method,
        converged=outcome.converged,
        stop_reason=outcome.reason,
        iterations=len(outcome.costs) - 1,
        cost_history=outcome.costs,
        cost_initial=first.cost(),
        cost_final=problem.cost(),
        initial=state_of(first),
        final=judged.state,
        landmark_track=prepared.landmark_track,
        used=judged.used,
        reason=_reasons(fitted),
        residual_initial_px=_raw_residuals(first, present, n, fitted.noise),
        residual_final_px=_raw_residuals(problem, present, n, fitted.noise),
        sigma_px=fitted.noise.sigma_px,
        covariance_px2=fitted.noise.covariance_px2,
        stop_covariance=covariances.stop_covariance,
        angle_sigma_rad=covariances.angle_sigma_rad,
        landmark_covariance_m2=covariances.landmark_covariance_m2,
        stereo_covariance=_stereo_covariance(judged),
        mast_covariance=covariances.masts,
        came_back=judged.used & screened.set_aside,
        refined=problem.template.refined(problem.values, covariances.rig_sigmas),
        treatment=_treatment(fitted),
        sharing=prepared.sharing,
        rig_covariance=_rig_covariance(judged),
        verdict=judged.verdict,
        warnings=judged.warnings,
    )


def _treatment(fitted: Fitted) -> RigTreatment:
    """`Solution.treatment` of a fit."""
    prepared = fitted.screened.prepared
    given = prepared.given_sharing
    if given is None:
        return prepared.options.rig
    return "estimated" if given.any_free else "held"


def _stereo_covariance(judged: Judged) -> StereoCovariance | None:
    """`Solution.stereo_covariance` of a fit."""
    fitted, found = judged.fitted, judged.stated.variables
    if not fitted.screened.prepared.options.stereo_covariances or found is None:
        return None
    return stereo_covariance(fitted.problem, found)


def _rig_covariance(judged: Judged) -> RigCovariance | None:
    """`Solution.rig_covariance` of a fit."""
    fitted, found = judged.fitted, judged.stated.variables
    prepared, template = fitted.screened.prepared, fitted.problem.template
    if prepared.given_sharing is not None or prepared.options.rig != "estimated" or found is None:
        return None
    if not template.rig_variables.keys:
        return None
    return template.rig_variables.rig_covariance(fitted.problem.values, found, template.linkage)


def _reasons(fitted: Fitted) -> tuple[str, ...]:
    """Why each observation was left out; "" for those used."""
    problem, reason = fitted.problem, fitted.screened.prepared.reason.copy()
    reason[fitted.behind] = "behind"
    row, kept = problem.measurements.row, problem.kept
    for rows, word in ((row[problem.accepted & ~kept], "single"), (row[~problem.accepted], "outlier")):
        reason[rows] = np.where(reason[rows] == "", word, reason[rows])
    return tuple(reason.tolist())


def _raw_residuals(problem: Problem, present: BoolArray, n: int, noise: PixelNoise) -> FloatArray:
    """Projected minus measured (n, 2) in raw pixels; NaN where there is no landmark in front."""
    m = problem.measurements
    whitened, in_front = problem.residuals
    residual_px = np.full((n, 2), np.nan)
    known = np.flatnonzero(present[m.landmark] & in_front)
    rows = m.row[known]
    residual_px[rows] = noise.select(rows).to_pixels(whitened.take(known, axis=0))
    return residual_px
