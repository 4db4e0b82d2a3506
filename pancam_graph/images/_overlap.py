"""Which images overlap, and on which of their parts, within the uncertainty of telemetry."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras import Camera
from pancam_graph.data import Traverse
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._pairs import MAX_TURN_RAD, MAX_ZOOM, PairGeometry, inspected_depths_m

__all__ = ["near_stops", "overlap_cells", "overlapping_pairs"]

_GRID = 5
_CELLS = 32
_OFF_SIGMAS = 2.0


def overlapping_pairs(
    traverse: Traverse,
    options: FrontEndOptions,
    progress: Callable[[int, int], None] | None = None,
    *,
    stops: BoolArray,
) -> list[PairGeometry]:
    """Pairs of images (a before b) that may see the same terrain, within the uncertainty of telemetry.

    `stops` (stops, stops), symmetric, says which pairs of stops are asked for.
    """
    wanted = stops[np.ix_(traverse.image_stop, traverse.image_stop)]
    candidates = np.argwhere(np.triu(_cones_meet(traverse, options) & wanted, 1))
    pairs = []
    for k, (a, b) in enumerate(candidates.tolist()):
        pair = PairGeometry(traverse, a, b, options.mount_sigma_rad)
        # Both ways: the whole field of a narrow eye can lie between the corners of a wide eye's pieces.
        if any(_share(p, options) > 0 for p in (pair, replace(pair, a=b, b=a))):
            pairs.append(pair)
        if progress is not None:
            progress(k + 1, len(candidates))
    return pairs


def _share(pair: PairGeometry, options: FrontEndOptions) -> float:
    """Share of image a that can lie on b; 0 where it is too small to be worth a comparison.

    Within a stop the search window counts, so that a small overlap is found wherever the pointing errs.
    Between stops the window would keep nearly all pairs: there the pointing is taken as exact.
    """
    share = float(np.mean(pair.overlap(options, widened=pair.same_stop)))
    least = options.min_overlap if pair.same_stop else options.min_overlap_between_stops
    return share if share > least else 0.0


def near_stops(traverse: Traverse, options: FrontEndOptions) -> BoolArray:
    """Which stops (stops, stops) may stand near enough to another one to see the same terrain.

    They count as near where errors of telemetry of two sigmas may have put them further apart than they are,
    by no more than the distance that is near itself.
    """
    most_m = options.max_stop_distance_m
    place = np.array([s.world_T_mast.translation() for s in traverse.stops])
    sigma = np.array([s.sigma_translation_m for s in traverse.stops])
    off_m = np.minimum(_OFF_SIGMAS * np.hypot(sigma[:, None], sigma), most_m)
    apart_m = np.linalg.norm(place[:, None] - place, axis=2)
    return np.asarray((apart_m - off_m <= most_m) & ~np.eye(len(place), dtype=bool))


def _cones_meet(traverse: Traverse, options: FrontEndOptions) -> BoolArray:
    """Which images (images, images) may see a common point: a quick test with cones around their fields."""
    R, centre = traverse.camera_poses()
    axis_of, half_of = zip(*(_cone(e.camera) for e in traverse.rig.eyes), strict=True)
    axis = np.einsum("nij,nj->ni", R, np.array(axis_of)[traverse.image_eye])
    half = np.array(half_of)[traverse.image_eye]
    stop = traverse.image_stop
    pointing = np.array([np.hypot(f.sigma_pan_rad, f.sigma_tilt_rad) for f in traverse.frames])
    turn = np.array([s.sigma_rotation_rad for s in traverse.stops])[stop]
    shift = np.array([s.sigma_translation_m for s in traverse.stops])[stop]
    slack = np.hypot(pointing[traverse.image_frame], turn * np.sqrt(3)) + options.mount_sigma_rad
    near = near_stops(traverse, options) | np.eye(len(traverse.stops), dtype=bool)
    meet = np.zeros((len(R), len(R)), dtype=bool)
    depths = inspected_depths_m(options.min_depth_m)
    for a, eye in enumerate(traverse.image_eye):
        camera = traverse.rig.eyes[eye].camera
        size = np.array([camera.width_px, camera.height_px])
        u, v = np.meshgrid(*np.linspace(0, size - 1, _GRID).T)
        direction = camera.unproject(np.column_stack([u.ravel(), v.ravel()])).direction @ R[a].T
        points = (centre[a] + depths[:, None, None] * direction).reshape(-1, 3)
        gap = half[a] / (_GRID - 1)
        close = np.flatnonzero(near[stop[a], stop])
        to_point, from_a = points[:, None] - centre[close], points - centre[a]
        range_m = np.maximum(np.linalg.norm(to_point, axis=2), 1e-6)
        range_a = np.maximum(np.linalg.norm(from_a, axis=1), 1e-6)[:, None]
        angle = np.arccos(np.clip(np.einsum("kni,ni->kn", to_point, axis[close]) / range_m, -1.0, 1.0))
        shifts = np.where(stop[close] == stop[a], 0.0, shift[close] + shift[a])
        spread = slack[close] + slack[a] + np.sqrt(3) * shifts / range_m
        inside = angle < half[close] + gap + options.search_sigmas * spread
        turned = np.einsum("kni,ki->kn", to_point, from_a) / (range_m * range_a)
        zoom = range_m / range_a
        alike = (turned > np.cos(MAX_TURN_RAD + gap)) & (np.abs(np.log(zoom)) < np.log(2 * MAX_ZOOM))
        meet[a, close] = np.any(inside & alike, axis=0)
    return np.asarray(meet | meet.T)


def _cone(camera: Camera) -> tuple[FloatArray, float]:
    """Axis (3,) and half angle of a cone around the camera's field."""
    right, bottom = camera.width_px - 1.0, camera.height_px - 1.0
    edge = np.array(
        [[x * right, y * bottom] for x in (0, 0.5, 1) for y in (0, 0.5, 1) if (x, y) != (0.5, 0.5)]
    )
    axis = camera.unproject(np.array([[right / 2, bottom / 2]])).direction[0]
    cosine = camera.unproject(edge).direction @ axis
    return axis, float(np.arccos(np.clip(cosine.min(), -1.0, 1.0)))


def overlap_cells(traverse: Traverse, pairs: Sequence[PairGeometry], options: FrontEndOptions) -> BoolArray:
    """Which pieces of each image any of the pairs overlap on, (images, 32, 32) by row and column."""
    wanted = np.zeros((len(traverse.images), _CELLS, _CELLS), dtype=bool)
    for pair in pairs:
        for one in (pair, replace(pair, a=pair.b, b=pair.a)):
            wanted[one.a] |= one.overlap(options, widened=True, cells=_CELLS)
    return wanted
