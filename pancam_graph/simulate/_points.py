"""Traverses with known truth: a mast rig driven over rolling ground, with rocks and a far ridge.

Points are found as a camera finds them: along random lines of sight of every image, where these meet
the ground. Then every image near enough is asked whether it sees them, by its own camera model.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, compose, pose_arrays
from pancam_graph.base.options import options_of
from pancam_graph.cameras import Camera, Fields
from pancam_graph.data import Observations, Traverse
from pancam_graph.rigs import Rig
from pancam_graph.simulate._drive import (
    TelemetryStart,
    Truth,
    claimed_rig,
    flexed,
    make_traverse,
    panorama,
    path,
    stand,
    telemetry,
)
from pancam_graph.simulate._simulation_options import SimulationOptions
from pancam_graph.simulate._terrain import GroundModel
from pancam_graph.simulate._wrong_rig import drawn_fields

__all__ = ["PointsTruth", "Simulation", "simulate"]

_OVERLAP = 0.28  # of neighbouring frames, as a share of the widest eye's field
_HORIZON = 0.2  # how far the upper row looks below the horizon, as a share of the field
_BORDER_PX = 5.0  # nothing is matched nearer to an image's edge than this, or 2 % of a small image
_ROUNDS_OF_FIELD = 4  # each leaves a thousandth of what the one before left
_ROUNDS = 3  # lines of sight that end in the sky are drawn anew so often
_NOMINAL_SIGMA_PX = 0.3  # what observations without noise are said to have


@dataclass(frozen=True, kw_only=True, eq=False)
class PointsTruth(Truth):
    """What really was, and where its landmarks lie."""

    terrain: GroundModel
    """The ground, on which the landmarks lie."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulation:
    """A traverse as a solver gets it, and beside it what it should find."""

    traverse: Traverse
    truth: PointsTruth
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
    options = options_of(SimulationOptions, options, "simulate")
    if seed < 0:
        raise InputError(f"simulation: seed: expected 0 or more, found {seed}")
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(11)]
    rng_terrain, rng_drive, rng_sight, rng_detection, rng_noise, rng_outlier, *streams = streams
    rng_telemetry, rng_ellipse, rng_rig, rng_flex, rng_field = streams

    terrain, world_T_mast = _drive(rig, options, rng_terrain, rng_drive)
    angles = panorama(
        rig,
        options,
        overlap=_OVERLAP,
        rows=lambda down: (-_HORIZON * down, -(_HORIZON + 1 - _OVERLAP) * down),
    )
    joints = np.tile(angles, (options.stops, 1))
    pan_tilt, flex = flexed(rig, options, joints, rng_flex)
    n_eyes = len(rig.eyes)
    image_frame = np.repeat(np.arange(len(pan_tilt)), n_eyes)
    image_eye = np.tile(np.arange(n_eyes), len(pan_tilt))
    image_stop = image_frame // len(angles)
    stops_R, stops_t = pose_arrays(world_T_mast)
    of_image = None if flex is None else flex[image_frame]
    mast_T_camera = rig.mast_T_camera(pan_tilt[image_frame], image_eye, of_image)
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
    field_px = drawn_fields(rig, rng_field) if options.field_error == "drawn" else None
    if field_px is not None:
        fields = Fields(coefficients_px=field_px, row=image_eye[image], size_px=size.astype(float))
        uv = _displaced(fields, uv)
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

    start = telemetry(rig, options, world_T_mast, joints, rng_telemetry)
    truth = PointsTruth(
        rig=rig,
        world_T_mast=world_T_mast,
        pan_tilt_rad=pan_tilt,
        landmarks_m=points[kept],
        uv_px=uv,
        outlier=outlier,
        flex=flex,
        field_px=field_px,
        terrain=terrain,
    )
    centre = truth if options.prior == "truth" else start
    claimed = claimed_rig(rig, options, angles, rng_rig)
    traverse = make_traverse(claimed, options, centre.world_T_mast, centre.pan_tilt_rad, observations, seed)
    return Simulation(traverse=traverse, truth=truth, telemetry_start=start)


def _displaced(fields: Fields, uv_px: FloatArray) -> FloatArray:
    """Where pixels (n, 2) of the images of n fields appear with these: u = uv + field(u)."""
    out, image = uv_px, np.arange(len(uv_px))
    for _ in range(_ROUNDS_OF_FIELD):
        out = uv_px + fields.at(image, out)
    return out


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
) -> tuple[GroundModel, tuple[gtsam.Pose3, ...]]:
    """The ground, and the mast standing on it at every stop, upright on the local slope."""
    xy, heading = path(options, rng)
    middle = xy.mean(axis=0)
    terrain = GroundModel.random(
        rng_terrain,
        slope_rad=options.slope_rad,
        rocks=options.rocks,
        ridge_centre_m=middle,
        ridge_distance_m=options.ridge_m + float(np.linalg.norm(xy - middle, axis=1).max()),
    )
    slope, ground = terrain.ground_slope(xy), terrain.ground_m(xy)
    return terrain, stand(rig, xy, heading, ground, slope)


def _find_points(
    rig: Rig,
    options: SimulationOptions,
    terrain: GroundModel,
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
        if options.loop:
            around = np.arange(stop - options.link_stops, stop + options.link_stops + 1) % options.stops
            parts = [np.arange(first[s], first[s + 1]) for s in np.unique(around)]
            linked = np.concatenate(parts)
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
