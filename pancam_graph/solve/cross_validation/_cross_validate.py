"""Cross-validation: a traverse solved again with halves of its tracks, to check its sigmas."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError, SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray, wrap_angle
from pancam_graph.base.options import options_of
from pancam_graph.base.threads import blas_on_one_thread
from pancam_graph.data import (
    CrossValidation,
    HalfScore,
    Sigmas,
    Solution,
    Splitting,
    Spread,
    State,
    Traverse,
    rms_px,
)
from pancam_graph.elimination import Covariance
from pancam_graph.graph import FactorTemplate, UserFactors
from pancam_graph.initialise import Start
from pancam_graph.solve._considered import with_rig
from pancam_graph.solve._covariance import covariance_of
from pancam_graph.solve._diagnose import listed
from pancam_graph.solve._fit import fit, refitted
from pancam_graph.solve._judge import regular_problem, state_of
from pancam_graph.solve._options import SolveOptions
from pancam_graph.solve._prepare import prepare
from pancam_graph.solve._problem import Problem, system_of
from pancam_graph.solve._reduced import ReducedSystem
from pancam_graph.solve._screen import screen
from pancam_graph.solve._solve import solve
from pancam_graph.solve.cross_validation._halves import Groups, neighbours, random_half, upper_half

__all__ = ["CrossValidation", "HalfScore", "Sigmas", "Spread", "cross_validate"]

_FEWEST_TRACKS = 4
_RELATIVE_DECREASE = 1e-13
"""Stop criterion of the fits: steps of quantities that telemetry determines may be as small as a thousandth
of their sigma, and iterations must not end before them."""
_T = TypeVar("_T", bound=np.generic)
_HalfName = Literal["first", "second", "upper", "lower"]
_NAMES: dict[Splitting, tuple[_HalfName, _HalfName]] = {
    "random": ("first", "second"),
    "upper_lower": ("upper", "lower"),
}


def cross_validate(
    traverse: Traverse,
    options: SolveOptions | None = None,
    *,
    solution: Solution | None = None,
    halvings: int = 4,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
    factors: UserFactors | None = None,
) -> CrossValidation:
    """Solve halves of a traverse's tracks and compare them: `halvings` times by lot, once by image halves.

    The tracks are those that the solution used, with the sigmas that it ended with; nothing is screened
    again. By lot, one of every two tracks that connect the same frames goes to each half. A track belongs to
    the upper half if the mean position of its observations is above the middle of their images. Every half is
    adjusted with all priors, from the optimum of the whole; formal covariances are all taken at that optimum.

    `factors` are the caller's own, as `solve` was given them: every half has all of them, as all priors.
    `solution` is the solution of the traverse with the options; default: the traverse is solved first.
    `progress` is told the name of a step, its number, and the number of steps. Deterministic: the same
    arguments give the same numbers.

    A frame or stop that a half does not see or cuts off from its group, and a half that cannot be solved or
    does not converge, give NaN and a warning. Raises InputError for a solution of another traverse or model,
    fewer than 1 halving, a seed below 0, and fewer than 4 used tracks; SolveError as `solve` does.
    """
    started = time.perf_counter()
    for name, value, least in (("halvings", halvings, 1), ("seed", seed, 0)):
        if value < least:
            raise InputError(f"cross-validation: {name}: expected {least} or more, found {value}")
    options = options_of(SolveOptions, options, "cross_validate")
    if solution is None:
        solution = solve(traverse, options, factors=factors)
    else:
        _require_solution_of(traverse, options, solution)
    with blas_on_one_thread():
        whole = _Whole(solution, options, factors)
        m, lots = whole.problem.measurements, np.random.default_rng(seed)
        splits: dict[Splitting, list[BoolArray]] = {
            "random": [random_half(whole.traverse, m, lots) for _ in range(halvings)],
            "upper_lower": [upper_half(whole.traverse, m)],
        }
        verdicts: _Verdicts = {"random": [], "upper_lower": []}
        scores: list[HalfScore] = []
        done, total = 0, 2 * (halvings + 1)
        for splitting, firsts in splits.items():
            for number, first in enumerate(firsts):
                halves = []
                for name, own in zip(_NAMES[splitting], (first, ~first), strict=True):
                    done += 1
                    if progress is not None:
                        progress("cross-validating: half", done, total)
                    halves.append(_Half(whole, name, own))
                verdicts[splitting].append((halves[0].verdict, halves[1].verdict))
                scores += [
                    _score(whole, splitting, number, own, other) for own, other in (halves, halves[::-1])
                ]
        pointing, relative_pointing, stops = _sigmas(whole, verdicts)
    return CrossValidation(
        halvings=halvings,
        seed=seed,
        pointing=pointing,
        pairs=whole.pairs,
        pair_tracks=whole.pair_tracks,
        relative_pointing=relative_pointing,
        stops=stops,
        scores=tuple(scores),
        warnings=(*whole.warnings, *_warnings(whole.traverse, verdicts)),
        seconds=time.perf_counter() - started,
    )


def _require_solution_of(traverse: Traverse, options: SolveOptions, solution: Solution) -> None:
    """Raise InputError unless a solution belongs to the traverse and has the model of the options."""
    other, expected = solution.traverse, "solution: expected one of this traverse"
    for what in ("stops", "frames", "images"):
        if [e.id for e in getattr(other, what)] != [e.id for e in getattr(traverse, what)]:
            raise InputError(f"{expected}, found one with other {what}")
    ours, theirs = traverse.observations, other.observations
    if ours is not theirs and (
        ours is None
        or theirs is None
        or any(not np.array_equal(getattr(ours, c), getattr(theirs, c)) for c in ("image", "track", "uv_px"))
    ):
        raise InputError(f"{expected}, found one with other observations")
    if solution.model != options.model:
        raise InputError(
            f"solution: expected one of the model {options.model}, as the options have it, "
            f"found one of the model {solution.model}"
        )


class _Whole:
    """The fit of all observations that a solution used, with which halves are compared.

    One vector holds all quantities: pan and tilt of each frame, of each pair, and six numbers of each stop.
    """

    def __init__(self, solution: Solution, options: SolveOptions, factors: UserFactors | None) -> None:
        given, used, final = solution.traverse.observations, solution.used, solution.final
        assert given is not None
        # Sigmas stay those that the solution ended with: halves are not to scale them to their own residuals.
        kept = replace(given.select(used), sigma_px=solution.sigma_px[used], origin="given")
        if solution.covariance_px2 is not None:
            kept = kept.with_covariance(solution.covariance_px2[used])
        self.traverse = solution.traverse.with_observations(kept)
        options = replace(
            options,
            loss="none",
            rescale_noise=False,
            landmark_covariances=False,
            field=final.rig is not None and final.rig.field_px is not None,
            relative_decrease=min(options.relative_decrease, _RELATIVE_DECREASE),
        )
        start = Start(world_T_mast=final.world_T_mast, pan_tilt_rad=final.pan_tilt_rad)
        self.fitted = fit(screen(prepare(self.traverse, options, start, factors=factors)))
        self.problem, self.regular = self.fitted.problem, regular_problem(self.fitted)
        self.state = state_of(self.problem)
        n_tracks = int(self.problem.present.sum())
        if n_tracks < _FEWEST_TRACKS:
            raise InputError(
                f"cross-validation: expected {_FEWEST_TRACKS} used tracks or more to halve, found {n_tracks}"
            )
        self.warnings: list[str] = []
        if not (solution.converged and self.fitted.outcome.converged):
            self.warnings.append("the solution has not converged: halves differ for that too")
        self.frames, self.stops = self.groups(self.problem)
        self.pairs, self.pair_tracks = neighbours(self.traverse, self.problem)
        reduced = ReducedSystem.of(self.regular)
        self.cliques = reduced.system.structure.after
        try:
            self.sigma = self.sigmas(covariance_of(self.regular.template, reduced))
            self.formal = self._formal()
        except SolveError as error:
            self.warnings.append(f"no formal sigmas to compare with: {error}")
            self.sigma = self.formal = np.full(self.n_quantities, np.nan)

    @property
    def n_quantities(self) -> int:
        """Length of the vector of all quantities."""
        return 2 * len(self.traverse.frames) + 2 * len(self.pairs) + 6 * len(self.traverse.stops)

    def groups(self, problem: Problem) -> tuple[Groups, Groups]:
        """Groups of frames and of stops that a problem's tracks connect."""
        t = self.traverse
        frames = Groups.of(problem, t.image_frame, len(t.frames))
        return frames, Groups.of(problem, t.image_stop, len(t.stops))

    def part(self, landmarks: BoolArray) -> Problem:
        """The problem that covariances are taken from, reduced to some landmarks (landmarks,)."""
        p = self.regular
        return replace(p, accepted=p.accepted & landmarks[p.measurements.landmark])

    def _formal(self) -> FloatArray:
        """Formal sigmas (quantities,) as a solution states them: with the uncertainty of a considered rig.

        Halves have the same rig, so it is the sigmas without that their differences tell of.
        """
        if self.fitted.screened.prepared.options.rig != "considered":
            return self.sigma
        system = with_rig(self.fitted, self.regular)
        if system is None:
            return self.sigma
        wide, reduced = system
        return self.sigmas(covariance_of(wide.template, reduced), wide.template)

    def sigmas(self, covariance: Covariance, template: FactorTemplate | None = None) -> FloatArray:
        """Formal sigmas (quantities,), of the problem that covariances are taken from or on a template."""
        template, state = template or self.regular.template, self.state
        stops = np.diagonal(template.stop_covariance(covariance), axis1=1, axis2=2)
        return _vector(
            template.angle_sigma_rad(covariance, state),
            template.relative_angle_sigma_rad(covariance, state, self.pairs),
            np.sqrt(stops.clip(0.0)),
        )

    def step(self, state: State) -> FloatArray:
        """Step (quantities,) from this optimum to another state."""
        angles = wrap_angle(state.pan_tilt_rad - self.state.pan_tilt_rad)
        masts = zip(self.state.world_T_mast, state.world_T_mast, strict=True)
        stops = np.array([here.localCoordinates(there) for here, there in masts])
        return _vector(angles, angles[self.pairs[:, 1]] - angles[self.pairs[:, 0]], stops)


def _vector(pointing: NDArray[_T], relative: NDArray[_T], stops: NDArray[_T]) -> NDArray[_T]:
    return np.concatenate([pointing.ravel(), relative.ravel(), stops.ravel()])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Verdict:
    """Step and sigmas of a half, compared with the whole."""

    failure: str
    """Sentence about what the half does not determine; "" if it determines everything."""
    step: FloatArray
    """(quantities,) step from the whole solution to the half's; NaN for frames and stops that the half
    loses."""
    sigma: FloatArray
    """(quantities,) formal sigma of the half; NaN as the step."""
    lost_frames: BoolArray
    """(frames,) frames that the half does not see, or cuts off."""
    lost_stops: BoolArray
    """(stops,) stops that the half does not see, or cuts off."""


class _Half:
    """The fit of half of the tracks, with all priors."""

    def __init__(self, whole: _Whole, name: _HalfName, landmarks: BoolArray) -> None:
        self.name, self.landmarks = name, landmarks
        self.problem: Problem | None = None
        self.covariance: Covariance | None = None
        self.verdict = self._solve(whole)

    def _solve(self, whole: _Whole) -> _Verdict:
        if not (self.landmarks & whole.problem.present).any():
            return _nothing(whole, "no track is of it")
        try:
            problem, outcome = refitted(whole.fitted, self.landmarks)
        except SolveError as error:
            return _nothing(whole, str(error))
        if not outcome.converged:
            return _nothing(whole, f"not converged ({outcome.reason})")
        part, failure, sigma = whole.part(self.landmarks), "", np.full(whole.n_quantities, np.nan)
        try:
            reduced = ReducedSystem.of(part, system_of(part, cliques=whole.cliques))
            self.covariance = covariance_of(part.template, reduced)
            sigma = whole.sigmas(self.covariance)
        except SolveError as error:
            failure = f"has no formal sigmas: {error}"
        self.problem = problem
        self.frames, stops = whole.groups(problem)
        lost_frames, lost_stops = whole.frames.lost_in(self.frames), whole.stops.lost_in(stops)
        lost = _vector(
            np.repeat(lost_frames, 2),
            np.repeat(~self.frames.joins(whole.pairs), 2),
            np.repeat(lost_stops, 6),
        )
        step = whole.step(problem.template.state(problem.values, np.zeros((0, 3))))
        return _Verdict(
            failure=failure,
            step=np.where(lost, np.nan, step),
            sigma=np.where(lost, np.nan, sigma),
            lost_frames=lost_frames,
            lost_stops=lost_stops,
        )


def _nothing(whole: _Whole, why: str) -> _Verdict:
    unknown = np.full(whole.n_quantities, np.nan)
    return _Verdict(
        failure=f"says nothing: {why}",
        step=unknown,
        sigma=unknown,
        lost_frames=np.zeros(len(whole.traverse.frames), dtype=bool),
        lost_stops=np.zeros(len(whole.traverse.stops), dtype=bool),
    )


_Verdicts = dict[Splitting, list[tuple[_Verdict, _Verdict]]]


def _sigmas(whole: _Whole, verdicts: _Verdicts) -> tuple[Sigmas, Sigmas, Sigmas]:
    """Sigmas of pointing, relative pointing and stops."""
    spread = {
        splitting: Spread.of(
            whole.sigma,
            np.array([[half.step for half in pair] for pair in pairs]),
            np.array([[half.sigma for half in pair] for pair in pairs]) ** 2,
        )
        for splitting, pairs in verdicts.items()
    }

    def part(begin: int, n: int, k: int) -> Sigmas:
        rows = slice(begin, begin + n * k)
        return Sigmas(
            formal=whole.formal[rows].reshape(n, k),
            random=spread["random"].part(rows, (n, k)),
            upper_lower=spread["upper_lower"].part(rows, (n, k)),
        )

    frames, pairs, stops = len(whole.traverse.frames), len(whole.pairs), len(whole.traverse.stops)
    return part(0, frames, 2), part(2 * frames, pairs, 2), part(2 * (frames + pairs), stops, 6)


def _score(whole: _Whole, splitting: Splitting, number: int, own: _Half, other: _Half) -> HalfScore:
    """Score of the tracks of a half, placed with its own cameras and with those of the other half.

    The squared whitened residuals after triangulation with cameras of error e have the expectation
    redundancy + trace(S cov(e)), where S is the landmarks' reduced system. Cameras that were adjusted to the
    same tracks follow their noise, so that the trace is then subtracted.
    """
    tracks, p, q = int((own.landmarks & whole.problem.present).sum()), own.problem, other.problem
    scored, n, px = 0, 0, [np.nan] * 4
    if p is not None and q is not None:
        m = p.measurements
        by_own, in_front = p.residuals
        by_other, also_in_front = p.at(q.values, p.landmarks).placed().residuals
        behind = np.bincount(m.landmark, p.kept & ~(in_front & also_in_front), minlength=m.n_landmarks) > 0
        which = p.present & ~behind & other.frames.joins_landmarks(m, whole.traverse.image_frame)
        rows = p.kept & which[m.landmark]
        scored, n = int(which.sum()), int(rows.sum())
        if n > 0:
            noise = whole.fitted.noise.select(m.row[rows])
            part = whole.part(which)
            system, _ = system_of(part, cliques=whole.cliques)
            panels = system.linearise(part.template.posture(part.values))
            redundancy = 2 * n - 3 * scored + int(system.undetermined.sum())
            follows, strays = (
                np.nan if half.covariance is None else panels.trace_with(half.covariance)
                for half in (own, other)
            )
            expected = np.clip([redundancy - follows, redundancy + strays], 0.0, None)
            own_px, other_px = (rms_px(noise.to_pixels(r[rows])) for r in (by_own, by_other))
            own_expected, other_expected = np.sqrt(np.mean(noise.sigma_px**2) * expected / n)
            px = [own_px, float(own_expected), other_px, float(other_expected)]
    return HalfScore(
        splitting=splitting,
        halving=number,
        half=own.name,
        tracks=tracks,
        scored=scored,
        observations=n,
        own_px=px[0],
        own_expected_px=px[1],
        other_px=px[2],
        other_expected_px=px[3],
    )


def _warnings(traverse: Traverse, verdicts: _Verdicts) -> list[str]:
    """Warnings of halves that failed, and of frames and stops that halves lost."""
    warnings = []
    for splitting, pairs in verdicts.items():
        for number, pair in enumerate(pairs, start=1):
            for name, half in zip(_NAMES[splitting], pair, strict=True):
                if half.failure:
                    which = f"{name} random half {number}" if splitting == "random" else f"{name} half"
                    warnings.append(f"{which} {half.failure}")
        halves = [half for pair in pairs for half in pair]
        which = "a random half" if splitting == "random" else "the upper or the lower half"
        for what, ids, lost in (
            ("frame", [f.id for f in traverse.frames], [half.lost_frames for half in halves]),
            ("stop", [s.id for s in traverse.stops], [half.lost_stops for half in halves]),
        ):
            names = [ids[row] for row in np.flatnonzero(np.any(lost, axis=0))]
            if names:
                warnings.append(
                    f"{listed(names, what)} that {which} does not see or cuts off from the others"
                )
    return warnings
