"""A mast driven from stop to stop: where it stands and points in truth, and what telemetry says."""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, rz, wrap_angle
from pancam_graph.cameras import Camera
from pancam_graph.data import Frame, Image, Observations, Stop, Traverse
from pancam_graph.rigs import Rig
from pancam_graph.simulate._simulation_options import DriveOptions
from pancam_graph.simulate._wrong_rig import drawn_encoders, drawn_flex, drawn_rig, wrong_rig

__all__ = [
    "TelemetryStart",
    "Truth",
    "claimed_rig",
    "fields_rad",
    "flexed",
    "make_traverse",
    "panorama",
    "path",
    "stand",
    "telemetry",
]


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What really was, in the order of the traverse's entries. No solver may see it."""

    rig: Rig
    """The rig that the observations were made with; the traverse may claim another."""
    world_T_mast: tuple[gtsam.Pose3, ...]
    """Mast pose of each stop."""
    pan_tilt_rad: FloatArray
    """(frames, 2) pan and tilt of each frame."""
    landmarks_m: FloatArray
    """(tracks, 3) terrain points; the row is the track number."""
    uv_px: FloatArray
    """(observations, 2) pixels without noise, of outliers too."""
    outlier: BoolArray
    """(observations,) which are a random pixel."""
    flex: FloatArray | None = None
    """(frames, 4) how heads stood off the mast (`Rig.mast_T_camera`); pan and tilt are theirs. None: not at
    all."""
    field_px: FloatArray | None = None
    """(eyes, *cameras.FIELD_SHAPE) coefficients of each eye's smooth distortion field; None: none has one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TelemetryStart:
    """Stop poses and angles as the rover's telemetry has them, with its errors."""

    world_T_mast: tuple[gtsam.Pose3, ...]
    """Mast pose of each stop."""
    pan_tilt_rad: FloatArray
    """(frames, 2) pan and tilt of each frame."""


def path(options: DriveOptions, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Where the mast is driven: x and y (stops, 2) and heading (stops,)."""
    heading = np.cumsum(
        np.concatenate([[0.0], options.heading_change_rad * rng.standard_normal(options.stops - 1)])
    )
    if options.loop:
        # As many turns as there are stretches, the last one back to the start among them.
        heading += 2 * np.pi * np.arange(options.stops) / options.stops - heading[-1] * np.linspace(
            0, 1, options.stops
        )
    step = options.spacing_m * np.column_stack([np.cos(heading), np.sin(heading)])
    if options.loop:
        step -= step.mean(axis=0)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)[:-1]]), heading


def stand(
    rig: Rig, xy_m: FloatArray, heading_rad: FloatArray, ground_m: FloatArray, slope: FloatArray
) -> tuple[gtsam.Pose3, ...]:
    """The mast at every stop, upright on the slope (stops, 2) of the ground of that height (stops,)."""
    poses = []
    for i in range(len(xy_m)):
        up = np.array([-slope[i, 0], -slope[i, 1], 1.0]) / np.sqrt(1 + slope[i] @ slope[i])
        ahead = rz(heading_rad[i])[:, 0]
        left = np.cross(up, ahead)
        left /= np.linalg.norm(left)
        rotation = np.column_stack([np.cross(left, up), left, up])
        foot = np.array([*xy_m[i], ground_m[i]])
        poses.append(gtsam.Pose3(gtsam.Rot3(rotation), foot + rig.mast_height_m * up))
    return tuple(poses)


def fields_rad(camera: Camera) -> tuple[float, float]:
    """Field of view across and down through the middle of the image, as far as the model is valid."""
    x, y = (camera.width_px - 1) / 2, (camera.height_px - 1) / 2
    out = np.linspace(0, 1, 33)[:, None]
    ahead = camera.unproject(np.array([[x, y]])).direction[0]
    angles = []
    for side in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        edge = np.array(side) * [camera.width_px / 2, camera.height_px / 2]
        rays = camera.unproject(np.array([x, y]) + out * edge)
        angles.append(float(np.arccos(np.clip(rays.direction[rays.valid] @ ahead, -1, 1)).max()))
    return angles[0] + angles[1], angles[2] + angles[3]


def panorama(
    rig: Rig,
    options: DriveOptions,
    *,
    overlap: float,
    rows: Callable[[float], tuple[float, ...]],
) -> FloatArray:
    """Pan and tilt (frames, 2) of one stop, row by row; of a rig that does not turn, one frame at 0.

    `overlap` is that of neighbouring frames, as a share of the widest eye's field, where the options do not
    say how many frames, or how far; `rows` gives the tilts for a field of view down, where they are not said.
    """
    if not rig.turns:
        return np.zeros((1, 2))
    across, down = (max(fields) for fields in zip(*(fields_rad(e.camera) for e in rig.eyes), strict=True))
    apart = (1 - overlap) * across
    sweep, pans = options.sweep_rad, options.pans
    if sweep is None:
        sweep = 2 * np.pi if pans is None else min(2 * np.pi, pans * apart)
    pans = pans or int(np.ceil(sweep / apart - 1e-9))
    tilts = options.tilts_rad or rows(down)
    pan = wrap_angle(((np.arange(pans) + 0.5) / pans - 0.5) * sweep)
    return np.column_stack([np.tile(pan, len(tilts)), np.repeat(tilts, pans)])


def claimed_rig(rig: Rig, options: DriveOptions, angles_rad: FloatArray, rng: np.random.Generator) -> Rig:
    """The rig that the traverse claims: with errors where the options say so."""
    wrong = wrong_rig(
        rig,
        rng,
        focal=options.focal_error,
        mount_rad=options.mount_error_rad,
        mount_m=options.mount_error_m,
        radius_m=options.radius_error_m,
        tilt_rad=float(np.mean(angles_rad[:, 1])),
    )
    return drawn_rig(wrong, rng) if options.rig_error == "drawn" else wrong


def flexed(
    rig: Rig, options: DriveOptions, pan_tilt_rad: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray | None]:
    """Pan and tilt (frames, 2) of heads that flex from where the joints stand, and what else they flex.

    Where rigs are drawn with errors; else the joints' own angles, and None.
    """
    if options.rig_error != "drawn" or not rig.turns:
        return pan_tilt_rad, None
    flex = drawn_flex(rig, len(pan_tilt_rad), rng)
    return pan_tilt_rad + flex[:, :2], flex[:, 2:]


def telemetry(
    rig: Rig,
    options: DriveOptions,
    world_T_mast: tuple[gtsam.Pose3, ...],
    pan_tilt_rad: FloatArray,
    rng: np.random.Generator,
) -> TelemetryStart:
    """Truth with errors: gaussian in the tangent at each mast but the first, and in each angle.

    Where rigs are drawn with errors, so is the scale of what encoders read.
    """
    sigmas = np.repeat([options.sigma_stop_rad, options.sigma_stop_m], 3)
    errors = sigmas * rng.standard_normal((len(world_T_mast), 6))
    errors[0] = 0.0
    pointing = _pointing_sigma_rad(rig, options)
    said = [pose * gtsam.Pose3.Expmap(error) for pose, error in zip(world_T_mast, errors, strict=True)]
    if options.odometry:
        for i in range(1, len(said)):
            rounded = (said[i - 1] * world_T_mast[i - 1].between(said[i])).matrix()
            said[i] = gtsam.Pose3(gtsam.Rot3.ClosestTo(rounded[:3, :3]), rounded[:3, 3])
    read = pan_tilt_rad + pointing * rng.standard_normal(pan_tilt_rad.shape)
    if options.rig_error == "drawn":
        read = read / (1 + drawn_encoders(rig, rng))
    return TelemetryStart(world_T_mast=tuple(said), pan_tilt_rad=read)


def _pointing_sigma_rad(rig: Rig, options: DriveOptions) -> FloatArray:
    """Standard deviation of pan and tilt telemetry (2,); 0 where the rig does not turn."""
    sigma = np.array([rig.pointing_sigma.pan_rad, rig.pointing_sigma.tilt_rad])
    return options.pointing_scale * rig.turns * sigma


def make_traverse(
    rig: Rig,
    options: DriveOptions,
    world_T_mast: tuple[gtsam.Pose3, ...],
    pan_tilt_rad: FloatArray,
    observations: Observations | None,
    seed: int,
    *,
    file: str | None = None,
) -> Traverse:
    """What a solver gets; `file` is the name of image files, with {image} for its id; None: no files."""
    stops = tuple(
        Stop(
            id=f"stop{i:04d}",
            world_T_mast=pose,
            sigma_rotation_rad=options.sigma_stop_rad if i else 0.0,
            sigma_translation_m=options.sigma_stop_m if i else 0.0,
        )
        for i, pose in enumerate(world_T_mast)
    )
    per_stop = len(pan_tilt_rad) // len(stops)
    sigma_pan, sigma_tilt = _pointing_sigma_rad(rig, options).tolist()
    frames = tuple(
        Frame(
            id=f"frame{i:05d}",
            stop=stops[i // per_stop].id,
            pan_rad=float(pan),
            tilt_rad=float(tilt),
            sigma_pan_rad=sigma_pan,
            sigma_tilt_rad=sigma_tilt,
        )
        for i, (pan, tilt) in enumerate(pan_tilt_rad)
    )
    images = tuple(
        Image(
            id=f"{frame.id}-{eye.name}",
            frame=frame.id,
            camera=eye.name,
            file=None if file is None else file.format(image=f"{frame.id}-{eye.name}"),
        )
        for frame in frames
        for eye in rig.eyes
    )
    return Traverse(
        name=f"simulated {rig.name}, seed {seed}",
        rig=rig,
        stops=stops,
        frames=frames,
        images=images,
        observations=observations,
    )
