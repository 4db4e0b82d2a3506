"""Traverses with known truth: a mast rig driven over rolling ground, with rocks and a far ridge.

Points are found as a camera finds them: along random lines of sight of every image, where these meet
the ground. Then every image near enough is asked whether it sees them, by its own camera model.
"""

from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np

from pancam_graph._terrain import Terrain
from pancam_graph._wrong_rig import wrong_rig
from pancam_graph.cameras import Camera
from pancam_graph.errors import InputError
from pancam_graph.geometry import BoolArray, FloatArray, IntArray, compose, pose_arrays, rz, wrap_angle
from pancam_graph.rigs import Rig
from pancam_graph.traverse import Frame, Image, Observations, Stop, Traverse

__all__ = ["Simulation", "SimulationOptions", "TelemetryStart", "Truth", "simulate"]

_OVERLAP = 0.28  # of neighbouring frames, as a share of the widest eye's field
_HORIZON = 0.2  # how far the upper row looks below the horizon, as a share of the field
_BORDER_PX = 5.0  # nothing is matched nearer to an image's edge than this, or 2 % of a small image
_ROUNDS = 3  # lines of sight that end in the sky are drawn anew so often
_NOMINAL_SIGMA_PX = 0.3  # what observations without noise are said to have


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """What is driven, seen and measured. Raises InputError naming the option that makes no sense."""

    stops: int = 3
    """Number of places where the mast stands."""
    spacing_m: float = 4.0
    """Distance driven from stop to stop."""
    heading_change_rad: float = 0.25
    """Standard deviation of the change of heading from stop to stop."""
    slope_rad: float = 0.05
    """RMS slope of the rolling ground along x and y, and so of the mast's roll and pitch."""
    rocks: float = 0.6
    """Share of square metres of ground with a rock on them."""
    ridge_m: float = 1500.0
    """Mean distance from the drive to the ridge that surrounds it."""
    sweep_rad: float = 2 * np.pi
    """Range of pan that a panorama covers, centred on straight ahead.

    A rig that does not turn (a Ladybug) takes one frame per stop, whatever sweep_rad, pans and tilts_rad say.
    """
    pans: int | None = None
    """Frames per row of a panorama. None: as many as make the widest eye's neighbours overlap by 28 %."""
    tilts_rad: tuple[float, ...] | None = None
    """Tilt of each row. None: two rows that overlap by 28 %, the upper one with the horizon in it."""
    points_per_image: int = 25
    """Terrain points looked for in each image; it also sees those of the images that overlap it."""
    detection: float = 0.6
    """Chance that an image that sees a point yields an observation of it."""
    link_stops: int = 3
    """How many stops before and after the one that found a point look for it again."""
    reach_m: float = np.inf
    """Points farther than this from a camera are not matched in its images; infinite: out to the ridge."""
    max_turn_rad: float = float(np.deg2rad(40.0))
    """A point is not matched in images that see it from farther around than this from where it was found."""
    max_zoom: float = 2.0
    """Nor in those that see it from more than so many times nearer or farther."""
    min_views: int = 2
    """Tracks with fewer observations are dropped."""
    noise_px: float = 0.3
    """Standard deviation of each coordinate of an observation; with 0, they are said to have 0.3."""
    noise_stretch: float = 1.0
    """How many times longer than wide an observation's error ellipse is; its direction is drawn at random.

    Above 1 observations get covariances. Their mean variance is that of `noise_px`."""
    outliers: float = 0.0
    """Share of observations that are a random pixel of their image instead."""
    pointing_scale: float = 1.0
    """Standard deviation of pan and tilt telemetry as a multiple of the rig's; 0: exact, and held."""
    sigma_stop_m: float = 0.1
    """Standard deviation of each component of a stop's position, but the first, which is held."""
    sigma_stop_rad: float = 0.01
    """Standard deviation of each component of a stop's rotation, but the first, which is held."""
    focal_error: float = 0.0
    """Standard deviation of the focal length of each eye in the rig that the traverse claims, as a share."""
    mount_error_rad: float = 0.0
    """Standard deviation of each component of the rotation of its mounts."""
    mount_error_m: float = 0.0
    """Standard deviation of each component of where they sit."""
    radius_error_m: float = 0.0
    """Standard deviation of the radius of its circle, at the mean tilt."""
    prior: Literal["telemetry", "truth"] = "telemetry"
    """Where the traverse's stop poses and angles are: at the disturbed telemetry, or at the truth.

    With "truth" and no noise the adjustment must return the truth, whatever it starts from.
    """

    def __post_init__(self) -> None:
        """Check ranges."""
        for name, low in (
            ("stops", 1),
            ("pans", 1),
            ("points_per_image", 1),
            ("link_stops", 0),
            ("min_views", 2),
        ):
            value = getattr(self, name)
            whole = isinstance(value, int | np.integer) or (name == "pans" and value is None)
            self._require(name, whole and (value is None or value >= low), f"a whole number of {low} or more")
        tilts = self.tilts_rad
        expected = "one or more angles from -pi/2 to pi/2"
        self._require("tilts_rad", tilts is None or len(tilts) > 0, expected)
        self._require("tilts_rad", all(abs(t) <= np.pi / 2 for t in tilts or ()), expected)
        for name in (
            "spacing_m",
            "heading_change_rad",
            "noise_px",
            "pointing_scale",
            "sigma_stop_m",
            "sigma_stop_rad",
            "focal_error",
            "mount_error_rad",
            "mount_error_m",
            "radius_error_m",
        ):
            self._require(name, 0 <= getattr(self, name) < np.inf, "a number of 0 or above")
        self._require("noise_stretch", 1 <= self.noise_stretch <= 1e4, "a number from 1 to 10000")
        self._require("slope_rad", 0 <= self.slope_rad <= 0.3, "a number from 0 to 0.3")
        self._require("rocks", 0 <= self.rocks <= 1, "a share from 0 to 1")
        self._require("ridge_m", 100 <= self.ridge_m <= 1e5, "a distance from 100 m to 100 km")
        self._require("sweep_rad", 0 < self.sweep_rad <= 2 * np.pi, "an angle above 0, up to 2 pi")
        self._require("reach_m", self.reach_m >= 1, "a distance of 1 m or more, or infinity")
        self._require("max_turn_rad", 0 < self.max_turn_rad <= np.pi, "an angle above 0, up to pi")
        self._require("max_zoom", 1 <= self.max_zoom < np.inf, "a number of 1 or above")
        self._require("detection", 0 < self.detection <= 1, "a chance above 0, up to 1")
        self._require("outliers", 0 <= self.outliers < 1, "a share of 0 or above, below 1")
        self._require("prior", self.prior in {"telemetry", "truth"}, "'telemetry' or 'truth'")

    def _require(self, name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise InputError(f"simulation: {name}: expected {expected}, found {getattr(self, name)!r}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What really was, in the order of the traverse's entries. No solver may see it."""

    rig: Rig
    """That made the images."""
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
    terrain: Terrain
    """The ground, on which the landmarks lie."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TelemetryStart:
    """Stop poses and angles as the rover's telemetry has them, with its errors."""

    world_T_mast: tuple[gtsam.Pose3, ...]
    """Mast pose of each stop."""
    pan_tilt_rad: FloatArray
    """(frames, 2) pan and tilt of each frame."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulation:
    """A traverse as a solver gets it, and beside it what it should find."""

    traverse: Traverse
    truth: Truth
    telemetry_start: TelemetryStart
    """Where to start. The traverse's own stops and angles, unless its priors are centred on the truth."""


def simulate(rig: Rig, options: SimulationOptions | None = None, *, seed: int = 0) -> Simulation:
    """Drive `rig` over random terrain and take panoramas. The same arguments give the same numbers.

    `rig` makes the images; the traverse claims one with errors where `options` say so. Terrain, drive, lines
    of sight, detections, noise, outliers, errors of telemetry and of the rig are drawn independently of each
    other: another noise leaves the terrain and the errors of the mast alone.
    Occlusion is not simulated, except for the image that finds a point. Raises InputError for a negative
    seed, and where no point is seen by `options.min_views` images (all rows of the panorama in the sky).
    """
    options = options if options is not None else SimulationOptions()
    if seed < 0:
        raise InputError(f"simulation: seed: expected 0 or more, found {seed}")
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(9)]
    rng_terrain, rng_drive, rng_sight, rng_detection, rng_noise, rng_outlier, *streams = streams
    rng_telemetry, rng_ellipse, rng_rig = streams

    terrain, world_T_mast = _drive(rig, options, rng_terrain, rng_drive)
    angles = _panorama(rig, options)
    pan_tilt = np.tile(angles, (options.stops, 1))
    n_eyes = len(rig.eyes)
    image_frame = np.repeat(np.arange(len(pan_tilt)), n_eyes)
    image_eye = np.tile(np.arange(n_eyes), len(pan_tilt))
    image_stop = image_frame // len(angles)
    stops_R, stops_t = pose_arrays(world_T_mast)
    mast_T_camera = rig.mast_T_camera(pan_tilt[image_frame], image_eye)
    camera_R, camera_t = compose(stops_R[image_stop], stops_t[image_stop], *mast_T_camera)

    points, finder = _find_points(rig, options, terrain, (camera_R, camera_t), image_eye, rng_sight)
    image, point, uv = _look(
        rig, options, points, finder, (camera_R, camera_t), image_eye, image_stop, rng_detection
    )
    views = np.bincount(point, minlength=len(points))
    kept = views >= options.min_views
    if not kept.any():
        raise InputError(
            f"simulation of {rig.name}: expected terrain points seen by {options.min_views} images or more, "
            "found none; do all rows of the panorama look into the sky, or past reach_m?"
        )
    rows = kept[point]
    image, uv = image[rows], uv[rows]
    track = (np.cumsum(kept) - 1)[point[rows]]

    size = np.array([[e.camera.width_px, e.camera.height_px] for e in rig.eyes])[image_eye[image]]
    outlier = rng_outlier.random(len(uv)) < options.outliers
    anywhere = rng_outlier.random(uv.shape) * size - 0.5
    observations = Observations(
        image=image,
        track=track,
        uv_px=uv,
        sigma_px=np.full(len(uv), options.noise_px or _NOMINAL_SIGMA_PX),
    )
    if options.noise_stretch > 1:
        observations = observations.with_covariance(_ellipses(options, observations.sigma_px, rng_ellipse))
    noisy = uv
    if options.noise_px > 0:
        noisy = uv + observations.noise.to_pixels(rng_noise.standard_normal(uv.shape))
    observations = replace(observations, uv_px=np.where(outlier[:, None], anywhere, noisy))

    start = _telemetry(rig, options, world_T_mast, pan_tilt, rng_telemetry)
    truth = Truth(
        rig=rig,
        world_T_mast=world_T_mast,
        pan_tilt_rad=pan_tilt,
        landmarks_m=points[kept],
        uv_px=uv,
        outlier=outlier,
        terrain=terrain,
    )
    centre = truth if options.prior == "truth" else start
    claimed = wrong_rig(
        rig,
        rng_rig,
        focal=options.focal_error,
        mount_rad=options.mount_error_rad,
        mount_m=options.mount_error_m,
        radius_m=options.radius_error_m,
        tilt_rad=float(np.mean(angles[:, 1])),
    )
    traverse = _traverse(claimed, options, centre.world_T_mast, centre.pan_tilt_rad, observations, seed)
    return Simulation(traverse=traverse, truth=truth, telemetry_start=start)


def _ellipses(options: SimulationOptions, sigma_px: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Covariances (n, 2, 2) of one shape and mean variance, each turned at random."""
    long = options.noise_stretch**2
    variances = 2 * np.array([long, 1.0]) / (long + 1.0)
    angle = np.pi * rng.random(len(sigma_px))
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)
    covariance = np.einsum("n,nij,j,nkj->nik", sigma_px**2, turn, variances, turn)
    return np.asarray((covariance + covariance.transpose(0, 2, 1)) / 2)


def _drive(
    rig: Rig, options: SimulationOptions, rng_terrain: np.random.Generator, rng: np.random.Generator
) -> tuple[Terrain, tuple[gtsam.Pose3, ...]]:
    """The ground, and the mast standing on it at every stop, upright on the local slope."""
    heading = np.cumsum(
        np.concatenate([[0.0], options.heading_change_rad * rng.standard_normal(options.stops - 1)])
    )
    step = options.spacing_m * np.column_stack([np.cos(heading), np.sin(heading)])
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)[:-1]])
    middle = xy.mean(axis=0)
    terrain = Terrain.random(
        rng_terrain,
        slope_rad=options.slope_rad,
        rocks=options.rocks,
        ridge_centre_m=middle,
        ridge_distance_m=options.ridge_m + float(np.linalg.norm(xy - middle, axis=1).max()),
    )
    slope, ground = terrain.ground_slope(xy), terrain.ground_m(xy)
    poses = []
    for i in range(options.stops):
        up = np.array([-slope[i, 0], -slope[i, 1], 1.0]) / np.sqrt(1 + slope[i] @ slope[i])
        ahead = rz(heading[i])[:, 0]
        left = np.cross(up, ahead)
        left /= np.linalg.norm(left)
        rotation = np.column_stack([np.cross(left, up), left, up])
        foot = np.array([*xy[i], ground[i]])
        poses.append(gtsam.Pose3(gtsam.Rot3(rotation), foot + rig.mast_height_m * up))
    return terrain, tuple(poses)


def _fields_rad(camera: Camera) -> tuple[float, float]:
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


def _panorama(rig: Rig, options: SimulationOptions) -> FloatArray:
    """Pan and tilt (frames, 2) of one stop, row by row; of a rig that does not turn, one frame at 0."""
    if not rig.turns:
        return np.zeros((1, 2))
    across, down = (max(fields) for fields in zip(*(_fields_rad(e.camera) for e in rig.eyes), strict=True))
    pans = options.pans or int(np.ceil(options.sweep_rad / ((1 - _OVERLAP) * across) - 1e-9))
    tilts = options.tilts_rad or (-_HORIZON * down, -(_HORIZON + 1 - _OVERLAP) * down)
    pan = wrap_angle(((np.arange(pans) + 0.5) / pans - 0.5) * options.sweep_rad)
    return np.column_stack([np.tile(pan, len(tilts)), np.repeat(tilts, pans)])


def _find_points(
    rig: Rig,
    options: SimulationOptions,
    terrain: Terrain,
    world_T_camera: tuple[FloatArray, FloatArray],
    image_eye: IntArray,
    rng: np.random.Generator,
) -> tuple[FloatArray, IntArray]:
    """Terrain points (n, 3) along random lines of sight of each image, and its row (n,), ascending."""
    rotation, centre = world_T_camera
    n_images = len(image_eye)
    missing = np.full(n_images, options.points_per_image)
    found_points, found_image = [], []
    for _ in range(_ROUNDS):
        at = rng.random((n_images, options.points_per_image, 2))
        wanted = np.arange(options.points_per_image) < missing[:, None]
        origin, direction = np.zeros((2, n_images, options.points_per_image, 3))
        usable = np.zeros(wanted.shape, dtype=bool)
        for i, eye in enumerate(rig.eyes):
            of_eye = np.flatnonzero(image_eye == i)
            size = np.array([eye.camera.width_px, eye.camera.height_px])
            rays = eye.camera.unproject((at[of_eye] * size - 0.5).reshape(-1, 2))
            shape = (len(of_eye), -1, 3)
            direction[of_eye] = np.einsum("iab,inb->ina", rotation[of_eye], rays.direction.reshape(shape))
            offset = np.einsum("iab,inb->ina", rotation[of_eye], rays.origin_m.reshape(shape))
            origin[of_eye] = centre[of_eye, None] + offset
            usable[of_eye] = rays.valid.reshape(len(of_eye), -1)
        rows = wanted & usable
        points, hit = terrain.cast(origin[rows], direction[rows], farthest_m=options.reach_m)
        image = np.nonzero(rows)[0][hit]
        found_points.append(points[hit])
        found_image.append(image)
        missing -= np.bincount(image, minlength=n_images)
    all_image = np.concatenate(found_image)
    order = np.argsort(all_image, kind="stable")
    return np.concatenate(found_points)[order], all_image[order]


def _look(
    rig: Rig,
    options: SimulationOptions,
    points_m: FloatArray,
    finder: IntArray,
    world_T_camera: tuple[FloatArray, FloatArray],
    image_eye: IntArray,
    image_stop: IntArray,
    rng: np.random.Generator,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Which images detect which points: image row (n,), point row (n,), pixel without noise (n, 2)."""
    rotation, centre = world_T_camera
    line = points_m - centre[finder]
    found_at_m = np.linalg.norm(line, axis=1)
    line /= found_at_m[:, None]
    first = np.searchsorted(image_stop[finder], np.arange(options.stops + 1))
    cones = [_cone(e.camera) for e in rig.eyes]
    image, point, pixel = [], [], []
    for stop in range(options.stops):
        low, high = max(0, stop - options.link_stops), min(options.stops, stop + options.link_stops + 1)
        linked = np.arange(first[low], first[high])
        images = np.flatnonzero(image_stop == stop)
        near = linked[_within(options, points_m[linked], found_at_m[linked], centre[images])]
        points, lines, found_at = points_m[near], line[near], found_at_m[near]
        for i in images:
            camera = rig.eyes[image_eye[i]].camera
            d = points - centre[i]
            axis, cosine = cones[image_eye[i]]
            rows = np.flatnonzero(d @ (rotation[i] @ axis) >= cosine * np.linalg.norm(d, axis=1))
            d, distance_m = d[rows], np.linalg.norm(d[rows], axis=1)
            ok = np.einsum("ni,ni->n", d, lines[rows]) >= np.cos(options.max_turn_rad) * distance_m
            ok &= distance_m <= np.minimum(options.max_zoom * found_at[rows], options.reach_m)
            ok &= found_at[rows] <= options.max_zoom * distance_m
            rows, d = rows[ok], d[ok]
            uv, valid = camera.project(d @ rotation[i])
            border = min(_BORDER_PX, 0.02 * camera.width_px, 0.02 * camera.height_px)
            inside = camera.contains(uv - border) & camera.contains(uv + border)
            seen = np.flatnonzero(valid & inside)
            seen = seen[rng.random(len(seen)) < options.detection]
            image.append(np.full(len(seen), i))
            point.append(near[rows[seen]])
            pixel.append(uv[seen])
    return np.concatenate(image), np.concatenate(point), np.concatenate(pixel)


def _within(
    options: SimulationOptions, points_m: FloatArray, found_at_m: FloatArray, centres_m: FloatArray
) -> BoolArray:
    """Which points (n,) may be near enough to some camera of a stop, to sift quickly."""
    middle = centres_m.mean(axis=0)
    margin_m = float(np.linalg.norm(centres_m - middle, axis=1).max()) + 1e-6
    distance_m = np.linalg.norm(points_m - middle, axis=1)
    near = distance_m - margin_m <= np.minimum(options.max_zoom * found_at_m, options.reach_m)
    return np.asarray(near & (found_at_m <= options.max_zoom * (distance_m + margin_m)))


def _cone(camera: Camera) -> tuple[FloatArray, float]:
    """Axis in the camera frame and cosine of a cone that surely holds the field of view, to sift quickly."""
    u, v = np.linspace(-0.5, camera.width_px - 0.5, 9), np.linspace(-0.5, camera.height_px - 0.5, 9)
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    axis = rays.direction[len(rays.direction) // 2]
    if not rays.valid.all():
        return axis, -1.0
    widest = float(np.arccos(np.clip(rays.direction @ axis, -1, 1)).max())
    return axis, float(np.cos(min(np.pi, widest + 0.1)))


def _telemetry(
    rig: Rig,
    options: SimulationOptions,
    world_T_mast: tuple[gtsam.Pose3, ...],
    pan_tilt_rad: FloatArray,
    rng: np.random.Generator,
) -> TelemetryStart:
    """Truth with errors: gaussian in the tangent at each mast but the first, and in each angle."""
    sigmas = np.repeat([options.sigma_stop_rad, options.sigma_stop_m], 3)
    errors = sigmas * rng.standard_normal((len(world_T_mast), 6))
    errors[0] = 0.0
    pointing = _pointing_sigma_rad(rig, options)
    return TelemetryStart(
        world_T_mast=tuple(
            pose * gtsam.Pose3.Expmap(error) for pose, error in zip(world_T_mast, errors, strict=True)
        ),
        pan_tilt_rad=pan_tilt_rad + pointing * rng.standard_normal(pan_tilt_rad.shape),
    )


def _pointing_sigma_rad(rig: Rig, options: SimulationOptions) -> FloatArray:
    """Standard deviation of pan and tilt telemetry (2,); 0 where the rig does not turn."""
    sigma = np.array([rig.pointing_sigma.pan_rad, rig.pointing_sigma.tilt_rad])
    return options.pointing_scale * rig.turns * sigma


def _traverse(
    rig: Rig,
    options: SimulationOptions,
    world_T_mast: tuple[gtsam.Pose3, ...],
    pan_tilt_rad: FloatArray,
    observations: Observations,
    seed: int,
) -> Traverse:
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
        Image(id=f"{frame.id}-{eye.name}", frame=frame.id, camera=eye.name)
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
