"""The verdict: every test of a solution, each with what it says.

Limits of statistical tests are set so that a right solution exceeds any of them in about one of a thousand
drives; others say how far the numbers may be off before a user should not rely on them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.cameras import FIELD_PER_COEFFICIENT
from pancam_graph.data import Refined, Traverse, Verdict, VerdictTest
from pancam_graph.graph import HardTemplate
from pancam_graph.solve._behind import points_behind
from pancam_graph.solve._chances import CHANCE, rms_limit, two_sided_limit
from pancam_graph.solve._common_pan import common_pans
from pancam_graph.solve._constraint_tests import ConstraintTest, constraint_verdict
from pancam_graph.solve._covariance import Uncertainty
from pancam_graph.solve._fit import Fitted
from pancam_graph.solve._growing_errors import GrowingErrors
from pancam_graph.solve._held_sureness import held_rig
from pancam_graph.solve._let_go import Part, most_let_go, sentence
from pancam_graph.solve._noise_tests import Residuals
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._reduced import ReducedSystem
from pancam_graph.solve._rig_score import HeldEntry, held_entries
from pancam_graph.solve._rig_told import RigTold, rig_told
from pancam_graph.solve._share_tests import let_go_links, shares_in_use
from pancam_graph.solve._stopping import sigmas_left
from pancam_graph.solve._telemetry_tests import Correction, Suspected, total

__all__ = ["Optimum", "verdict"]

_AT_OPTIMUM = 0.3
"""Largest distance to the optimum, in sigmas of the solution."""
_UNDERSTATED = 1.5
"""Largest ratio of residuals to the stated noise."""
_OVERSTATED = 2.0
"""Ratio of the stated noise to residuals from which it is said."""
_UNEVEN = 2.0
"""Largest ratio of an image's, or a camera's, residuals to those of all."""
_NAMED = 6
"""Parts of telemetry let go that are named."""
_BEATEN = 3.0
"""Change of an entry of the rig in sigmas of its prior from which it is said."""
_FIELD_BEATEN = 2.0
"""Size of a smooth distortion field in sigmas of its prior from which it is said: that of some hundred
coefficients drawn from the prior is within 0.8 and 1.2."""
_HELD_SHARE = 0.02
"""Share of the cost by which a held number of the rig must lower it too, beside what chance explains.

Gains of large problems are raised from a part."""


_SCALE_CHANCE = 1e-3
"""Chance that lengths of a right drive fail: one number, which everything in the drive hangs on."""
_UNCONFIRMED = 2.0
"""Expected growth of a sigma, over the odds that a held rig is exact and that it is off as it says."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Optimum:
    """A fit at its end, as the tests look at it."""

    fitted: Fitted
    problem: Problem
    """As covariances are taken from it."""
    reduced: ReducedSystem | None
    """Its reduced system; None where no covariances could be computed."""
    uncertainty: Uncertainty
    used: BoolArray
    """(observations,) whether each is in use."""
    cost_initial: float
    """Cost at the start, over the same observations."""
    let_go: Sequence[Part]
    """What of telemetry was let go."""
    constraints: Sequence[ConstraintTest]

    @property
    def traverse(self) -> Traverse:
        """The input."""
        return self.fitted.screened.prepared.traverse

    @cached_property
    def suspected(self) -> Suspected | None:
        """Errors that telemetry may have; None where covariances are unknown."""
        u = self.uncertainty
        if u.variables is None or u.masts is None:
            return None
        return Suspected.of(self.problem, u, is_far=self.fitted.expected is not None)


def verdict(at: Optimum) -> Verdict:
    """All tests of a fit."""
    residuals = Residuals.of(at.fitted.problem)
    tests = [_converged(at), _finite(residuals), _cost(at), _optimum(at)]
    tests += shares_in_use(at.fitted.problem)
    if residuals.n_observations:
        tests += _noise(at, residuals)
    tests += [
        _sigmas(at),
        *_telemetry(at),
        _let_go(at),
        *constraint_verdict(at.constraints),
        *let_go_links(at.fitted.problem),
        *points_behind(at.traverse, float(np.mean(at.used)) if len(at.used) else 1.0),
        *_freed(at),
        *_fields(at),
        *_held(at),
    ]
    return Verdict(tests=tuple(tests))


def _converged(at: Optimum) -> VerdictTest:
    outcome = at.fitted.outcome
    return VerdictTest.of(
        "converged",
        0.0 if outcome.converged else 1.0,
        0.0,
        f"iterations ended: {outcome.reason}",
        f"iterations ended too early: {outcome.reason}; allow more (--stop max_iterations=1000)",
    )


def _finite(residuals: Residuals) -> VerdictTest:
    n = residuals.n_not_finite
    return VerdictTest.of(
        "finite",
        float(n) if residuals.n_observations else np.inf,
        0.0,
        f"residuals of all {residuals.n_observations} observations in use are finite",
        f"{n} of {residuals.n_observations} observations in use have no finite residual: "
        "cameras or points have left the domain of their model",
    )


def _cost(at: Optimum) -> VerdictTest:
    before, after = at.cost_initial, at.fitted.problem.cost()
    return VerdictTest.of(
        "cost",
        after - before,
        1e-6 * (1 + abs(before)),
        f"cost fell from {before:.6g} to {after:.6g} over the same observations",
        f"cost rose from {before:.6g} to {after:.6g} over the same observations: the solution is worse than "
        "the start; check matches, rig and telemetry",
    )


def _optimum(at: Optimum) -> VerdictTest:
    """The step that is left, in the metric of the information: no number is further off in its sigmas."""
    name, limit = "optimum", _AT_OPTIMUM
    if at.reduced is None:
        text = "distance to the optimum is unknown: the system has a free direction"
        return VerdictTest.of(name, np.nan, limit, text, text)
    # Landmarks at expected ranges are not where they fit best: only those fitted have a step of their own.
    alone = at.reduced.system.gain_alone if at.fitted.expected is None else 0.0
    ahead = at.reduced.gain + alone
    off = sigmas_left(at.fitted.outcome.costs, ahead)
    return VerdictTest.of(
        name,
        off,
        limit,
        f"at the optimum to {off:.2g} sigma",
        f"{off:.2g} sigma from the optimum: the last steps still moved it; "
        "go on further (--stop relative_decrease=1e-12 max_iterations=1000)",
    )


def _noise(at: Optimum, residuals: Residuals) -> Iterator[VerdictTest]:
    prepared, t = at.fitted.screened.prepared, at.traverse
    ratio = residuals.ratio
    if prepared.rescales_noise:
        sigma = float(np.median(at.fitted.noise.sigma_px[at.used])) if at.used.any() else np.nan
        yield VerdictTest.of("noise", None, _UNDERSTATED, f"noise was estimated: {sigma:.3g} px (median)", "")
    else:
        fits = f"residuals are {ratio:.3g} times what the stated sigmas make them"
        advice = "let the residuals decide (--noise estimated), or give other sigmas"
        yield VerdictTest.of(
            "noise",
            ratio,
            _UNDERSTATED,
            fits,
            f"{fits}: sigmas of the observations are {ratio:.3g} times too small, or the rig is wrong, and "
            f"all formal sigmas with them; {advice}",
        )
        inverse = 1 / max(ratio, 1e-9)
        yield VerdictTest.note(
            "noise overstated",
            inverse,
            _OVERSTATED,
            fits,
            f"{fits}: sigmas of the observations are {inverse:.3g} times too large, so that telemetry counts "
            f"for too much and formal sigmas are too large; {advice}",
        )
    eyes = [eye.name for eye in t.rig.eyes]
    yield _uneven("camera", residuals, t.image_eye, eyes)
    yield _uneven("image", residuals, np.arange(len(t.images)), [i.id for i in t.images])
    yield from _noise_let_go(at.fitted.problem, residuals)


def _noise_let_go(problem: Problem, residuals: Residuals) -> Iterator[VerdictTest]:
    """That frames whose pan or tilt was let go fit like all others; none where no frame's was."""
    t, frames = problem.template.traverse, np.flatnonzero(problem.template.let_go.angles_rad.any(axis=1))
    if not len(frames):
        return
    sure = _over_all(residuals, t.image_frame, len(t.frames), of=len(frames))[1][frames]
    worst = int(np.argmax(sure))
    name = t.frames[frames[worst]].id
    yield VerdictTest.of(
        "noise let go",
        float(sure[worst]),
        1.0,
        "frames whose telemetry was let go fit like all others",
        f"residuals of frame {name}, whose telemetry was let go, are {sure[worst]:.3g} times what chance "
        "allows: its pixels are probably wrong, not its pointing; leave it out",
    )


def _over_all(residuals: Residuals, owner: IntArray, n: int, *, of: int) -> tuple[FloatArray, FloatArray]:
    """Residuals of each of n owners over those of all (n,), and that over what chance allows (n,).

    `owner` is that of each image; chance is that of the worst of so many owners. The second is 0 for owners
    with hardly any observations.
    """
    ratio, freedom = residuals.by(owner, n)
    ratio = ratio / max(residuals.ratio, 1e-300)
    return ratio, np.where(freedom >= 1, ratio / rms_limit(freedom, CHANCE / of), 0.0)


def _uneven(name: str, residuals: Residuals, owner: IntArray, ids: Sequence[str]) -> VerdictTest:
    """The owner whose residuals exceed those of all by most, less what chance may add."""
    ratio, sure = _over_all(residuals, owner, len(ids), of=len(ids))
    worst = int(np.argmax(sure))
    says = f"residuals of {name} {ids[worst]} are {ratio[worst]:.3g} times those of all"
    return VerdictTest.of(
        f"{name} noise",
        float(sure[worst]),
        _UNEVEN,
        says,
        f"{says}: its calibration, its mount or its pixels are probably wrong; free it further (a larger "
        f"uncertainty of the rig, or --sharing mounts=eye calibration=eye), or leave it out",
    )


def _sigmas(at: Optimum) -> VerdictTest:
    """Every sigma is known, and the least known position of a stop is named."""
    u, t = at.uncertainty, at.traverse
    unknown = int(np.isnan(u.angle_sigma_rad).any(axis=1).sum() + np.isnan(u.stop_covariance[:, 0, 0]).sum())
    good = "every stop and frame has its sigmas"
    if unknown == 0:
        values, vectors = np.linalg.eigh(u.stop_covariance[:, 3:, 3:])
        worst = int(np.argmax(values[:, -1]))
        if values[worst, -1] > 0:
            x, y, z = vectors[worst, :, -1]
            good += (
                f"; least known is the position of {t.stops[worst].id}: {1e3 * values[worst, -1] ** 0.5:.3g} "
                f"mm along ({x:.2f}, {y:.2f}, {z:.2f}) of its mast"
            )
        good += _if_independent(at)
    return VerdictTest.of(
        "sigmas",
        float(unknown),
        0.0,
        good,
        f"{unknown} stops and frames have no sigmas, since nothing holds a direction of the solution; "
        "give telemetry a sigma, or hold a stop",
    )


def _if_independent(at: Optimum) -> str:
    """Which sigma hangs most on telemetry's word that pans err independently, and by how much."""
    some = [] if at.suspected is None else list(common_pans(at.suspected.telemetry))
    if not some:
        return ""
    worst = max(some, key=lambda one: one.sigmas)
    sigma, pan, pan_sigma, heading, heading_sigma, cameras, cameras_sigma = (
        f"{abs(np.degrees(angle)):.3f}"
        for angle in (
            worst.sigma_rad,
            worst.pan_rad,
            worst.pan_sigma_rad,
            worst.heading_rad,
            worst.heading_sigma_rad,
            worst.pointing_rad,
            worst.pointing_sigma_rad,
        )
    )
    says = (
        f"; pans count as independent: an error of {sigma} degrees that all pans at "
        f"{at.traverse.stops[worst.stop].id} share would go unseen, and turn pans by {pan} degrees (stated "
        f"sigma {pan_sigma})"
    )
    if worst.heading_sigma_rad > 0:
        says += (
            f", heading by {heading} the other way ({heading_sigma}), and cameras, by both, by {cameras} "
            f"({cameras_sigma})"
        )
    return says


def _telemetry(at: Optimum) -> Iterator[VerdictTest]:
    """Corrections over their sigmas: all together, of angles, and of stops."""
    suspected = at.suspected
    if suspected is None:
        return
    rms, freedom = total(suspected.telemetry)
    if freedom > 0:
        says = f"corrections of telemetry are {rms:.3g} times what its sigmas and the images allow (RMS)"
        yield VerdictTest.of(
            "telemetry",
            rms,
            float(rms_limit(freedom, CHANCE)),
            says,
            f"{says}: give telemetry larger sigmas, or look for a wrong rig or wrong matches",
        )
    angles, stops = suspected.angles, suspected.stops
    for name, some, widen in (
        ("pointing", angles, "widen sigma_pan_rad and sigma_tilt_rad there"),
        ("stops", stops, "widen sigma_translation_m and sigma_rotation_rad there"),
    ):
        if some:
            worst = some.largest
            says = _describe(worst, at.traverse)
            yield VerdictTest.of(
                name,
                worst.sigmas,
                two_sided_limit(len(some), CHANCE),
                f"largest correction: {says}",
                f"{says}: this telemetry, or what the images say of it, is wrong; {widen}, or check the rig",
            )
    if suspected.growing is not None:
        yield from _growing(suspected.growing)


def _growing(found: GrowingErrors) -> Iterator[VerdictTest]:
    """Errors of telemetry that grow along the drive: one scale of all lengths, a turn, and drifts."""
    if found.scale is not None:
        share, sigmas = found.scale
        says = (
            f"lengths between stops came out {abs(share):.2%} {'longer' if share > 0 else 'shorter'} than "
            f"telemetry has them, {sigmas:.3g} times what sigmas allow"
        )
        yield VerdictTest.of(
            "scale",
            sigmas,
            two_sided_limit(1, _SCALE_CHANCE),
            says,
            f"{says}: the distance of the eyes (baseline) or odometry is wrong, and images cannot say which; "
            "check both, or state larger sigmas (rig: uncertainty, mount_m; sigma_translation_m)",
        )
    if found.turn is not None:
        turn, sigmas = found.turn
        says = (
            f"the drive came out turned by {np.degrees(turn):+.3g} degrees against telemetry, {sigmas:.3g} "
            "times what sigmas allow"
        )
        yield VerdictTest.of(
            "turn",
            sigmas,
            two_sided_limit(1, CHANCE),
            says,
            f"{says}: pans are off in common, or odometry or the first heading is wrong, and images cannot "
            "say which; check these, or state larger sigmas (sigma_pan_rad, sigma_translation_m)",
        )
    if found.drift is not None:
        per_m, square, freedom = found.drift
        value = float(np.sqrt(square / freedom))
        says = (
            f"stops drift from telemetry by {1e3 * np.linalg.norm(per_m):.3g} mm a metre driven, "
            f"{value:.3g} times what sigmas allow (RMS)"
        )
        yield VerdictTest.of(
            "drift",
            value,
            float(rms_limit(freedom, CHANCE)),
            says,
            f"{says}: errors of odometry add up, while its sigmas count them as independent; let "
            "sigma_translation_m grow along the drive, state each leg with its own sigma (constraints: "
            "stop-pose), or check the rig",
        )


def _let_go(at: Optimum) -> VerdictTest:
    """Parts of telemetry that were let go; too many fail."""
    parts, most = at.let_go, most_let_go(at.traverse)
    if not parts:
        return VerdictTest.note("let go", 0.0, 0.0, "no telemetry was let go", "")
    some = "; ".join(sentence(part) for part in parts[:_NAMED])
    says = f"{len(parts)} part{'s' if len(parts) > 1 else ''} of telemetry let go: {some}"
    if len(parts) > _NAMED:
        says += f"; and {len(parts) - _NAMED} more"
    exact, limit = _held_against(at), 0.0
    if exact:
        why = (
            f"but {exact} is said to be exact, and all others of its stop went along with it; give it a sigma"
        )
    elif _no_place_left(at):
        why = (
            "nothing of where stops stand is left, so that the rig alone tells how long all is, and pans "
            "alone which way; check odometry, the distance of the eyes (baseline), and whether all pans are "
            "off in common"
        )
    elif len(parts) > most:
        limit, why = float(most), "too many to believe the rest; check telemetry, its sigmas, and the rig"
    else:
        return VerdictTest.note("let go", float(len(parts)), 0.0, "", f"{says}; look where it came from")
    return VerdictTest.of("let go", float(len(parts)), limit, "", f"{says}: {why}")


def _no_place_left(at: Optimum) -> bool:
    """Whether the places of all stops that telemetry does not hold were let go, and not by one common shift.

    Odometry may then as well be right, and what the places were compared with is wrong. Where all went along
    with the first leg, their places among each other still speak for the rest.
    """
    stops = at.traverse.stops
    free = np.flatnonzero([s.sigma_translation_m > 0 for s in stops])
    if not len(free) or not at.fitted.problem.template.let_go.stops[free, 3:].any(axis=1).all():
        return False
    if len(free) < 2 or len(free) == len(stops):
        return True
    found = at.fitted.problem.template.masts(at.fitted.problem.values)
    shift = np.array([found[s].translation() - stops[s].world_T_mast.translation() for s in free])
    weight = np.array([stops[s].sigma_translation_m ** -2.0 for s in free])
    apart = shift - weight @ shift / weight.sum()
    freedom = 3 * (len(free) - 1)
    return bool(np.sqrt(weight @ (apart**2).sum(axis=1) / freedom) > rms_limit(freedom, CHANCE))


def _held_against(at: Optimum) -> str:
    """A pan or tilt that telemetry holds at a stop where that of all frames was let go; empty: there is none.

    The others then agree with each other and not with it, and it may as well be the one that is wrong.
    """
    t, common = at.traverse, at.fitted.problem.template.let_go.common_rad
    for row, k in np.argwhere((t.pan_tilt_sigmas_rad == 0) & (common[t.frame_stop] > 0)):
        return f"the {('pan', 'tilt')[k]} of {t.frames[row].id}"
    return ""


def _describe(c: Correction, t: Traverse) -> str:
    """A correction as people read it."""
    stop = t.stops[c.stop].id
    turn = f"{np.degrees(c.size):+.3g} degrees"
    by = f"by {c.sigmas:.3g} times what its sigma allows"
    if c.entry.startswith("leg"):
        before = t.stops[c.stop - 1].id
        return f"{c.entry.removeprefix('leg ')} from {before} to {stop} moved by {c.size:+.3g} m, {by}"
    if c.frame is not None:
        return f"{c.entry} of {t.frames[c.frame].id} moved by {turn}, {by}"
    if c.is_common:
        return f"every {c.entry} at {stop} moved by {turn} in common, {by}"
    size = f"{c.size:+.3g} m" if c.entry in {"x", "y", "z"} else turn
    return f"{c.entry} of {stop} moved by {size}, {by}"


def _freed(at: Optimum) -> Iterator[VerdictTest]:
    """Entries of the rig that were free, against their priors."""
    refined = at.problem.template.refined(at.problem.values, at.uncertainty.rig_sigmas)
    if refined:
        yield _against_uncertainty(refined)
    some = []
    for r in refined:
        told = r.prior_sigma**2 - r.sigma**2
        if np.isfinite(told) and told > 1e-6 * r.prior_sigma**2:
            some.append((abs(r.change) / np.sqrt(told), r))
    if some:
        worst, r = max(some, key=lambda pair: pair[0])
        says = f"largest correction of the rig: {r.entry} of {r.quantity} by {r.change:+.3g}"
        yield VerdictTest.of(
            "rig",
            float(worst),
            two_sided_limit(len(some), CHANCE),
            says,
            f"{says}, {worst:.3g} times what its prior allows: the rig is probably another one, or needs "
            "more of its numbers free",
        )


def _fields(at: Optimum) -> Iterator[VerdictTest]:
    """Smooth distortion fields that were free, against their priors."""
    template = at.problem.template
    rig = template.correction(at.problem.values)
    if rig is None or rig.field_px is None or not isinstance(template, HardTemplate):
        return
    size_px = FIELD_PER_COEFFICIENT * np.sqrt(np.mean(rig.field_px**2, axis=(1, 2, 3)))
    share = template.rig_variables.field_sigmas(rig.field_px)
    eye = int(np.argmax(share))
    name = at.traverse.rig.eyes[eye].name
    says = f"smooth field of {name}: {size_px[eye]:.2g} px from the rig's, {share[eye]:.2g} times its "
    yield VerdictTest.note(
        "field",
        float(share[eye]),
        _FIELD_BEATEN,
        f"{says}sigma at most",
        f"{says}uncertainty: the lens is another one than the rig says; look for a better calibration, or "
        "state a larger field_px (rig: uncertainty in traverse.json)",
    )


def _against_uncertainty(refined: Sequence[Refined]) -> VerdictTest:
    """The entry that left its prior by most of the prior's own sigmas."""
    worst = max(refined, key=lambda r: abs(r.change) / r.prior_sigma)
    sigmas = abs(worst.change) / worst.prior_sigma
    whose = f" of {worst.camera}" if worst.camera else ""
    says = f"{worst.entry} of {worst.quantity}{whose} moved by {worst.change:+.3g}, {sigmas:.2g} times its "
    return VerdictTest.note(
        "rig uncertainty",
        sigmas,
        _BEATEN,
        f"the rig stays within its uncertainty: {says}sigma at most",
        f"{says}uncertainty: the rig is probably off there; state a larger one (rig: uncertainty in "
        "traverse.json), or look for a better calibration",
    )


def _held(at: Optimum) -> Iterator[VerdictTest]:
    """The held number of the rig whose freedom would lower the cost by most."""
    if at.reduced is None or not at.fitted.outcome.converged:
        return
    try:
        told = rig_told(at.problem)
    except SolveError:  # images do not determine the system with these numbers free
        return
    # Explicit landmarks have cameras of their own: only what they were fitted with is scored.
    scored = told is not None and isinstance(at.fitted.problem.template, HardTemplate)
    held = held_entries(told) if told is not None and scored else []
    if held:
        cost = at.fitted.problem.cost()
        best = max(held, key=lambda e: e.gain)
        treatment = at.fitted.screened.prepared.options.rig
        exact = "; sigmas take it for exact (--rig considered counts its uncertainty)"
        # A considered rig may be off: its sigmas say so.
        yield (VerdictTest.note if treatment == "considered" else VerdictTest.of)(
            "held rig",
            best.gain,
            max(0.5 * two_sided_limit(len(held), CHANCE) ** 2, _HELD_SHARE * cost),
            f"no held number of the rig would lower the cost by much{exact if treatment == 'held' else ''}",
            _advice(best, cost),
        )
    yield from _unconfirmed(at, told)


def _unconfirmed(at: Optimum, told: RigTold | None) -> Iterator[VerdictTest]:
    """A rig that is held, of which images do not say that it is exact, against what hangs on it."""
    found = held_rig(at.problem, at.uncertainty, told)
    if found is None:
        return
    for_it = found.log_odds >= 0
    odds = f"{np.exp(min(abs(found.log_odds), 20.0)):.3g} to 1 {'for' if for_it else 'against'} it"
    yield VerdictTest.of(
        "held rig confirmed",
        found.expected_growth,
        _UNCONFIRMED,
        f"images say that the held rig is exact ({odds}), or little hangs on it",
        f"the rig is held, but images do not say that it is exact ({odds}): if it is off as its uncertainty "
        f"says, {found.what} is at least {found.growth:.2g} times less sure than stated; estimate it (--rig "
        "estimated), count its uncertainty (--rig considered), or say in traverse.json that it is exact (an "
        "uncertainty of 0)",
    )


def _advice(entry: HeldEntry, cost: float) -> str:
    whose = f" of {entry.camera}" if entry.camera else ""
    left = max(cost - entry.gain, 0.0)
    return (
        f"freeing {entry.entry} of {entry.quantity}{whose} would lower the cost from {cost:.4g} to about "
        f"{left:.4g} ({entry.change:+.3g}): the rig is wrong by more than pixels tell, and formal sigmas are "
        f"too small; estimate it (--rig estimated), or try --sharing "
        f"{entry.quantity}={entry.scope}:{entry.entry}"
    )
