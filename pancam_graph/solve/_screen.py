"""Stage 2, screen: which observations are used, and which are outliers."""

import logging
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.landmarks import loss_of, refine
from pancam_graph.solve._chance_links import chance_links
from pancam_graph.solve._chance_points import chance_points
from pancam_graph.solve._pointing_again import pointing_again
from pancam_graph.solve._prepare import Prepared, solver_for, triangulated
from pancam_graph.solve._problem import Problem, Solver
from pancam_graph.solve._rejection import Snooping, snoop
from pancam_graph.solve._stopping import StopRule

__all__ = ["Screened", "ScreeningRounds", "screen", "screened_again", "screened_elsewhere"]

_LOG = logging.getLogger(__name__)

_ROUNDS = 12
_CHANCE_ROUNDS = 4
"""Second passes: each but the last may end with links that chance explains."""
_ABOUT = 0.002
"""The first pass ends when no more than this share of the observations changes."""
_GROSS = 3.0
"""The second pass begins with what is within this many times the cutoff."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Screened:
    """A prepared problem with its outliers set aside."""

    prepared: Prepared
    problem: Problem
    """Cameras about where they fit; the measurements to use are accepted."""
    set_aside: BoolArray
    """(observations,) whether each was an outlier in any round, also if it was accepted again later."""
    by_chance: BoolArray
    """(observations,) whether each was left out though it fits, since chance alone explains its links."""
    excluded: BoolArray
    """(observations,) whether each is never accepted, whatever its residual."""
    is_near: bool
    """Whether the cameras were adjusted already, so that no rigid mast is fitted first."""


def screen(prepared: Prepared) -> Screened:
    """Outliers set aside by robust adjustment and data snooping in turn; with the loss "none", nothing is.

    Two passes: what is kept should depend on the images, not on the way from the start. So the first only
    brings the cameras near; the second begins there with all observations but the grossest outliers.
    """
    if prepared.options.loss == "none":
        n = len(prepared.observations)
        return Screened(
            prepared=prepared,
            problem=prepared.problem,
            set_aside=np.zeros(n, dtype=bool),
            by_chance=np.zeros(n, dtype=bool),
            excluded=np.zeros(n, dtype=bool),
            is_near=prepared.is_near,
        )
    rounds = ScreeningRounds(prepared)
    rounds.from_telemetry()
    rounds.bring_near()
    rounds.turn_back()
    return rounds.to_the_end()


def screened_elsewhere(
    prepared: Prepared, values: gtsam.Values, used: BoolArray, excluded: BoolArray | None = None
) -> Screened:
    """The prepared problem at values that were estimated elsewhere, with the observations (n,) used there.

    Those `excluded` (n,) are not accepted later either.
    """
    accepted = used[prepared.problem.measurements.row]
    problem = triangulated(replace(prepared.problem, accepted=accepted, values=values)).placed()
    nothing = np.zeros(len(used), dtype=bool)
    return Screened(
        prepared=prepared,
        problem=problem,
        set_aside=nothing,
        by_chance=nothing,
        excluded=nothing if excluded is None else excluded,
        is_near=True,
    )


def screened_again(screened: Screened) -> Screened:
    """The observations judged anew, from where the cameras are; those excluded are not accepted.

    The same object, unless one test of all observations with the cameras held judges more than very few of
    them otherwise. Where the residuals decide how large the noise is, they are always judged anew: whoever
    judged them before did not know it.
    """
    prepared = screened.prepared
    if prepared.options.loss == "none":
        return screened
    rounds = ScreeningRounds(replace(prepared, problem=screened.problem, is_near=True), screened.excluded)
    changed = rounds.share_changed()
    if not (rounds.turn_back() or prepared.rescales_noise or changed > _ABOUT):
        return screened
    # The start stays the one that was prepared, with which the end is compared.
    return replace(rounds.to_the_end(), prepared=prepared)


class ScreeningRounds:
    """Rounds of robust adjustment and data snooping: the problem as it stands, and what was set aside."""

    def __init__(self, prepared: Prepared, excluded: BoolArray | None = None) -> None:
        """Rounds of a problem; observations `excluded` (n,) are never accepted."""
        self._prepared = prepared
        self._solver: Solver = solver_for(prepared.options, prepared.on_iteration, is_near=prepared.is_near)
        self.problem = prepared.problem
        self._let_go = prepared.problem.template.let_go
        self._scale = 1.0
        nothing = np.zeros(len(prepared.observations), dtype=bool)
        self._excluded = nothing if excluded is None else excluded
        self._banned = self._excluded[self.problem.measurements.row]
        self.set_aside = nothing.copy()
        self.by_chance = nothing.copy()

    def from_telemetry(self) -> None:
        """Set gross outliers aside at the start, where errors of telemetry add to the noise."""
        problem, widened = self.problem, self._prepared.noise.select(self.problem.measurements.row)
        m = problem.measurements
        whitening = widened.widened(_telemetry_px(problem)).whiten(widened.to_pixels(m.whitening))
        self._adopt(
            snoop(
                problem.landmarks,
                replace(m, whitening=whitening),
                problem.views,
                problem.accepted,
                cutoff_sigma=self._prepared.options.outlier_sigma,
                min_scale=1.0,  # telemetry errors are common to a frame: a small median must exclude none
            )
        )

    def bring_near(self) -> None:
        """The first pass: robust adjustment and data snooping in turn until few observations change."""
        for _ in range(_ROUNDS):
            self._scale, n_changed = self._round(
                self._scale, self._prepared.options.outlier_sigma, relative_decrease=1e-3
            )
            if n_changed <= _ABOUT * len(self.problem.accepted):
                break

    def turn_back(self) -> bool:
        """Turn frames that lost their links to where these agree; whether there is any.

        The priors of what is turned are let go, until screening ends.
        """
        before = self.problem
        self.problem = pointing_again(
            before,
            self._banned,
            cutoff_sigma=self._prepared.options.outlier_sigma,
            scale=self._scale,
        )
        return self.problem is not before

    def share_changed(self) -> float:
        """Share of the observations that one test of all of them, with the cameras held, judges otherwise."""
        before = self.problem.accepted
        self.problem = self.problem.having(accepted=~self._banned)
        self._scale = self._snoop(self._prepared.options.outlier_sigma)
        return float(np.mean(self.problem.accepted != before))

    def to_the_end(self) -> Screened:
        """Second passes until chance explains no link and no point any more."""
        cutoff, scale = self._prepared.options.outlier_sigma, self._scale
        for _ in range(_CHANCE_ROUNDS):
            scale = self._second_pass(scale, cutoff)
            cutoff_px = cutoff * scale * self.problem.measurements.typical_sigma_px
            by_chance = chance_links(self.problem, cutoff_px) | chance_points(self.problem, cutoff_px)
            if not by_chance.any():
                break
            self._banned |= by_chance
            self.by_chance[self.problem.measurements.row[by_chance]] = True
        if self.problem.template.let_go is not self._let_go:
            # Whose error it was, the whole of telemetry decides (`reconsidered`).
            self.problem = self.problem.letting_go(self._let_go)
        return Screened(
            prepared=self._prepared,
            problem=self.problem,
            set_aside=self.set_aside,
            by_chance=self.by_chance,
            excluded=self._excluded,
            is_near=True,
        )

    def _second_pass(self, scale: float, cutoff: float) -> float:
        """From all observations but the grossest outliers until the same ones stay; the noise scale."""
        self.problem = self.problem.having(accepted=~self._banned)
        self._snoop(_GROSS * cutoff)
        for _ in range(_ROUNDS):
            before = scale
            scale, n_changed = self._round(scale, cutoff, relative_decrease=1e-6)
            if n_changed == 0 and abs(scale - before) < 1e-3 * scale:
                break
        return scale

    def _round(self, scale: float, cutoff_sigma: float, *, relative_decrease: float) -> tuple[float, int]:
        """One robust adjustment and snooping: the noise scale, and how many observations came or went."""
        rule = StopRule(max_iterations=20, relative_decrease=relative_decrease)
        loss = loss_of(self._prepared.options.loss, scale)
        self.problem = self._solver.approach(self.problem, rule, loss, "screening")
        before = self.problem.accepted
        scale = self._snoop(cutoff_sigma)
        accepted = self.problem.accepted
        n_changed = int(np.sum(before != accepted))
        _LOG.info(
            "screening: %d of %d observations kept, %d changed, noise %.2f sigma",
            int(accepted.sum()),
            len(accepted),
            n_changed,
            scale,
        )
        return scale, n_changed

    def _snoop(self, cutoff_sigma: float) -> float:
        """Snoop with the cameras as they are; returns the noise scale."""
        problem = self.problem
        snooping = snoop(
            problem.landmarks,
            problem.measurements,
            problem.views,
            problem.accepted,
            cutoff_sigma=cutoff_sigma,
            min_scale=1.0 if self._prepared.observations.origin == "given" else 0.05,
        )
        self._adopt(snooping)
        return snooping.scale

    def _adopt(self, snooping: Snooping) -> None:
        accepted = snooping.accepted & ~self._banned
        self.problem = self.problem.having(landmarks=snooping.landmarks, accepted=accepted)
        self.set_aside[self.problem.measurements.row[~accepted]] = True


def _telemetry_px(problem: Problem) -> FloatArray:
    """By how much (n,) errors of telemetry and of the rig may move measurements, one sigma, pixels."""
    m, views, t = problem.measurements, problem.views, problem.template.traverse
    frame = np.array([max(f.sigma_pan_rad, f.sigma_tilt_rad) for f in t.frames])[t.image_frame[m.image]]
    stop_rad = np.array([s.sigma_rotation_rad for s in t.stops])[t.image_stop[m.image]]
    stop_m = np.array([s.sigma_translation_m for s in t.stops])[t.image_stop[m.image]]
    refined = problem.at(problem.values, refine(problem.landmarks, m, views, problem.accepted.astype(float)))
    distance = np.linalg.norm(refined.points_m()[m.landmark] - views.world_t_camera[m.image], axis=1)
    focal = views.calibration[m.image, 0, 0]
    telemetry_px = focal * np.sqrt(frame**2 + stop_rad**2 + (stop_m / distance.clip(1.0)) ** 2)
    rig_px, rig_m = problem.template.rig_variables.start_error()
    shift_px = focal * rig_m[m.image] / distance.clip(1.0)
    return np.asarray(np.hypot(telemetry_px, np.hypot(rig_px[m.image], shift_px)))
