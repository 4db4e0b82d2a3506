"""How well pictures of a whole turn tell their pointing, where nothing or little of it is told.

    python scripts/unknown_pointing.py --rig mer-navcam --seeds 0 1 2
    python scripts/unknown_pointing.py --rig stereo-pan-tilt --told-deg 10

Renders a panorama of 20 frames in two tiers at one stop. The rig that is told has focal lengths off by 5 %
(sigma) and arms by 3 cm, and says so; pans and tilts are not told, or to --told-deg. Pointing is found in the
pictures, then tie points, then all is solved. A line for each seed: root mean squares of pan and tilt, once
found and once solved, the whole panorama turned onto the truth; the error of the focal lengths; the verdict.
The same options give the same numbers.

Exit status: 0 all seeds within 0.1 mrad and 0.05 %, and passed; 1 not; 2 bad input.
"""

from dataclasses import dataclass, replace
from tempfile import TemporaryDirectory

import gtsam
import numpy as np

from pancam_graph import RenderOptions, find_observations, read_traverse, render, solve, write_rendering
from pancam_graph.base.errors import PancamGraphError
from pancam_graph.base.geometry import FloatArray, pan_tilt_rotation, so3_log
from pancam_graph.cli import ScriptParser, run
from pancam_graph.data import UNKNOWN_RAD, Traverse
from pancam_graph.images import find_pointing
from pancam_graph.rigs import Rig, rig_template

PANS = 10
TILTS_RAD = (-0.35, 0.0)
FOCAL_SIGMA, ARM_SIGMA_M = 0.05, 0.03
MOST_RAD, MOST_FOCAL = 1e-4, 5e-4


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Errors of a panorama."""

    found_rad: FloatArray
    """(2,) root mean squares of pan and tilt as the pictures tell them first."""
    solved_rad: FloatArray
    """(2,) the same of the solution."""
    focal: float
    """Largest error of a focal length, as a share."""
    passed: bool
    """Whether the solution passed its tests."""
    lost: int
    """Frames that nothing joined to the others."""

    @property
    def within(self) -> bool:
        """Whether all is as well as it must be."""
        return (
            self.passed
            and not self.lost
            and bool(self.solved_rad.max() < MOST_RAD)
            and self.focal < MOST_FOCAL
        )

    def __str__(self) -> str:
        """In words."""
        found, solved = 1e3 * self.found_rad, 1e3 * self.solved_rad
        lost = f", {self.lost} frames lost" if self.lost else ""
        return (
            f"found: pan {found[0]:.2f}, tilt {found[1]:.2f} mrad; solved: pan {solved[0]:.4f}, tilt "
            f"{solved[1]:.4f} mrad, focal length {100 * self.focal:.4f} %; "
            f"{'passed' if self.passed else 'FAILED its tests'}{lost}"
        )


def main() -> int:
    """Parse options, measure each seed, print."""
    parser = ScriptParser(__doc__ or "")
    parser.add_argument("--rig", default="mer-navcam", help="template of the cameras (%(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="a world and a rig each (0)")
    parser.add_argument("--eyes", type=int, default=None, help="how many of the rig's eyes (all)")
    parser.add_argument("--told-deg", type=float, default=None, help="sigma of told pans and tilts (none)")
    arguments = parser.parse_args()
    rig = rig_template(arguments.rig)
    rig = replace(rig, eyes=rig.eyes[: arguments.eyes])
    told_rad = None if arguments.told_deg is None else float(np.deg2rad(arguments.told_deg))
    within = True
    for seed in arguments.seeds:
        try:
            outcome = measured(rig, seed, told_rad)
        except PancamGraphError as error:
            print(f"seed {seed}: {error}", flush=True)
            within = False
            continue
        print(f"seed {seed}: {outcome}", flush=True)
        within &= outcome.within
    return 0 if within else 1


def measured(rig: Rig, seed: int, told_rad: float | None) -> Outcome:
    """Render, forget, find, solve, compare."""
    options = RenderOptions(stops=1, pans=PANS, tilts_rad=TILTS_RAD, sweep_rad=2 * np.pi)
    rendering = render(rig, options, seed=seed)
    truth = rendering.truth.pan_tilt_rad
    with TemporaryDirectory() as folder:
        write_rendering(rendering, folder)
        blind = forgotten(read_traverse(folder), truth, told_rad, np.random.default_rng([seed, 2]))
        found = find_pointing(blind).traverse
        solution = solve(find_observations(found))
    names = [frame.id for frame in rendering.traverse.frames]
    true = truth[[names.index(frame.id) for frame in found.frames]]
    focal = [
        abs(camera.pinhole.fx_px / rig.eyes[eye].camera.pinhole.fx_px - 1)
        for camera, eye in zip(solution.image_cameras, found.image_eye, strict=True)
    ]
    return Outcome(
        found_rad=errors_rad(found.pan_tilt_rad, true),
        solved_rad=errors_rad(solution.final.pan_tilt_rad, true),
        focal=max(focal),
        passed=solution.passed,
        lost=len(names) - len(found.frames),
    )


def forgotten(
    traverse: Traverse, truth: FloatArray, told_rad: float | None, rng: np.random.Generator
) -> Traverse:
    """The traverse with another rig, and with pans and tilts that are not told, or badly."""
    rig = traverse.rig
    eyes = []
    common = 1 + FOCAL_SIGMA * rng.normal()
    arm_m = ARM_SIGMA_M * rng.normal(size=3)
    for eye in rig.eyes:
        K = eye.camera.pinhole.calibration_matrix.copy()
        K[:2, :2] *= common
        mount = gtsam.Pose3(eye.head_T_camera.rotation(), eye.head_T_camera.translation() + arm_m)
        eyes.append(replace(eye, camera=eye.camera.with_calibration(K), head_T_camera=mount))
    uncertainty = replace(rig.uncertainty, focal=FOCAL_SIGMA, mount_m=ARM_SIGMA_M, tilt_axis_m=ARM_SIGMA_M)
    sigma = UNKNOWN_RAD if told_rad is None else told_rad
    told = np.zeros_like(truth) if told_rad is None else truth + told_rad * rng.normal(size=truth.shape)
    frames = tuple(
        replace(frame, pan_rad=float(pan), tilt_rad=float(tilt), sigma_pan_rad=sigma, sigma_tilt_rad=sigma)
        for frame, (pan, tilt) in zip(traverse.frames, told, strict=True)
    )
    return replace(traverse, rig=replace(rig, eyes=tuple(eyes), uncertainty=uncertainty), frames=frames)


def errors_rad(pan_tilt_rad: FloatArray, truth: FloatArray) -> FloatArray:
    """Root mean squares (2,) of the errors of pan and tilt, all heads turned together onto the true ones."""
    heads, true = (pan_tilt_rotation(angles[:, 0], angles[:, 1]) for angles in (pan_tilt_rad, truth))
    u, _, vt = np.linalg.svd((true @ heads.transpose(0, 2, 1)).sum(axis=0))
    common = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    level = pan_tilt_rotation(truth[:, 0], 0.0)
    # In the frame that pans and does not tilt: about its z for pan, about its y for tilt.
    off = so3_log(level.transpose(0, 2, 1) @ common @ heads @ true.transpose(0, 2, 1) @ level)
    return np.asarray(np.sqrt(np.mean(off[:, [2, 1]] ** 2, axis=0)))


if __name__ == "__main__":
    run(main)
