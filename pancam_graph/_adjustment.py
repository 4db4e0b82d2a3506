"""One solve, from measurements to solution."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pancam_graph._covariance import covariances
from pancam_graph._diagnose import connection_warnings
from pancam_graph._optimise import Elimination, Iteration, Outcome, StopRule, optimise
from pancam_graph._rejection import rays_of, screen
from pancam_graph.cameras import carry_to_pinhole
from pancam_graph.errors import InputError, SolveError
from pancam_graph.geometry import BoolArray, FloatArray
from pancam_graph.graph import DEFAULT_TIES, ExplicitLandmarks, FactorTemplate
from pancam_graph.initialise import Start, start_from_telemetry
from pancam_graph.landmarks import (
    CameraViews,
    Landmarks,
    Measurements,
    evaluate,
    point_sigma_m,
    refine,
    triangulate,
)
from pancam_graph.losses import SQUARED, Loss, loss_of
from pancam_graph.options import SolveOptions
from pancam_graph.solution import Solution, State
from pancam_graph.traverse import Observations, Traverse

__all__ = ["Adjustment"]

_LOG = logging.getLogger(__name__)

_SCREENING_ROUNDS = 12
_ABOUT = 0.002
"""The first pass of screening ends when no more than this share of the observations changes."""
_GROSS = 3.0
"""The second begins with what is within this many times the cutoff."""
_FINAL_ROUNDS = 6
_TYPICAL_RANGE_M = 10.0
_FURTHEST_PARALLAX_SIGMAS = 0.01
"""Points are placed no further out than where their parallax is this many sigmas of a pixel."""
_WEAK_RANGE_SIGMA = 0.3
"""A landmark whose range is known to no better than this share of it gets the weak prior."""
_CARRIED_PX = 1e-6
"""Pixels of CAHVORE cameras are carried anew until none moves by more."""
_STRETCHED = 500.0
"""A landmark this many times less certain in range than sideways is too much for GTSAM's Cholesky."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Weak:
    """Landmarks whose range is all but free."""

    needs_prior: BoolArray
    """(landmarks,) whether the weak prior keeps the system regular"""
    prior_m: FloatArray
    """(landmarks,) its sigma: ten times the distance, so that it says nothing"""
    stretched: BoolArray
    """(landmarks,) which are too long in range for GTSAM's Cholesky"""
    bearable_m: FloatArray
    """(landmarks,) sigma of a prior that it bears, for steps whose landmarks are placed anew anyway"""


class Adjustment:
    """State of one solve: measurements, what is accepted, and the current values of everything."""

    def __init__(
        self,
        traverse: Traverse,
        options: SolveOptions,
        start: Start | None,
        on_iteration: Callable[[Iteration], None] | None,
    ) -> None:
        if traverse.observations is None:
            raise InputError(
                "observations: expected some, found none; find them in the images first (find_observations)"
            )
        self.traverse, self.options, self.on_iteration = traverse, options, on_iteration
        self.observations: Observations = traverse.observations
        self.template = FactorTemplate(traverse, options.model, options.tie or DEFAULT_TIES[options.model])
        self.start = start or start_from_telemetry(traverse)
        self.warnings = [*traverse.warnings, *self.start.warnings]
        self.factors = self.template.factors()
        self.initial_values = self._first_values()
        self.values = self.initial_values
        self.sigma_px = self.observations.sigma_px.copy()
        self.reason = np.full(len(self.observations), "", dtype=object)
        self.measurements = self._measure()
        self.landmarks = self._triangulate(self.values, np.ones(len(self.measurements.row)))
        self.points_m = self._points(self.landmarks, self._views(self.values))
        self.accepted = np.ones(len(self.measurements.row), dtype=bool)

    # --- preparation ---

    def _first_values(self) -> gtsam.Values:
        rotations, centres = self.traverse.camera_poses(self.start.world_T_mast, self.start.pan_tilt_rad)
        return self.template.values(
            State(
                world_T_mast=self.start.world_T_mast,
                pan_tilt_rad=self.start.pan_tilt_rad,
                world_R_camera=rotations,
                world_t_camera=centres,
                landmarks_m=np.zeros((0, 3)),
            )
        )

    def _measure(self) -> Measurements:
        """Observations of tracks seen twice or more, carried to the pinholes."""
        obs = self.observations
        uv, turn, valid = self._carry(np.full(len(obs), _TYPICAL_RANGE_M))
        self.reason[~valid] = "outside"
        _, track = np.unique(obs.track, return_inverse=True)
        single = valid & (np.bincount(track, valid)[track] < 2)
        self.reason[single] = "single"
        n_single = int(single.sum())
        if n_single:
            self.warnings.append(
                f"{n_single} track{'s' if n_single != 1 else ''} seen once: left out, one ray places nothing"
            )
        if not valid.all():
            self.warnings.append(
                f"{int((~valid).sum())} observations outside the domain of their camera model: left out"
            )
        rows = np.flatnonzero(valid & ~single)
        if len(rows) == 0:
            raise SolveError("observations: expected tracks seen in two or more images, found none")
        rows = rows[np.lexsort((obs.image[rows], obs.track[rows]))]
        self.landmark_track, landmark = np.unique(obs.track[rows], return_inverse=True)
        return Measurements(
            row=rows,
            image=obs.image[rows],
            landmark=landmark.astype(np.int64),
            uv_px=uv[rows],
            whitening=turn[rows] / obs.sigma_px[rows, None, None],
        )

    def _carry(self, range_m: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        obs, eye = self.observations, self.traverse.image_eye
        uv, turn = np.empty((len(obs), 2)), np.empty((len(obs), 2, 2))
        valid = np.empty(len(obs), dtype=bool)
        for i, entry in enumerate(self.traverse.rig.eyes):
            own = eye[obs.image] == i
            uv[own], turn[own], valid[own] = carry_to_pinhole(entry.camera, obs.uv_px[own], range_m[own])
        return uv, turn, valid

    def _views(self, values: gtsam.Values) -> CameraViews:
        state = self.template.state(values, np.zeros((0, 3)))
        calibration = np.array([p.calibration_matrix for p in self.traverse.rig.pinholes])
        return CameraViews(
            world_R_camera=state.world_R_camera,
            world_t_camera=state.world_t_camera,
            calibration=calibration[self.traverse.image_eye],
        )

    def _triangulate(self, values: gtsam.Values, weight: FloatArray) -> Landmarks:
        """Linear triangulation; a landmark behind a camera starts far off where its cameras look instead."""
        m, views = self.measurements, self._views(values)
        centre, direction = rays_of(m, views)
        landmarks = triangulate(centre, direction, m.landmark, weight)
        _, _, in_front = evaluate(landmarks, m, views)
        behind = np.bincount(m.landmark, ~in_front & (weight > 0), minlength=m.n_landmarks) > 0
        mean = np.add.reduceat(weight[:, None] * direction, m.starts)
        ahead = landmarks.moved_to(landmarks.origin_m + self._reach_m(landmarks, views)[:, None] * mean)
        return replace(landmarks, vector=np.where(behind[:, None], ahead.vector, landmarks.vector))

    # --- the rounds ---

    def run(self) -> Solution:
        """Screen, adjust, and collect."""
        if self.options.loss != "none":
            self._screen_at_start()
            self._screening_rounds()
        outcome = self._final_rounds()
        return self._collect(outcome)

    def _set_aside_behind(self) -> None:
        """Leave out for good what is behind its camera although all else is in place."""
        _, _, in_front = evaluate(self.landmarks, self.measurements, self._views(self.values))
        behind = self.accepted & ~in_front
        self.accepted = self.accepted & ~behind
        self.reason[self.measurements.row[behind]] = "behind"

    def _screen_at_start(self) -> None:
        """Gross outliers, judged with what telemetry may be wrong by added to the noise."""
        m, t = self.measurements, self.traverse
        views = self._views(self.values)
        frame = np.array([max(f.sigma_pan_rad, f.sigma_tilt_rad) for f in t.frames])[t.image_frame[m.image]]
        stop_rad = np.array([s.sigma_rotation_rad for s in t.stops])[t.image_stop[m.image]]
        stop_m = np.array([s.sigma_translation_m for s in t.stops])[t.image_stop[m.image]]
        first = refine(self.landmarks, m, views, self.accepted.astype(float))
        distance = np.linalg.norm(
            self._points(first, views)[m.landmark] - views.world_t_camera[m.image], axis=1
        )
        focal = views.calibration[m.image, 0, 0]
        telemetry_px = focal * np.sqrt(frame**2 + stop_rad**2 + (stop_m / distance.clip(1.0)) ** 2)
        sigma = self.observations.sigma_px[m.row]
        screening = screen(
            self.landmarks,
            m.scaled(np.hypot(sigma, telemetry_px) / sigma),
            views,
            self.accepted,
            cutoff_sigma=self.options.outlier_sigma,
            min_scale=1.0,  # errors of telemetry are common to a frame: a small median must not exclude one
        )
        self.landmarks, self.accepted = screening.landmarks, screening.accepted

    def _screening_rounds(self) -> None:
        """Robust adjustment and screening in turn, until the same observations stay.

        Twice: what is kept should depend on the images, not on the way from the start. So the first pass only
        finds about where the cameras are; the second begins there with all but the grossest outliers.
        """
        cutoff = self.options.outlier_sigma
        scale = 1.0
        for _ in range(_SCREENING_ROUNDS):
            scale, changed = self._screening_round(scale, cutoff, relative_decrease=1e-3)
            if changed <= _ABOUT * len(self.accepted):
                break
        self.accepted = np.ones_like(self.accepted)
        self._screen(_GROSS * cutoff)
        for _ in range(_SCREENING_ROUNDS):
            before = scale
            scale, changed = self._screening_round(scale, cutoff, relative_decrease=1e-6)
            if changed == 0 and abs(scale - before) < 1e-3 * scale:
                break

    def _screening_round(
        self, scale: float, cutoff_sigma: float, *, relative_decrease: float
    ) -> tuple[float, int]:
        """One robust adjustment and screening: the noise scale, and how many observations came or went."""
        rule = StopRule(max_iterations=20, relative_decrease=relative_decrease)
        self._approach(rule, loss_of(self.options.loss, scale), stage="screening")
        before = self.accepted
        scale = self._screen(cutoff_sigma)
        changed = int(np.sum(before != self.accepted))
        _LOG.info(
            "screening: %d of %d observations kept, %d changed, noise %.2f sigma",
            int(self.accepted.sum()),
            len(self.accepted),
            changed,
            scale,
        )
        return scale, changed

    def _screen(self, cutoff_sigma: float) -> float:
        """Screen with the cameras as they are; returns the noise scale."""
        screening = screen(
            self.landmarks,
            self.measurements,
            self._views(self.values),
            self.accepted,
            cutoff_sigma=cutoff_sigma,
            min_scale=1.0 if self.observations.origin == "given" else 0.05,
        )
        self.landmarks, self.accepted = screening.landmarks, screening.accepted
        return screening.scale

    def _final_rounds(self) -> Outcome:
        """Least squares over what was kept, until neither noise scale nor weak landmarks move any more."""
        options = self.options
        rule = StopRule(
            max_iterations=options.max_iterations,
            relative_decrease=options.relative_decrease,
            absolute_cost=1e-16 * len(self.measurements.row),
        )
        rescale = options.rescale_noise
        if rescale is None:
            rescale = self.observations.origin == "images"
        costs = self._approach(StopRule(max_iterations=20, relative_decrease=1e-4), SQUARED, stage="approach")
        self._set_aside_behind()
        for _ in range(_FINAL_ROUNDS):
            outcome = self._adjust(rule)
            gained = costs[-1] - outcome.costs[-1]
            costs += outcome.costs[1:]
            moved = self._recarry()
            if rescale:
                factor = self._noise_factor()
                self.sigma_px *= factor
                self.measurements = self.measurements.scaled(factor)
                moved |= abs(factor - 1) > 1e-3
            # Landmarks that the weak prior held back may have further to go.
            if not moved and (
                gained <= 1e-6 * costs[-1] or not self._weak(self._present()).needs_prior.any()
            ):
                break
        return replace(outcome, costs=tuple(costs))

    def _approach(self, rule: StopRule, loss: Loss, *, stage: str) -> list[float]:
        """Gauss-Newton on everything, landmarks placed anew after every step; returns the costs.

        Far from the optimum a landmark's linear prediction goes astray (behind a camera, beyond infinity)
        and would hold back all others; its best place for the cameras found is what counts.
        """
        self._place(loss)
        explicit = ExplicitLandmarks(self.template, self.measurements)
        present = self._present()
        if not present.any():
            raise SolveError("observations: expected tracks that agree in two or more images, found none")
        observed = gtsam.NonlinearFactorGraph(self.factors)
        observed.push_back(explicit.factors(self.accepted & present[self.measurements.landmark], loss))
        costs = [self._cost(observed, explicit, present)]
        start = explicit.with_landmarks(self.values, self.points_m, present)
        elimination = Elimination(observed, start)
        for number in range(1, rule.max_iterations + 1):
            weak = self._weak(present)
            graph = gtsam.NonlinearFactorGraph(observed)
            graph.push_back(explicit.proximal_factors(self.points_m, weak.bearable_m, weak.stretched))
            step = elimination.step(graph, explicit.with_landmarks(self.values, self.points_m, present))
            before, landmarks_before, points_before = self.values, self.landmarks, self.points_m
            for shrink in (1.0, 0.25, 0.0625, 0.0156):
                self.values = self.template.retract(before, step, shrink)
                self._place(loss)
                trial = self._cost(observed, explicit, present)
                if trial < costs[-1]:
                    break
                self.values, self.landmarks, self.points_m = before, landmarks_before, points_before
            else:
                break
            costs.append(trial)
            if self.on_iteration is not None:
                self.on_iteration(Iteration(stage=stage, number=number, cost=trial))
            if costs[-2] - trial <= rule.relative_decrease * trial:
                break
        return costs

    def _cost(
        self, graph: gtsam.NonlinearFactorGraph, explicit: ExplicitLandmarks, present: BoolArray
    ) -> float:
        return float(graph.error(explicit.with_landmarks(self.values, self.points_m, present)))

    def _adjust(self, rule: StopRule) -> Outcome:
        """Levenberg-Marquardt over the accepted observations, from the current values."""
        self._place(SQUARED)
        explicit = ExplicitLandmarks(self.template, self.measurements)
        present = self._present()
        kept = self.accepted & present[self.measurements.landmark]
        self.graph = gtsam.NonlinearFactorGraph(self.factors)
        self.graph.push_back(explicit.factors(kept))
        weak = self._weak(present)
        self.graph.push_back(explicit.proximal_factors(self.points_m, weak.prior_m, weak.needs_prior))
        values = explicit.with_landmarks(self.values, self.points_m, present)
        outcome = optimise(
            self.graph, values, rule, by_qr=bool(weak.stretched.any()), on_iteration=self.on_iteration
        )
        self.graph_values = outcome.values
        self.values = self.template.only_cameras(outcome.values)
        found = explicit.points_m(outcome.values, present)
        self.points_m = np.where(present[:, None], found, self.points_m)
        self.landmarks = self.landmarks.moved_to(self.points_m)
        return outcome

    def _place(self, loss: Loss) -> None:
        """Landmarks where they fit best with the cameras as they are."""
        views = self._views(self.values)
        m = self.measurements
        self.landmarks = refine(self.landmarks, m, views, self.accepted.astype(float), loss)
        self.points_m = self._points(self.landmarks, views)

    def _weak(self, present: BoolArray) -> _Weak:
        """Which landmarks are hard to hold in range, and for which the weak prior must help."""
        views, m = self._views(self.values), self.measurements
        distance = np.linalg.norm(self.points_m - self.landmarks.origin_m, axis=1)
        sigma = point_sigma_m(self.points_m, m, views, self.accepted)
        sideways = distance * float(np.median(self.sigma_px)) / float(np.median(views.calibration[:, 0, 0]))
        return _Weak(
            needs_prior=present & (sigma > _WEAK_RANGE_SIGMA * distance),
            prior_m=10 * distance,
            stretched=present & (sigma > _STRETCHED * sideways),
            bearable_m=2 * _STRETCHED * sideways,
        )

    # --- what the rounds share ---

    def _present(self) -> BoolArray:
        """(landmarks,) which have two accepted observations or more."""
        m = self.measurements
        return np.asarray(np.bincount(m.landmark, self.accepted, minlength=m.n_landmarks) >= 2)

    def _points(self, landmarks: Landmarks, views: CameraViews) -> FloatArray:
        """World points, none further than where parallax tells nothing, be it beyond infinity."""
        return landmarks.points_m(self._reach_m(landmarks, views) / _FURTHEST_PARALLAX_SIGMAS)

    def _reach_m(self, landmarks: Landmarks, views: CameraViews) -> FloatArray:
        """Distance (landmarks,) where the parallax over a landmark's cameras is one sigma of a pixel."""
        m = self.measurements
        arm = np.linalg.norm(views.world_t_camera[m.image] - landmarks.origin_m[m.landmark], axis=1)
        baseline = 2 * np.maximum.reduceat(arm, m.starts).clip(1e-3)
        focal = float(np.median(views.calibration[:, 0, 0]))
        return np.asarray(baseline * focal / float(np.median(self.observations.sigma_px)))

    def _recarry(self) -> bool:
        """Carry pixels again where that depends on the range; whether any moved."""
        m = self.measurements
        centre = self._views(self.values).world_t_camera[m.image]
        found = np.linalg.norm(self.points_m[m.landmark] - centre, axis=1)
        range_m = np.full(len(self.observations), _TYPICAL_RANGE_M)
        range_m[m.row] = np.where(np.isfinite(found), found, _TYPICAL_RANGE_M)
        uv, turn, valid = self._carry(range_m)
        shift = np.where(valid[m.row], np.linalg.norm(uv[m.row] - m.uv_px, axis=1), 0.0)
        if shift.max(initial=0.0) < _CARRIED_PX:
            return False
        keep = valid[m.row, None]
        whitening = turn[m.row] / self.sigma_px[m.row, None, None]
        self.measurements = replace(
            m,
            uv_px=np.where(keep, uv[m.row], m.uv_px),
            whitening=np.where(keep[:, :, None], whitening, m.whitening),
        )
        return True

    def _noise_factor(self) -> float:
        """By how much the residuals' spread exceeds the sigmas: the square root of the variance factor."""
        m, present = self.measurements, self._present()
        rows = self.accepted & present[m.landmark]
        residual, _, _ = evaluate(self.landmarks, m, self._views(self.values))
        # Priors add as many equations as they have unknowns, but for what observations say on top of them.
        freedom = 2 * int(rows.sum()) - 3 * int(present.sum())
        if freedom < 1:
            return 1.0
        return float(np.sqrt(np.sum(residual[rows] ** 2) / freedom).clip(1e-3))

    # --- results ---

    def _collect(self, outcome: Outcome) -> Solution:
        t, obs, m = self.traverse, self.observations, self.measurements
        present = self._present()
        kept = self.accepted & present[m.landmark]
        used = np.zeros(len(obs), dtype=bool)
        used[m.row[kept]] = True
        for row, reason in ((m.row[self.accepted & ~kept], "single"), (m.row[~self.accepted], "outlier")):
            self.reason[row] = np.where(self.reason[row] == "", reason, self.reason[row])

        initial_views = self._views(self.initial_values)
        initial_landmarks = refine(
            self._triangulate(self.initial_values, kept.astype(float)),
            m,
            initial_views,
            kept.astype(float),
            beyond_infinity=True,
        )
        initial_points = self._points(initial_landmarks, initial_views)
        initial_points = np.where(present[:, None], initial_points, np.nan)
        base = gtsam.NonlinearFactorGraph(self.factors)
        explicit = ExplicitLandmarks(self.template, m)
        base.push_back(explicit.factors(kept))
        initial_values = explicit.with_landmarks(self.initial_values, initial_points, present)

        final = self.template.state(self.values, np.where(present[:, None], self.points_m, np.nan))
        initial = self.template.state(self.initial_values, initial_points)
        try:
            stop_covariance, angle_sigma = covariances(self.template, self.graph, self.graph_values, final)
        except SolveError as error:
            self.warnings.append(f"no uncertainties: {error}")
            stop_covariance = np.full((len(t.stops), 6, 6), np.nan)
            angle_sigma = np.full((len(t.frames), 2), np.nan)
        return Solution(
            traverse=t,
            model=self.options.model,
            landmarks=self.options.landmarks,
            converged=outcome.converged,
            stop_reason=outcome.reason,
            iterations=len(outcome.costs) - 1,
            cost_history=outcome.costs,
            cost_initial=float(base.error(initial_values)),
            cost_final=float(base.error(self.graph_values)),
            initial=initial,
            final=final,
            landmark_track=self.landmark_track,
            used=used,
            reason=tuple(str(r) for r in self.reason),
            residual_initial_px=self._raw_residuals(initial_landmarks, initial_views, present),
            residual_final_px=self._raw_residuals(self.landmarks, self._views(self.values), present),
            sigma_px=self.sigma_px,
            stop_covariance=stop_covariance,
            angle_sigma_rad=angle_sigma,
            warnings=(*self.warnings, *self._late_warnings(used), *connection_warnings(t, used)),
        )

    def _raw_residuals(self, landmarks: Landmarks, views: CameraViews, present: BoolArray) -> FloatArray:
        """Projected minus measured (observations, 2) in raw pixels; NaN where there is no landmark."""
        m = self.measurements
        whitened, _, in_front = evaluate(landmarks, m, views)
        out = np.full((len(self.observations), 2), np.nan)
        known = present[m.landmark] & in_front
        out[m.row[known]] = whitened[known] * self.sigma_px[m.row[known], None]
        return out

    def _late_warnings(self, used: BoolArray) -> list[str]:
        warnings = []
        behind = int(np.sum(self.reason == "behind"))
        if behind:
            warnings.append(f"{behind} observations of landmarks behind a camera: left out")
        share = 1 - used.sum() / len(used)
        if self.options.loss != "none" and share > 0.3:
            warnings.append(
                f"{share:.0%} of the observations were rejected; check matches, rig and telemetry sigmas"
            )
        return warnings
