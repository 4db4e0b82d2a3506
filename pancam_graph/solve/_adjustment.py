"""One solve, from measurements to solution."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError, SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras import carry_to_pinhole
from pancam_graph.data import Observations, RigCorrection, Sharing, Solution, State, Traverse
from pancam_graph.graph import (
    RIGID,
    FactorTemplate,
    HardTemplate,
    ProjectiveTemplate,
    RigVariables,
    SoftTemplate,
)
from pancam_graph.initialise import FreeCameras, Start, start_from_telemetry
from pancam_graph.landmarks import Landmarks, Measurements, loss_of, rays_of, refine, residuals, triangulate
from pancam_graph.solve._alternation import AlternatingSolver
from pancam_graph.solve._covariance import Uncertainty, uncertainty
from pancam_graph.solve._diagnose import connection_warnings, listed
from pancam_graph.solve._eliminated import EliminatedSolver
from pancam_graph.solve._explicit import ExplicitSolver
from pancam_graph.solve._optimise import Iteration, Outcome
from pancam_graph.solve._options import Method, SolveOptions
from pancam_graph.solve._problem import Problem, Solver, reach_m
from pancam_graph.solve._reduced import ReducedSystem
from pancam_graph.solve._rejection import Screening, screen
from pancam_graph.solve._stopping import StopRule

__all__ = ["Adjustment"]

_LOG = logging.getLogger(__name__)

_SOLVERS: dict[Method, type[EliminatedSolver]] = {
    "joint": EliminatedSolver,
    "alternation": AlternatingSolver,
}
_SCREENING_ROUNDS = 12
_ABOUT = 0.002
"""The first pass of screening ends when no more than this share of the observations changes."""
_GROSS = 3.0
"""The second begins with what is within this many times the cutoff."""
_FINAL_ROUNDS = 6
_TYPICAL_RANGE_M = 10.0
_CARRIED_PX = 1e-6
"""Pixels of CAHVORE cameras, and of distorted ones with a free calibration, are carried anew until none moves
by more."""


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
        self.traverse, self.options = traverse, options
        self.observations: Observations = traverse.observations
        self.start = start or start_from_telemetry(traverse)
        self.warnings = [*traverse.warnings, *self.start.warnings]
        self.noise = self.observations.noise
        self.reason = np.full(len(self.observations), "", dtype=object)
        self.set_aside = np.zeros(len(self.observations), dtype=bool)
        given = self.start.cameras if options.model in {"free", "projective"} else None
        self.solver = self._new_solver(on_iteration, is_near=given is not None)
        self.sharing = (options.sharing or traverse.sharing or Sharing()).for_model(options.model)
        template = _template(traverse, options, self.sharing)
        self.solver.require(template)
        self.problem = self.first = self._first_problem(template, given).placed()

    def _new_solver(
        self, on_iteration: Callable[[Iteration], None] | None, *, is_near: bool = False
    ) -> Solver:
        if self.options.landmarks == "explicit":
            return ExplicitSolver(on_iteration)
        return _SOLVERS[self.options.method](on_iteration, is_near=is_near)

    # --- preparation ---

    def _first_problem(self, template: FactorTemplate, given: FreeCameras | None) -> Problem:
        """Cameras where the start has them, all landmarks triangulated from there."""
        values = template.values(_first_state(self.traverse, self.start, given))
        measurements = self._measure(template.rig_variables, values)
        n = measurements.n_landmarks
        return _triangulated(
            Problem(
                template=template,
                factors=template.factors(),
                measurements=measurements,
                accepted=np.ones(len(measurements.row), dtype=bool),
                values=values,
                landmarks=Landmarks(vector=np.zeros((n, 4)), origin_m=np.zeros((n, 3))),
            )
        )

    def _measure(self, rig: RigVariables, values: gtsam.Values) -> Measurements:
        """Observations of tracks seen twice or more, carried to the pinholes."""
        obs = self.observations
        uv, turn, valid = self._carry(np.full(len(obs), _TYPICAL_RANGE_M), rig, values)
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
            whitening=self.noise.select(rows).whiten(turn[rows]),
        )

    def _carry(
        self, range_m: FloatArray, rig: RigVariables, values: gtsam.Values
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Pixels as pinholes see them, how their residuals turn back, and which are valid."""
        obs = self.observations
        uv, turn = np.empty((len(obs), 2)), np.empty((len(obs), 2, 2))
        valid = np.empty(len(obs), dtype=bool)
        for camera, images in rig.cameras(values):
            own = images[obs.image]
            uv[own], turn[own], valid[own] = carry_to_pinhole(camera, obs.uv_px[own], range_m[own])
        return uv, turn, valid

    # --- the rounds ---

    def solve(self) -> None:
        """Screen, adjust, and say how sure it is."""
        if self.options.loss != "none":
            self._screen_at_start()
            self._screening_rounds()
        self.outcome = self._final_rounds()
        self.final = _state(self.problem)
        self.uncertainty = self._uncertainty()

    def take_over(self, values: gtsam.Values, used: BoolArray, costs: Sequence[float], reason: str) -> None:
        """In place of `solve`: what was solved elsewhere, over the observations (n,) that were used there.

        Where their noise is to be found, or pixels depend on the range, the last rounds of `solve` follow.
        """
        m = self.problem.measurements
        problem = replace(self.problem, accepted=used[m.row], values=values)
        self.problem = _triangulated(problem).placed()
        if self._rescales or self.problem.template.rig_variables.pupil_moves:
            self._recarry()
            last = self._final_rounds()
            self.outcome = replace(last, reason=f"{reason}; {last.reason}", costs=(*costs, *last.costs))
        else:
            self.outcome = Outcome(values=values, converged=True, reason=reason, costs=tuple(costs))
        self.final = _state(self.problem)
        self.uncertainty = self._uncertainty()

    def _screen_at_start(self) -> None:
        """Gross outliers, judged with what telemetry may be wrong by added to the noise."""
        p, t = self.problem, self.traverse
        m, views = p.measurements, p.views
        frame = np.array([max(f.sigma_pan_rad, f.sigma_tilt_rad) for f in t.frames])[t.image_frame[m.image]]
        stop_rad = np.array([s.sigma_rotation_rad for s in t.stops])[t.image_stop[m.image]]
        stop_m = np.array([s.sigma_translation_m for s in t.stops])[t.image_stop[m.image]]
        first = p.at(p.values, refine(p.landmarks, m, views, p.accepted.astype(float)))
        distance = np.linalg.norm(first.points_m()[m.landmark] - views.world_t_camera[m.image], axis=1)
        focal = views.calibration[m.image, 0, 0]
        telemetry_px = focal * np.sqrt(frame**2 + stop_rad**2 + (stop_m / distance.clip(1.0)) ** 2)
        rig_px, rig_m = p.template.rig_variables.start_error()
        shift_px = focal * rig_m[m.image] / distance.clip(1.0)
        telemetry_px = np.hypot(telemetry_px, np.hypot(rig_px[m.image], shift_px))
        noise = self.noise.select(m.row)
        screening = screen(
            p.landmarks,
            replace(m, whitening=noise.widened(telemetry_px).whiten(noise.to_pixels(m.whitening))),
            views,
            p.accepted,
            cutoff_sigma=self.options.outlier_sigma,
            min_scale=1.0,  # errors of telemetry are common to a frame: a small median must not exclude one
        )
        self._adopt(screening)

    def _screening_rounds(self) -> None:
        """Robust adjustment and screening in turn, until the same observations stay.

        Twice: what is kept should depend on the images, not on the way from the start. So the first pass only
        finds about where the cameras are; the second begins there with all but the grossest outliers.
        """
        cutoff = self.options.outlier_sigma
        scale = 1.0
        for _ in range(_SCREENING_ROUNDS):
            scale, changed = self._screening_round(scale, cutoff, relative_decrease=1e-3)
            if changed <= _ABOUT * len(self.problem.accepted):
                break
        self.problem = replace(self.problem, accepted=np.ones_like(self.problem.accepted))
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
        self.problem = self.solver.approach(
            self.problem, rule, loss_of(self.options.loss, scale), "screening"
        )
        before = self.problem.accepted
        scale = self._screen(cutoff_sigma)
        accepted = self.problem.accepted
        changed = int(np.sum(before != accepted))
        _LOG.info(
            "screening: %d of %d observations kept, %d changed, noise %.2f sigma",
            int(accepted.sum()),
            len(accepted),
            changed,
            scale,
        )
        return scale, changed

    def _screen(self, cutoff_sigma: float) -> float:
        """Screen with the cameras as they are; returns the noise scale."""
        p = self.problem
        screening = screen(
            p.landmarks,
            p.measurements,
            p.views,
            p.accepted,
            cutoff_sigma=cutoff_sigma,
            min_scale=1.0 if self.observations.origin == "given" else 0.05,
        )
        self._adopt(screening)
        return screening.scale

    def _adopt(self, screening: Screening) -> None:
        self.problem = replace(self.problem, landmarks=screening.landmarks, accepted=screening.accepted)
        self.set_aside[self.problem.measurements.row[~screening.accepted]] = True

    def _final_rounds(self) -> Outcome:
        """Least squares over what was kept, until neither noise scale nor carried pixels move any more."""
        costs: list[float] = []
        for _ in range(_FINAL_ROUNDS):
            before = self.problem.accepted
            self.problem, outcome = self.solver.adjust(self.problem, self.options)
            self._note_behind(before & ~self.problem.accepted)
            costs += outcome.costs[1:] if costs else outcome.costs
            moved = self._recarry()
            if self._rescales:
                factor = self._noise_factor()
                self.noise = self.noise.scaled(factor)
                self.problem = replace(self.problem, measurements=self.problem.measurements.scaled(factor))
                moved |= abs(factor - 1) > 1e-3
            if not (moved and outcome.converged):
                break
        return replace(outcome, costs=tuple(costs))

    @property
    def _rescales(self) -> bool:
        """Whether the noise is what residuals say, not what observations say of themselves."""
        wanted = self.options.rescale_noise
        return self.observations.origin == "images" if wanted is None else wanted

    def with_only(self, landmarks: BoolArray) -> tuple[Problem, Outcome]:
        """Least squares over some landmarks (landmarks,) from where `solve` ended, which stays as it is.

        From there, so that of several optima it is the one beside; anew from afar where that does not
        converge, since steps with a firm tie are short. Pixels of moving pupils stay carried as they are.
        """
        p = self.problem
        part = replace(p, accepted=p.accepted & landmarks[p.measurements.landmark])
        found, outcome = self.solver.adjust(part, self.options)
        if outcome.converged:
            return found, outcome
        return self._new_solver(self.solver.on_iteration).adjust(part, self.options)

    def _note_behind(self, behind: BoolArray) -> None:
        self.reason[self.problem.measurements.row[behind]] = "behind"

    # --- what the rounds share ---

    def _recarry(self) -> bool:
        """Carry pixels again where that depends on the range or on a free calibration; whether any moved."""
        m, rig = self.problem.measurements, self.problem.template.rig_variables
        if not (rig.pupil_moves or rig.distortion_moves):
            return False
        carried = self._carried(self.problem)
        if np.linalg.norm(carried.uv_px - m.uv_px, axis=1).max(initial=0.0) < _CARRIED_PX:
            return False
        self.problem = replace(self.problem, measurements=carried)
        return True

    def _carried(self, problem: Problem) -> Measurements:
        """The measurements as the problem's own cameras and ranges carry them."""
        m = problem.measurements
        centre = problem.views.world_t_camera[m.image]
        found = np.linalg.norm(problem.points_m()[m.landmark] - centre, axis=1)
        range_m = np.full(len(self.observations), _TYPICAL_RANGE_M)
        range_m[m.row] = np.where(np.isfinite(found), found, _TYPICAL_RANGE_M)
        uv, turn, valid = self._carry(range_m, problem.template.rig_variables, problem.values)
        keep = valid[m.row, None]
        whitening = self.noise.select(m.row).whiten(turn[m.row])
        return replace(
            m,
            uv_px=np.where(keep, uv[m.row], m.uv_px),
            whitening=np.where(keep[:, :, None], whitening, m.whitening),
        )

    def _noise_factor(self) -> float:
        """By how much residuals exceed the noise assumed: the square root of the variance factor."""
        p = self.problem
        rows = p.kept
        residual, _ = p.residuals()
        # Priors add as many equations as they have unknowns, but for what observations say on top of them.
        freedom = 2 * int(rows.sum()) - 3 * int(p.present.sum())
        if freedom < 1:
            return 1.0
        return float(np.sqrt(np.sum(residual[rows] ** 2) / freedom).clip(1e-3))

    # --- results ---

    def solution(self) -> Solution:
        """What `solve` found, beside what was there before."""
        outcome, found = self.outcome, self.uncertainty
        t, p, m = self.traverse, self.problem, self.problem.measurements
        present, kept = p.present, p.kept
        used = np.zeros(len(self.observations), dtype=bool)
        used[m.row[kept]] = True
        for row, reason in ((m.row[p.accepted & ~kept], "single"), (m.row[~p.accepted], "outlier")):
            self.reason[row] = np.where(self.reason[row] == "", reason, self.reason[row])

        # The start again, with the landmarks that fit it best: what is gained is then due to the cameras.
        first = self.first
        if m is not first.measurements or not p.accepted.all():
            first = _triangulated(replace(first, measurements=m, accepted=p.accepted)).placed()
            if p.template.rig_variables.distortion_moves:
                first = replace(first, measurements=self._carried(first)).placed()
        return Solution(
            traverse=t,
            model=self.options.model,
            landmarks=self.options.landmarks,
            method=self.options.method,
            converged=outcome.converged,
            stop_reason=outcome.reason,
            iterations=len(outcome.costs) - 1,
            cost_history=outcome.costs,
            cost_initial=first.cost(),
            cost_final=p.cost(),
            initial=_state(first),
            final=self.final,
            landmark_track=self.landmark_track,
            used=used,
            reason=tuple(self.reason.tolist()),
            residual_initial_px=self._raw_residuals(first, present),
            residual_final_px=self._raw_residuals(p, present),
            sigma_px=self.noise.sigma_px,
            covariance_px2=self.noise.covariance_px2,
            stop_covariance=found.stop_covariance,
            angle_sigma_rad=found.angle_sigma_rad,
            landmark_covariance_m2=found.landmark_covariance_m2,
            came_back=used & self.set_aside,
            refined=p.template.refined(p.values, found.rig_sigmas),
            warnings=(*self.warnings, *self._late_warnings(used), *connection_warnings(t, used)),
        )

    def _uncertainty(self) -> Uncertainty:
        """Covariances; NaN and a warning where a direction is free. Warns of landmarks without a place."""
        t, wanted, problem = self.traverse, self.options.landmark_covariances, self.regular
        # Radii of circles are free unasked: what holds them is then no news.
        asked = (self.options.sharing or t.sharing) is not None
        try:
            found = uncertainty(problem, self.final, self.reduced(problem), landmarks=wanted, unseen=asked)
        except SolveError as error:
            self.warnings.append(f"no uncertainties: {error}")
            n = len(self.landmark_track)
            return Uncertainty(
                stop_covariance=np.full((len(t.stops), 6, 6), np.nan),
                angle_sigma_rad=np.full((len(t.frames), 2), np.nan),
                landmark_covariance_m2=np.full((n, 3, 3), np.nan)
                if self.options.landmark_covariances
                else None,
                undetermined=np.zeros(n, dtype=bool),
                rig_sigmas=None,
            )
        if found.unseen:
            self.warnings.append(
                f"images say next to nothing of {listed(found.unseen, 'direction')} of the rig: telemetry "
                "and priors hold them, and their sigmas are as good as these"
            )
        tracks = [str(track) for track in self.landmark_track[found.undetermined]]
        if tracks:
            self.warnings.append(
                f"{listed(tracks, 'track')}: their rays leave the place of the point open; "
                "they tell where cameras point, and a weak prior holds the point"
            )
        return found

    @property
    def regular(self) -> Problem:
        """The problem as covariances are taken from it."""
        problem = self.problem
        if self.options.firm_tie == "hard" and isinstance(problem.template, SoftTemplate):
            # The inverse of a system with a tie of 1e-8 would have lost half its digits.
            return problem.on(HardTemplate(self.traverse, self.sharing))
        return problem

    def reduced(self, problem: Problem) -> ReducedSystem:
        """The problem with landmarks eliminated; that of the last fit where this was one of it."""
        known = isinstance(self.solver, EliminatedSolver) and self.solver.reduced(problem)
        return known or ReducedSystem.of(problem)

    def _raw_residuals(self, problem: Problem, present: BoolArray) -> FloatArray:
        """Projected minus measured (observations, 2) in raw pixels; NaN where there is no landmark."""
        m = problem.measurements
        whitened, in_front = problem.residuals()
        out = np.full((len(self.observations), 2), np.nan)
        known = present[m.landmark] & in_front
        out[m.row[known]] = self.noise.select(m.row[known]).to_pixels(whitened[known])
        return out

    def _late_warnings(self, used: BoolArray) -> list[str]:
        warnings = []
        behind = int(np.sum(self.reason == "behind"))
        if behind:
            warnings.append(f"{behind} observations of landmarks behind a camera: left out")
        diverging = [str(track) for track in self.landmark_track[_diverging(self.problem)]]
        if diverging:
            warnings.append(
                f"{listed(diverging, 'track')}: rays diverge by more than noise, as wrong matches do; "
                "kept, as points beyond infinity"
            )
        share = 1 - used.sum() / len(used)
        if self.options.loss != "none" and share > 0.3:
            warnings.append(
                f"{share:.0%} of the observations were rejected; check matches, rig and telemetry sigmas"
            )
        return warnings


def _first_state(traverse: Traverse, start: Start, given: FreeCameras | None) -> State:
    """The given cameras, or else those on the masts of the start."""
    rotations, centres = traverse.camera_poses(start.world_T_mast, start.pan_tilt_rad)
    rig = None
    if given is not None:
        if len(given.centre_m) != len(traverse.images):
            raise InputError(
                f"start: cameras: expected {len(traverse.images)}, one for each image, "
                f"found {len(given.centre_m)}"
            )
        rotations, centres = given.world_R_camera, given.centre_m
        rig = RigCorrection.to_calibrations(traverse, given.calibration)
    return State(
        world_T_mast=start.world_T_mast,
        pan_tilt_rad=start.pan_tilt_rad,
        world_R_camera=rotations,
        world_t_camera=centres,
        landmarks_m=np.zeros((0, 3)),
        rig=rig,
    )


def _template(traverse: Traverse, options: SolveOptions, sharing: Sharing) -> FactorTemplate:
    """The rig as variables and factors, as the options have it."""
    if options.model == "projective":
        return ProjectiveTemplate(traverse, options.firm_flex, normalise=options.normalise)
    if options.firm_tie == "soft":
        return SoftTemplate(traverse, options.model, options.firm_flex, sharing)
    if options.landmarks == "eliminated":
        return HardTemplate(traverse, sharing)
    # GTSAM's projections want camera poses: a tie far below what images can tell makes them rigid.
    return SoftTemplate(traverse, options.model, RIGID, sharing)


def _triangulated(problem: Problem) -> Problem:
    """Landmarks by linear triangulation; one behind a camera starts far off, where its cameras look."""
    m, views, weight = problem.measurements, problem.views, problem.accepted.astype(float)
    centre, direction = rays_of(m, views)
    landmarks = triangulate(centre, direction, m.landmark, weight)
    _, in_front = residuals(landmarks, m, views)
    behind = np.bincount(m.landmark, ~in_front & (weight > 0), minlength=m.n_landmarks) > 0
    problem = replace(problem, landmarks=landmarks)
    if not behind.any():
        return problem
    mean = np.add.reduceat(weight[:, None] * direction, m.starts)
    ahead = landmarks.moved_to(landmarks.origin_m + reach_m(problem)[:, None] * mean)
    vector = np.where(behind[:, None], ahead.vector, landmarks.vector)
    return replace(problem, landmarks=replace(landmarks, vector=vector))


def _state(problem: Problem) -> State:
    """What a solution says of a problem; points that take no part are NaN."""
    points = np.where(problem.present[:, None], problem.points_m(), np.nan)
    return problem.template.state(problem.values, points, problem.views)


def _diverging(problem: Problem) -> BoolArray:
    """Landmarks (landmarks,) that would fit worse by 3 sigma if they were no further than infinity."""
    beyond = problem.present & (problem.landmarks.vector[:, 3] < 0)
    if beyond.any():
        m, rows = problem.measurements, np.flatnonzero(beyond)
        weight = problem.accepted.astype(float)
        bound = replace(
            problem, landmarks=refine(problem.landmarks, m, problem.views, weight, only=rows)
        ).residuals()[0]
        excess = weight * np.sum(bound**2 - problem.residuals()[0] ** 2, axis=1)
        beyond &= np.bincount(m.landmark, excess, minlength=m.n_landmarks) > 9.0
    return beyond
