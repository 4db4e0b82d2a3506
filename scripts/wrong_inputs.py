"""Give drives with known truth one wrong input at a time, and print what solutions and verdicts make of it.

For each fault a line of a Markdown table: runs that passed their tests, runs that let telemetry go; of those
that passed the mean squared error over variance, the largest error in formal sigmas, and how many are silent
failures (beyond 6 sigma); and the tests that failed most often. Groups are outliers, rigs that are off (held
or estimated), telemetry, far terrain, stated noise, and unusual ways in. The same options give the same
numbers.

Exit status: 0 no silent failure, 1 some, 2 bad input.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pancam_graph import Freedom, Observations, Sharing, Solution, SolveOptions, Traverse, simulate, solve
from pancam_graph.base.errors import InputError, PancamGraphError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cli import Progress, ScriptParser, run
from pancam_graph.initialise import Start
from pancam_graph.rigs import rig_template
from pancam_graph.simulate import Simulation, SimulationOptions
from pancam_graph.smoother._incremental import solve_incrementally

_HEADING_RAD = 0.01
"""Sigma of the rotation of a stop that was held; that of the others."""
_SILENT = 6.0
"""Error in formal sigmas from which a solution that passed its tests is a silent failure."""

Fault = Callable[[Simulation, np.random.Generator], Traverse]
"""A traverse with something wrong, of a simulation that is right."""


def _right(s: Simulation, rng: np.random.Generator) -> Traverse:
    return s.traverse


def _frame(*, pan: float = 0.0, tilt: float = 0.0) -> Fault:
    """The pan or the tilt of one frame is wrong by so many degrees."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        frames = list(s.traverse.frames)
        i = int(rng.integers(len(frames)))
        before = frames[i]
        frames[i] = replace(
            before,
            pan_rad=before.pan_rad + float(np.deg2rad(pan)),
            tilt_rad=before.tilt_rad + float(np.deg2rad(tilt)),
        )
        return replace(s.traverse, frames=tuple(frames))

    return fault


def _stop_pans(degrees: float, stated_degrees: float) -> Fault:
    """All pans of the last stop are wrong in common, and said to be good."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        t, sigma = s.traverse, float(np.deg2rad(stated_degrees))
        truth = s.truth.pan_tilt_rad
        frames = []
        for i, frame in enumerate(t.frames):
            pan, tilt = truth[i] + sigma * rng.standard_normal(2)
            off = float(np.deg2rad(degrees)) if frame.stop == t.stops[-1].id else 0.0
            frames.append(
                replace(
                    frame,
                    pan_rad=float(pan + off),
                    tilt_rad=float(tilt),
                    sigma_pan_rad=sigma,
                    sigma_tilt_rad=sigma,
                )
            )
        return replace(t, frames=tuple(frames))

    return fault


def _leg(sigmas: float) -> Fault:
    """Odometry of one leg is wrong: all later stops are shifted."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        stops = list(s.traverse.stops)
        first = int(rng.integers(1, len(stops)))
        turn = rng.uniform(0, 2 * np.pi)
        for i in range(first, len(stops)):
            pose, size = stops[i].world_T_mast, sigmas * stops[i].sigma_translation_m
            shift = size * np.array([np.cos(turn), np.sin(turn), 0.0])
            moved = type(pose)(pose.rotation(), pose.translation() + shift)
            stops[i] = replace(stops[i], world_T_mast=moved)
        return replace(s.traverse, stops=tuple(stops))

    return fault


def _adding_up(sigmas: float) -> Fault:
    """Odometry of each leg is wrong by as much, in the same direction of the world."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        turn = rng.uniform(0, 2 * np.pi)
        stops = []
        for i, stop in enumerate(s.traverse.stops):
            pose, size = stop.world_T_mast, i * sigmas * stop.sigma_translation_m
            shift = size * np.array([np.cos(turn), np.sin(turn), 0.0])
            moved = type(pose)(pose.rotation(), pose.translation() + shift)
            stops.append(replace(stop, world_T_mast=moved))
        return replace(s.traverse, stops=tuple(stops))

    return fault


def _far(range_m: float, n: int = 800) -> Fault:
    """All that the stops see are n points at about this range, all around, of which each is seen by both."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        t, truth = s.traverse, s.truth
        assert t.observations is not None  # simulated
        azimuth, elevation = rng.uniform(-np.pi, np.pi, n), np.deg2rad(rng.uniform(-6, 8, n))
        level = np.cos(elevation)
        direction = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        ranges = range_m * np.exp(0.1 * rng.standard_normal(n))
        points = truth.world_T_mast[0].translation() + ranges[:, None] * direction
        R, centre = t.camera_poses(truth.world_T_mast, truth.pan_tilt_rad)
        found = []
        for i, eye in enumerate(t.image_eye):
            camera = truth.rig.eyes[int(eye)].camera
            ray = (points - centre[i]) @ R[i]
            uv_px, valid = camera.project(ray)
            seen = np.flatnonzero(valid & (ray[:, 2] > 0) & camera.contains(uv_px))
            found.append((np.full(len(seen), i), seen, uv_px[seen]))
        image, track, uv = (np.concatenate(part) for part in zip(*found, strict=True))
        stop = t.image_stop[image]
        shared = np.isin(track, track[stop == 0]) & np.isin(track, track[stop == 1])
        noise_px = float(np.median(t.observations.sigma_px))
        uv = uv[shared] + noise_px * rng.standard_normal((int(shared.sum()), 2))
        sigma_px = np.full(len(uv), noise_px)
        return t.with_observations(
            Observations(image=image[shared], track=track[shared], uv_px=uv, sigma_px=sigma_px)
        )

    return fault


def _shifted_image(px: float, *, both_eyes: bool) -> Fault:
    """All observations of one image, or of one frame, are shifted."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        t = s.traverse
        assert t.observations is not None  # simulated
        o = t.observations
        image = int(rng.integers(len(t.images)))
        of = t.image_frame[o.image] == t.image_frame[image] if both_eyes else o.image == image
        uv = o.uv_px.copy()
        uv[of, 0] += px
        return t.with_observations(replace(o, uv_px=uv))

    return fault


def _neighbouring_rock(share: float, distance_m: float) -> Fault:
    """From some image on, a share of the tracks is of another point near by."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        t = s.traverse
        assert t.observations is not None  # simulated
        o = t.observations
        tracks = np.unique(o.track)
        wrong = np.isin(o.track, rng.choice(tracks, int(share * len(tracks)), replace=False))
        # The later half of the images of each track sees the other rock.
        later = np.zeros(len(o), dtype=bool)
        for track in np.unique(o.track[wrong]):
            rows = np.flatnonzero(o.track == track)
            frames = np.unique(t.image_frame[o.image[rows]])
            later[rows] = t.image_frame[o.image[rows]] >= frames[len(frames) // 2]
        moved = wrong & later
        offset = rng.standard_normal((len(s.truth.landmarks_m), 3))
        offset *= distance_m / np.linalg.norm(offset, axis=1)[:, None]
        point = s.truth.landmarks_m[o.track]
        R, centre = t.camera_poses(s.truth.world_T_mast, s.truth.pan_tilt_rad)
        uv = o.uv_px.copy()
        for i in np.unique(o.image[moved]):
            rows = np.flatnonzero(moved & (o.image == i))
            camera = s.truth.rig.eyes[int(t.image_eye[i])].camera
            beside = point[rows] + offset[o.track[rows]]
            there, here = (camera.project((at - centre[i]) @ R[i])[0] for at in (beside, point[rows]))
            uv[rows] += there - here
        return t.with_observations(replace(o, uv_px=uv))

    return fault


def _mirrored(s: Simulation, rng: np.random.Generator) -> Traverse:
    """All images are mirrored, left to right."""
    t = s.traverse
    assert t.observations is not None  # simulated
    o = t.observations
    width = np.array([eye.camera.width_px for eye in t.rig.eyes])[t.image_eye[o.image]]
    mirrored = np.column_stack([width - 1 - o.uv_px[:, 0], o.uv_px[:, 1]])
    return t.with_observations(replace(o, uv_px=mirrored))


def _pans(change: Callable[[FloatArray], FloatArray]) -> Fault:
    """The pans of each stop are others."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        t = s.traverse
        pan = t.pan_tilt_rad[:, 0].copy()
        for stop in range(len(t.stops)):
            of = t.frame_stop == stop
            pan[of] = change(pan[of])
        frames = [replace(f, pan_rad=float(p)) for f, p in zip(t.frames, pan, strict=True)]
        return replace(t, frames=tuple(frames))

    return fault


def _apart_mounts(factor: float) -> Fault:
    """The rig claims its mounts farther apart than they are."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        eyes = s.traverse.rig.eyes
        middle = np.mean([eye.head_T_camera.translation() for eye in eyes], axis=0)
        moved = []
        for eye in eyes:
            mount = eye.head_T_camera
            place = middle + factor * (mount.translation() - middle)
            moved.append(replace(eye, head_T_camera=type(mount)(mount.rotation(), place)))
        return replace(s.traverse, rig=replace(s.traverse.rig, eyes=tuple(moved)))

    return fault


def _stated_noise(factor: float) -> Fault:
    """Observations state their sigmas too large or too small."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        o = s.traverse.observations
        assert o is not None  # simulated
        return s.traverse.with_observations(replace(o, sigma_px=o.sigma_px * factor))

    return fault


def _tiny_sigmas(share: float) -> Fault:
    """A share of the observations states a sigma of 1e-6 pixels, though all are 0.3 pixels off."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        o = s.traverse.observations
        assert o is not None  # simulated
        tiny = rng.random(len(o)) < share
        return s.traverse.with_observations(replace(o, sigma_px=np.where(tiny, 1e-6, o.sigma_px)))

    return fault


def _apart(s: Simulation, rng: np.random.Generator) -> Traverse:
    """Half of the observations are a million times noisier than the other half, and say so."""
    o = s.traverse.observations
    assert o is not None  # simulated
    good = rng.random(len(o)) < 0.5
    t, truth = s.traverse, s.truth
    R, centre = t.camera_poses(truth.world_T_mast, truth.pan_tilt_rad)
    uv = o.uv_px.copy()
    for i in np.unique(o.image[good]):
        rows = np.flatnonzero(good & (o.image == i))
        camera = truth.rig.eyes[int(t.image_eye[i])].camera
        seen = camera.project((truth.landmarks_m[o.track[rows]] - centre[i]) @ R[i])[0]
        uv[rows] = seen + 1e-6 * (o.uv_px[rows] - seen)
    sigma = np.where(good, 1e-6 * o.sigma_px, o.sigma_px)
    return t.with_observations(replace(o, uv_px=uv, sigma_px=sigma))


def _shuffled(s: Simulation, rng: np.random.Generator) -> Traverse:
    """Stops in another order than they were driven in."""
    order = rng.permutation(len(s.traverse.stops))
    return replace(s.traverse, stops=tuple(s.traverse.stops[i] for i in order))


def _unseen_stop(s: Simulation, rng: np.random.Generator) -> Traverse:
    """The frames of one stop have no observations."""
    t = s.traverse
    assert t.observations is not None  # simulated
    blind = int(rng.integers(len(t.stops)))
    return t.with_observations(t.observations.select(t.image_stop[t.observations.image] != blind))


def _no_frames(s: Simulation, rng: np.random.Generator) -> Traverse:
    """One more stop, at which no frame was taken."""
    last = s.traverse.stops[-1]
    return replace(s.traverse, stops=(*s.traverse.stops, replace(last, id="without-frames")))


def _none_held(sigma_m: float) -> Fault:
    """The position of no stop is held, and none is known to better than `sigma_m`."""

    def fault(s: Simulation, rng: np.random.Generator) -> Traverse:
        stops = [
            replace(
                stop,
                sigma_translation_m=sigma_m,
                sigma_rotation_rad=stop.sigma_rotation_rad or _HEADING_RAD,
            )
            for stop in s.traverse.stops
        ]
        return replace(s.traverse, stops=tuple(stops))

    return fault


def _one_eye_first(s: Simulation, rng: np.random.Generator) -> Traverse:
    """The first stop has pictures of one eye alone."""
    t = s.traverse
    assert t.observations is not None  # simulated
    keep = (t.image_stop > 0) | (t.image_eye == 0)
    place = np.cumsum(keep) - 1
    o = t.observations.select(keep[t.observations.image])
    images = tuple(image for image, kept in zip(t.images, keep, strict=True) if kept)
    return replace(t, images=images, observations=replace(o, image=place[o.image]))


@dataclass(frozen=True, kw_only=True)
class Case:
    """A fault, the drives that get it, and how these are solved."""

    fault: Fault = _right
    drive: Mapping[str, object] = field(default_factory=dict)
    """Options of the simulation beside the usual ones."""
    options: SolveOptions = field(default_factory=SolveOptions)
    other_turns: bool = False
    """Whether first pans are in 0 to 2 pi, and some so a turn from telemetry's."""
    incremental: bool = False
    """Whether it is solved stop by stop, whatever the command line says."""


_FEW_LINKS = {"stops": 1, "pans": 7, "points_per_image": 15}
"""One panorama whose frames have few neighbours: many have one alone."""
_ROW = {"pans": 8}
"""Whole turns of few frames."""
_SMALL = {"pans": 4, "sweep_rad": 2.0, "points_per_image": 15}
"""Four pans that overlap, of few points: a tenth of the time."""
_DOWN = {"spacing_m": 0.5, "pans": 6, "tilts_rad": (-np.pi / 2,)}
"""Heads that look straight down, at stops so close that they see the same ground."""
_MOUNTS = SolveOptions(sharing=Sharing(mounts=Freedom(scope="eye")))
_HELD = SolveOptions(rig="held")
_ESTIMATED_NOISE = SolveOptions(rescale_noise=True)
_SEVERAL = {"stops": 4}
_FAR_APART = {"spacing_m": 2.0, "pans": 10, "tilts_rad": (0.0,)}
GROUPS: dict[str, dict[str, Case]] = {
    "outliers": {
        "3 % outliers": Case(drive={"outliers": 0.03}),
        "10 % outliers": Case(drive={"outliers": 0.1}),
        **{
            f"{100 * share:.0f} % outliers": Case(drive={"outliers": share})
            for share in (0.33, 0.4, 0.5, 0.6)
        },
        "60 % outliers, one stop": Case(drive={"outliers": 0.6, "stops": 1}),
        "60 % outliers, three views and more": Case(drive={"outliers": 0.6, "min_views": 3}),
        "60 % outliers, noise estimated": Case(drive={"outliers": 0.6}, options=_ESTIMATED_NOISE),
        "40 % outliers, stop by stop": Case(drive={"outliers": 0.4}, incremental=True),
        "60 % outliers, stop by stop": Case(drive={"outliers": 0.6}, incremental=True),
    },
    "rigs": {
        "right": Case(),
        "right, held": Case(options=_HELD),
        **{
            f"{name}{', held' * held}": Case(drive=drive, options=_HELD if held else SolveOptions())
            for name, drive in (
                ("focal length off by 0.2 %", {"focal_error": 2e-3}),
                ("mounts off by 0.5 mrad", {"mount_error_rad": 5e-4}),
            )
            for held in (False, True)
        },
        "mounts 5 % farther apart": Case(fault=_apart_mounts(1.05), drive=_ROW),
        "mounts 5 % farther apart, odometry of 1 %": Case(
            fault=_apart_mounts(1.05), drive=_ROW | {"sigma_stop_m": 0.04}
        ),
        "the same, four stops": Case(
            fault=_apart_mounts(1.05), drive=_ROW | _SEVERAL | {"sigma_stop_m": 0.04}
        ),
        "mounts twice as far apart": Case(fault=_apart_mounts(2.0), drive=_ROW),
        "images mirrored": Case(fault=_mirrored, drive=_ROW),
    },
    "telemetry": {
        **{f"pan of a frame off by {d:g} degrees": Case(fault=_frame(pan=d)) for d in (0.5, 1.0, 3.0, 10.0)},
        **{
            f"tilt of a frame off by {d:g} degrees": Case(fault=_frame(tilt=d)) for d in (0.5, 1.0, 3.0, 10.0)
        },
        **{
            f"pan off by {d:g} degrees, few links": Case(fault=_frame(pan=d), drive=_FEW_LINKS)
            for d in (0.5, 3.0)
        },
        **{
            f"tilt off by {d:g} degrees, few links": Case(fault=_frame(tilt=d), drive=_FEW_LINKS)
            for d in (0.5, 3.0)
        },
        "pans of a stop off by 1 degree, told 0.077": Case(
            fault=_stop_pans(1.0, 0.077), drive={"sigma_stop_rad": 1e-3}
        ),
        "the same, headings known to 0.6 degrees only": Case(fault=_stop_pans(1.0, 0.077)),
        **{f"a leg off by 5 sigma, {n} stops": Case(fault=_leg(5.0), drive={"stops": n}) for n in (2, 4, 6)},
        **{
            f"each of 5 legs off by {k:g} sigma, the same way": Case(fault=_adding_up(k), drive={"stops": 6})
            for k in (0.5, 1.0)
        },
        "legs' errors add up, 6 stops": Case(drive={"stops": 6, "odometry": True}),
        "an image shifted by 2 px": Case(fault=_shifted_image(2.0, both_eyes=False)),
        "an image shifted by 20 px": Case(fault=_shifted_image(20.0, both_eyes=False)),
        "a frame shifted by 20 px": Case(fault=_shifted_image(20.0, both_eyes=True)),
        "a tenth of the tracks on a rock 0.1 m away": Case(fault=_neighbouring_rock(0.1, 0.1)),
        "pans of the other sense": Case(fault=_pans(np.negative), drive=_ROW),
        "each frame with its neighbour's pan": Case(fault=_pans(lambda pan: np.roll(pan, 1)), drive=_ROW),
        "the same, one stop": Case(fault=_pans(lambda pan: np.roll(pan, 1)), drive=_ROW | {"stops": 1}),
    },
    "far terrain": {
        **{
            f"all at {d:g} m, stops 2 m apart": Case(fault=_far(d), drive=_FAR_APART)
            for d in (300.0, 1000.0, 3000.0, 10000.0)
        },
        "3,000 points at 1000 m": Case(fault=_far(1000.0, 3000), drive=_FAR_APART),
        "all at 1000 m, odometry of 1 m": Case(fault=_far(1000.0), drive=_FAR_APART | {"sigma_stop_m": 1.0}),
    },
    "stated noise": {
        **{f"sigmas stated {1 / f:.3g} times too small": Case(fault=_stated_noise(f)) for f in (0.1, 0.3)},
        **{f"sigmas stated {f:g} times too large": Case(fault=_stated_noise(f)) for f in (3.0, 10.0)},
        "all sigmas stated as 1e-6 px": Case(fault=_tiny_sigmas(1.0)),
        "half of the sigmas stated as 1e-6 px": Case(fault=_tiny_sigmas(0.5)),
        "half of the observations a million times better": Case(fault=_apart),
        "error ellipses of 1e4 to 1": Case(drive={"noise_stretch": 1e4}),
    },
    "ways in": {
        "a start with pans in 0 to 2 pi": Case(other_turns=True),
        **{
            f"model {model} at tilt -90 degrees": Case(drive=_DOWN, options=SolveOptions(model=model))
            for model in ("circle", "free")
        },
        "stops shuffled, stop by stop": Case(fault=_shuffled, drive=_SEVERAL, incremental=True),
        "a stop without observations": Case(fault=_unseen_stop, drive={"stops": 3}),
        "a stop without observations, stop by stop": Case(
            fault=_unseen_stop, drive={"stops": 3}, incremental=True
        ),
        "a stop without frames": Case(fault=_no_frames),
        "a stop without frames, stop by stop": Case(fault=_no_frames, incremental=True),
        "all stops at sigma 1.5 m": Case(fault=_none_held(1.5)),
        "all stops at sigma 1.5 m, stop by stop": Case(fault=_none_held(1.5), incremental=True),
        "all stops at sigma 1000 m": Case(fault=_none_held(1000.0)),
        "mounts free, first stop of one eye": Case(fault=_one_eye_first, drive={"stops": 3}, options=_MOUNTS),
        "mounts free, first stop of one eye, stop by stop": Case(
            fault=_one_eye_first, drive={"stops": 3}, options=_MOUNTS, incremental=True
        ),
    },
}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one run."""

    passed: bool
    errors: FloatArray
    """(n,) of pans, tilts and components of stops' poses, in formal sigmas; empty if nothing was solved."""
    let_go: bool
    """Whether telemetry was let go."""
    failed: tuple[str, ...]
    """Names of the tests that failed; the error itself where nothing was solved."""


def measure(case: Case, rig: str, seed: int, *, incremental: bool, small: bool = False) -> Outcome:
    """Simulate, spoil, solve, compare with the truth; `small`: drives, as far as a case does not say."""
    usual = {"stops": 2} | (_SMALL if small else {})
    options = SimulationOptions(**(usual | dict(case.drive)))  # type: ignore[arg-type]  # by name
    simulation = simulate(rig_template(rig), options, seed=seed)
    traverse = case.fault(simulation, np.random.default_rng(seed))
    try:
        if incremental or case.incremental:
            solution = solve_incrementally(traverse, case.options)
        else:
            solution = solve(traverse, case.options, start=_turned(traverse) if case.other_turns else None)
    except PancamGraphError as error:
        return Outcome(passed=False, errors=np.zeros(0), let_go=False, failed=(str(error)[:40],))
    verdict = solution.verdict
    assert verdict is not None  # every solve is tested
    return Outcome(
        passed=solution.passed,
        errors=errors_in_sigmas(solution, simulation),
        let_go=any(test.name == "let go" and test.value for test in verdict.tests),
        failed=tuple(test.name for test in verdict.failures),
    )


def _turned(traverse: Traverse) -> Start:
    """Telemetry as first values, with pans in 0 to 2 pi."""
    pan, tilt = traverse.pan_tilt_rad.T
    masts = tuple(stop.world_T_mast for stop in traverse.stops)
    return Start(world_T_mast=masts, pan_tilt_rad=np.column_stack([np.mod(pan, 2 * np.pi), tilt]))


def errors_in_sigmas(solution: Solution, simulation: Simulation) -> FloatArray:
    """Absolute errors (n,) of all pans, tilts and components of stops' poses over their formal sigmas."""
    truth, final = simulation.truth, solution.final
    angles = (final.pan_tilt_rad - truth.pan_tilt_rad).ravel()
    at = {stop.id: pose for stop, pose in zip(simulation.traverse.stops, truth.world_T_mast, strict=True)}
    known = [i for i, stop in enumerate(solution.traverse.stops) if stop.id in at]
    stops = [at[solution.traverse.stops[i].id].localCoordinates(final.world_T_mast[i]) for i in known]
    error = np.concatenate([(angles + np.pi) % (2 * np.pi) - np.pi, *stops])
    variance = [np.diag(solution.stop_covariance[i]) for i in known]
    sigma = np.concatenate([solution.angle_sigma_rad.ravel(), *np.sqrt(variance)])
    return np.asarray(np.abs(error[sigma > 0]) / sigma[sigma > 0])


def main() -> int:
    """Run all cases, print a line for each."""
    parser = ScriptParser(__doc__ or "")
    add = parser.add_argument
    add("--seeds", type=int, default=20, help="runs of each case and rig (%(default)s)")
    add("--first-seed", type=int, default=1000, help="(%(default)s)")
    add("--rigs", nargs="+", default=["mer-navcam", "exomars-pancam"], metavar="RIG")
    add("--groups", nargs="+", choices=tuple(GROUPS), default=list(GROUPS), metavar="GROUP")
    add("--only", nargs="+", metavar="TEXT", help="cases whose names contain one of these")
    add("--incremental", action="store_true", help="stop by stop")
    add("--small", action="store_true", help="drives of four pans a stop with 15 points an image")
    a = parser.parse_args()
    if a.seeds < 1:
        raise InputError(f"--seeds: expected 1 or more, found {a.seeds}")
    silent = 0
    progress = Progress()
    cases = {name: case for group in a.groups for name, case in GROUPS[group].items()}
    chosen = {n: c for n, c in cases.items() if not a.only or any(text in n for text in a.only)}
    print("| input | passed | let go | squared error over variance | largest (sigmas) | silent | failed |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | --- |")
    for name, case in chosen.items():
        with progress.shown(name):
            outcomes = [
                measure(case, rig, a.first_seed + i, incremental=a.incremental, small=a.small)
                for i in range(a.seeds)
                for rig in a.rigs
            ]
        passed = [o.errors for o in outcomes if o.passed]
        n_silent = sum(not np.max(errors) <= _SILENT for errors in passed)
        silent += n_silent
        often = Counter(test for o in outcomes for test in o.failed).most_common(4)
        said = ", ".join(f"`{test}` {n}" for test, n in often)
        every = np.concatenate([np.zeros(0), *passed])
        square, worst = (f"{np.mean(every**2):.2f}", f"{every.max():.1f}") if passed else ("-", "-")
        let_go = sum(o.let_go for o in outcomes)
        of = f"{len(passed)} of {len(outcomes)}"
        print(f"| {name} | {of} | {let_go} | {square} | {worst} | {n_silent} | {said} |", flush=True)
    return 1 if silent else 0


if __name__ == "__main__":
    run(main)
