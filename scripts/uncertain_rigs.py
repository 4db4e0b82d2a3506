"""Solve drives whose rig is not the one that the traverse claims, and compare errors with formal sigmas.

For each rig and error a line: draws, how many failed their tests; the squared error over the variance of
relative pan and tilt (frames next to each other), of later stops' poses, each with its standard error over
drives, and of terrain points (median of all drives' points); the largest error of a relative angle or stop in
sigmas; and the RMS errors themselves. The error "drawn" is as large as the rig's own uncertainty says, in all
its numbers. With --calibrated N the rig of each drive is first calibrated in another drive with the same
errors, of N points an image, and used with its covariance; the drive itself is the one that is solved without
that option. The same options give the same numbers.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pancam_graph import SolveOptions, Traverse, simulate, solve
from pancam_graph.base.errors import InputError, PancamGraphError
from pancam_graph.base.geometry import FloatArray, IntArray, wrap_angle
from pancam_graph.cli import Progress, ScriptParser, run
from pancam_graph.results import calibrated_rig
from pancam_graph.rigs import Rig, RigUncertainty, rig_template
from pancam_graph.simulate import Simulation, SimulationOptions
from pancam_graph.solve import fit, judge, prepare, reconsidered, screen

_MEDIAN_OF_POINT = 2.366
"""Median of the sum of squares of three standard normal numbers."""
KINDS = ("pan", "tilt", "stop", "point")


def _eye(
    index: int, *, turn: Mapping[int, float] | None = None, shift_m: float = 0.0
) -> Callable[[Rig], Rig]:
    """One eye turned about axes of its camera, radians, or shifted along the head's y axis."""

    def change(rig: Rig) -> Rig:
        eyes = list(rig.eyes)
        mount = eyes[index].head_T_camera
        rotation = mount.rotation()
        for axis, angle in (turn or {}).items():
            rotation = rotation * gtsam.Rot3.Expmap(angle * np.eye(3)[axis])
        moved = gtsam.Pose3(rotation, mount.translation() + shift_m * np.eye(3)[1])
        eyes[index] = replace(eyes[index], head_T_camera=moved)
        return replace(rig, eyes=tuple(eyes))

    return change


def _focal(share: float) -> Callable[[Rig], Rig]:
    def change(rig: Rig) -> Rig:
        eyes = []
        for eye in rig.eyes:
            K = eye.camera.pinhole.calibration_matrix
            K[:2, :2] *= 1 + share
            eyes.append(replace(eye, camera=eye.camera.with_calibration(K)))
        return replace(rig, eyes=tuple(eyes))

    return change


def _axis(shift_m: float) -> Callable[[Rig], Rig]:
    def change(rig: Rig) -> Rig:
        pose = rig.pan_T_tilt
        return replace(
            rig, pan_T_tilt=gtsam.Pose3(pose.rotation(), pose.translation() + shift_m * np.eye(3)[0])
        )

    return change


def _same(rig: Rig) -> Rig:
    return rig


ERRORS: dict[str, Callable[[Rig], Rig]] = {
    "none": _same,
    "drawn": _same,
    "focal 0.2 %": _focal(2e-3),
    "yaw 0.5 mrad": _eye(-1, turn={1: 5e-4}),
    "pitch 0.5 mrad": _eye(-1, turn={0: 5e-4}),
    "roll 0.5 mrad": _eye(-1, turn={2: 5e-4}),
    "baseline 1 mm": _eye(-1, shift_m=1e-3),
    "axis 2 mm": _axis(2e-3),
    "flex 0.2 mrad": _same,
}
_FLEX_ALONE = replace(RigUncertainty.exact(), flex_rad=2e-4)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One drive: errors, and errors over sigmas, of each kind."""

    failed: tuple[str, ...]
    errors: Mapping[str, FloatArray]
    sigmas: Mapping[str, FloatArray]
    """Errors in sigmas; of points such that the median of their squares is 1 where covariances are right."""


_ANOTHER = 100_000
"""Distance of the seed of a drive from that of the drive that its rig is calibrated with."""


def measure(
    rig: Rig,
    error: str,
    options: SimulationOptions,
    seed: int,
    solving: SolveOptions,
    calibration: SimulationOptions | None = None,
) -> Outcome:
    """Simulate, claim another rig, solve, compare with the truth; without errors where nothing was solved.

    With `calibration`, the claimed rig is first calibrated in a drive of these options.
    """
    flexes = error == "flex 0.2 mrad"
    drawn = replace(options, rig_error="drawn") if flexes or error == "drawn" else options
    true = replace(rig, uncertainty=_FLEX_ALONE) if flexes else rig
    simulation = simulate(true, drawn, seed=seed)
    claimed = rig if flexes else ERRORS[error](simulation.traverse.rig)
    traverse = replace(simulation.traverse, rig=claimed)
    try:
        if calibration is not None:
            first = replace(calibration, rig_error=drawn.rig_error)
            other = simulate(true, first, seed=seed + _ANOTHER).traverse
            calibrated = solve(replace(other, rig=claimed), solving)
            if not calibrated.passed:
                return Outcome(failed=("calibration",), errors={}, sigmas={})
            traverse = replace(traverse, rig=calibrated_rig(calibrated))
        return _compared(traverse, simulation, solving)
    except PancamGraphError as refused:
        return Outcome(failed=(str(refused)[:40],), errors={}, sigmas={})


def _compared(traverse: Traverse, simulation: Simulation, solving: SolveOptions) -> Outcome:
    judged = reconsidered(judge(fit(screen(prepare(traverse, solving)))))
    truth, state, stated = simulation.truth, judged.state, judged.stated
    assert stated.variables is not None
    pairs = _neighbours(traverse)
    off = np.asarray(wrap_angle(state.pan_tilt_rad - truth.pan_tilt_rad))
    apart = off[pairs[:, 1]] - off[pairs[:, 0]]
    template = judged.fitted.problem.template
    apart_sigma = template.relative_angle_sigma_rad(stated.variables, state, pairs)
    poses = zip(truth.world_T_mast, state.world_T_mast, strict=True)
    stops = np.array([true.localCoordinates(found) for true, found in poses])[1:]
    stop_sigma = np.sqrt(np.diagonal(stated.stop_covariance, axis1=1, axis2=2))[1:]
    points = state.landmarks_m - truth.landmarks_m[judged.fitted.screened.prepared.landmark_track]
    spread = stated.landmark_covariance_m2
    assert spread is not None
    known = np.isfinite(points).all(axis=1) & np.isfinite(spread).all(axis=(1, 2))
    known &= np.linalg.norm(points, axis=1) < 1e3
    square = np.einsum("ni,nij,nj->n", points[known], np.linalg.inv(spread[known]), points[known])
    return Outcome(
        failed=tuple(test.name for test in judged.verdict.failures),
        errors={
            "pan": apart[:, 0],
            "tilt": apart[:, 1],
            "stop": stops[:, 3:].ravel(),
            "point": np.linalg.norm(points[known], axis=1),
        },
        sigmas={
            "pan": apart[:, 0] / apart_sigma[:, 0],
            "tilt": apart[:, 1] / apart_sigma[:, 1],
            "stop": (stops / stop_sigma).ravel(),
            "point": np.sqrt(square / _MEDIAN_OF_POINT),
        },
    )


def _neighbours(traverse: Traverse) -> IntArray:
    """Frames (pairs, 2) that follow each other at a stop."""
    first = np.flatnonzero(np.diff(traverse.frame_stop) == 0)
    return np.column_stack([first, first + 1])


def _square(outcomes: list[Outcome], kind: str) -> float:
    """Squared errors over variances, mean over drives; of points the median over all drives.

    Points of a drive share the errors of its rig. The mean over drives of their medians would be up to 1.27
    where covariances are right: the mean of a chi-square of three is that much larger than its median.
    """
    of_drive = [o.sigmas[kind] ** 2 for o in outcomes if len(o.sigmas[kind])]
    if not of_drive:
        return np.nan
    return float(np.median(np.concatenate(of_drive)) if kind == "point" else np.mean(_means(of_drive)))


def _standard_error(outcomes: list[Outcome], kind: str) -> float:
    """Of `_square` of angles and stops, from how drives differ."""
    means = _means([o.sigmas[kind] ** 2 for o in outcomes if len(o.sigmas[kind])])
    return float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else np.nan


def _means(of_drive: list[FloatArray]) -> FloatArray:
    return np.array([np.mean(one) for one in of_drive])


def _rms(outcomes: list[Outcome], kind: str) -> float:
    of_drive = [o.errors[kind] for o in outcomes if len(o.errors[kind])]
    if not of_drive:
        return np.nan
    if kind == "point":
        return float(np.mean([np.median(e) for e in of_drive]))
    return float(np.sqrt(np.mean(np.concatenate(of_drive) ** 2)))


def main() -> int:
    """Run all rigs and errors, print a line for each."""
    parser = ScriptParser(__doc__ or "")
    add = parser.add_argument
    add("--draws", type=int, default=20, help="drives of each rig and error (%(default)s)")
    add("--first-seed", type=int, default=5000, help="(%(default)s)")
    add("--stops", type=int, default=2, help="stops of each drive (%(default)s)")
    add("--pans", type=int, help="frames per row of a panorama; default: all around")
    add("--points-per-image", type=int, default=25, help="(%(default)s)")
    add("--calibrated", type=int, metavar="N", help="calibrate the rig first, with N points an image")
    add("--one-eye", action="store_true", help="without stereo: the rig's first eye alone")
    add(
        "--rigs",
        nargs="+",
        default=["mer-navcam", "msl-navcam", "mars2020-navcam", "exomars-pancam", "stereo-pan-tilt"],
        metavar="RIG",
    )
    add("--errors", nargs="+", choices=tuple(ERRORS), default=["drawn"], metavar="ERROR")
    add("--treatment", choices=("estimated", "held", "considered"), default="estimated")
    add(
        "--field",
        action="store_true",
        help="images have smooth distortion fields, drawn too, and solves estimate them",
    )
    a = parser.parse_args()
    if a.draws < 1:
        raise InputError(f"--draws: expected 1 or more, found {a.draws}")
    options = SimulationOptions(
        stops=a.stops,
        pans=a.pans,
        points_per_image=a.points_per_image,
        sweep_rad=None if a.pans else 2 * np.pi,
        field_error="drawn" if a.field else "none",
    )
    calibration = None
    if a.calibrated:
        calibration = SimulationOptions(stops=1, points_per_image=a.calibrated, sweep_rad=2 * np.pi)
    solving = SolveOptions(rig=a.treatment, field=a.field, landmark_covariances=True)
    progress = Progress()
    heads = [("draws", 5), ("failed", 6), *((kind, 13) for kind in KINDS[:3]), ("point", 6), ("worst", 6)]
    heads += [("pan urad", 9), ("tilt urad", 9), ("stop mm", 8), ("point mm", 9)]
    print(f"{'rig, error':<32} {' '.join(f'{h:>{n}}' for h, n in heads)}")
    for name in a.rigs:
        rig = rig_template(name)
        rig = replace(rig, eyes=rig.eyes[: 1 if a.one_eye else 2])
        for error in a.errors:
            with progress.shown(f"{name}, {error}"):
                drives = [
                    measure(rig, error, options, a.first_seed + i, solving, calibration)
                    for i in range(a.draws)
                ]
            solved = [o for o in drives if o.errors]
            square = [f"{_square(solved, k):>5.2f} +- {_standard_error(solved, k):<4.2f}" for k in KINDS[:3]]
            square.append(f"{_square(solved, 'point'):>6.2f}")
            worst = [np.abs(o.sigmas[k]).max(initial=0.0) for o in solved for k in ("pan", "tilt", "stop")]
            unit = (1e6, 1e6, 1e3, 1e3)
            rms = [u * _rms(solved, kind) for u, kind in zip(unit, KINDS, strict=True)]
            said = sorted({test for o in drives for test in o.failed})
            n_failed = sum(bool(o.failed) for o in drives)
            print(
                f"{f'{name}, {error}':<32} {len(drives):>5} {n_failed:>6} "
                f"{' '.join(square)} {max(worst, default=np.nan):>6.1f} "
                f"{rms[0]:>9.1f} {rms[1]:>9.1f} {rms[2]:>8.2f} {rms[3]:>9.2f}  {', '.join(said)}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    run(main)
