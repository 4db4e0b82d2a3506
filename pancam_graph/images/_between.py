"""Ties between stops: where patches of the terrain of one stop lie in the images of another."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pancam_graph.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.images._alignment import (
    Alignment,
    Ties,
    align_stops,
    fit_pose,
    telemetry_alignment,
    whitened_distance,
)
from pancam_graph.images._features import Features
from pancam_graph.images._masks import pixels_at
from pancam_graph.images._options import FrontEndOptions
from pancam_graph.images._patches import HALF_WIDTH_PX, MAX_REACH_PX, Coefficients, align_patches
from pancam_graph.images._splines import Splines
from pancam_graph.images._terrain import Sighting, Terrain, terrain_of
from pancam_graph.io.image_files import GreyImage
from pancam_graph.solve import solve
from pancam_graph.threads import in_parallel
from pancam_graph.traverse import Observations, Traverse

__all__ = ["near_stops", "stereo_stops", "tie_stops"]

_LOG = logging.getLogger(__name__)

_CELL_PX = 64.0
_PER_CELL = 2
_STEPS = 10
_GRAIN = 64
_MIN_CORRELATION = 0.75
_MIN_LEAD = 0.05
_MAX_MOVE_PX = 1.5
_MAX_TURN_COSINE = float(np.cos(np.deg2rad(75.0)))
_SMALLEST_STRETCH = 0.6
_LARGEST_STRETCH = 4.0
_SLACK_PX = 1.5
_FIT_SCALE = 4.0
_FITS = 4
_LEAST_NOISE_PX = 0.05

Progress = Callable[[int, int], None]


def stereo_stops(traverse: Traverse, pairs: Sequence[tuple[int, int]]) -> BoolArray:
    """Which stops (stops,) have eyes that see the same at once, by pairs of images that overlap."""
    found = np.zeros(len(traverse.stops), dtype=bool)
    for a, b in pairs:
        if traverse.image_frame[a] == traverse.image_frame[b]:
            found[traverse.image_stop[a]] = True
    return found


def near_stops(traverse: Traverse, options: FrontEndOptions) -> BoolArray:
    """Which stops (stops, stops) stand near enough to another one to see the same terrain."""
    place = np.array([s.world_T_mast.translation() for s in traverse.stops])
    apart_m = np.linalg.norm(place[:, None] - place, axis=2)
    return np.asarray((apart_m <= options.max_stop_distance_m) & ~np.eye(len(place), dtype=bool))


def tie_stops(
    traverse: Traverse,
    images: Sequence[GreyImage | None],
    usable: Sequence[BoolArray | None],
    features: list[Features],
    feature_of: IntArray,
    stop_pairs: Sequence[tuple[int, int]],
    options: FrontEndOptions,
    progress: Progress | None = None,
) -> tuple[Observations, list[str]]:
    """Observations of the traverse with what pairs of stops see of each other's terrain added; warnings.

    The traverse has observations within stops, sorted by track, then image; `feature_of` says of which
    feature each is, `usable` where each image (height, width) shows terrain. A solve of these places the
    terrain of each stop. Features that look alike correct where stops stand relative to each other; then the
    patch around a point of one stop is sought in the images of the other where the corrected poses have it,
    warped by the surface there, and matched by least squares.
    """
    assert traverse.observations is not None
    solution = solve(traverse)
    terrain = terrain_of(solution)
    terrain = terrain.select(_on_terrain(usable, terrain.image, terrain.uv_px))
    spline = Splines(images)
    chosen = _spread(terrain)
    unit = float(np.median(traverse.observations.sigma_px / solution.sigma_px))
    parts, sigmas, warnings = [], [np.empty(0)], list[str]()
    for k, (a, b) in enumerate(stop_pairs):
        names = traverse.stops[a].id, traverse.stops[b].id
        count = 0
        for one, other in ((a, b), (b, a)):
            alignment = align_stops(terrain, features, feature_of, one, other, options)
            if alignment is None:
                continue
            ties, noise_px = _between(terrain, spline, chosen, (one, other), alignment, options)
            ties = ties.select(_on_terrain(usable, ties.image, ties.uv_px))
            _LOG.info("%s in %s: %d ties, noise %.2f px", names[0], names[1], len(ties), noise_px)
            count += len(ties)
            parts.append(ties)
            # A solve finds one factor for all noise: the ties' is stated in the units of the others'.
            sigmas.append(np.full(len(ties), noise_px * unit))
        if not count:
            warnings.append(
                f"stops {names[0]} and {names[1]}: no ties, although they may see the same terrain"
            )
        if progress is not None:
            progress(k + 1, len(stop_pairs))
    ties = Ties.concatenate(parts)
    return _joined(traverse.observations, terrain, ties, np.concatenate(sigmas)), warnings


def _on_terrain(usable: Sequence[BoolArray | None], image: IntArray, uv_px: FloatArray) -> BoolArray:
    """Which pixels (n, 2) of images (n,) show terrain."""
    found = np.zeros(len(image), dtype=bool)
    for i in np.unique(image).tolist():
        mask, rows = usable[i], image == i
        assert mask is not None  # it has observations
        found[rows] = pixels_at(mask, uv_px[rows])
    return found


def _spread(terrain: Terrain) -> BoolArray:
    """Which points stand for their surroundings: in each cell of an image those that are placed best."""
    cell = np.floor(terrain.uv_px / _CELL_PX).astype(np.int64)
    order = np.lexsort((terrain.sigma_inverse_m, cell[:, 0], cell[:, 1], terrain.image))
    key = np.column_stack([terrain.image, cell])[order]
    starts = np.concatenate([[True], np.any(np.diff(key, axis=0) != 0, axis=1)])
    begin = np.maximum.accumulate(np.where(starts, np.arange(len(order)), 0))
    chosen = np.zeros(len(order), dtype=bool)
    chosen[order] = np.arange(len(order)) - begin < _PER_CELL
    return chosen


def _between(
    terrain: Terrain,
    spline: Splines,
    chosen: BoolArray,
    stops: tuple[int, int],
    alignment: Alignment,
    options: FrontEndOptions,
) -> tuple[Ties, float]:
    """Patches of the first stop found in images of the second, and the noise of their pixels."""
    t = terrain.traverse
    ours, theirs = (np.flatnonzero(t.image_stop == s).tolist() for s in stops)
    rows_of = {i: np.flatnonzero(chosen & (terrain.image == i)) for i in ours}
    # Images of the second stop in the outer loop: theirs are blurred to several levels, each made once.
    parts = [
        _found(terrain, spline, rows, j, alignment, options)
        for j in theirs
        for rows in rows_of.values()
        if len(rows)
    ]
    ties = Ties.concatenate(parts)
    if len(ties) < options.min_pair_matches:
        return Ties.concatenate([]), 0.0
    prior, noise_px = telemetry_alignment(terrain, *stops), options.max_epipolar_px / options.epipolar_scales
    for _ in range(_FITS):
        alignment = fit_pose(terrain, ties, prior, alignment, _FIT_SCALE, noise_px)
        distance = whitened_distance(terrain, ties, alignment.world_T_mast, noise_px)
        # The median of a length in two directions is 1.177 sigma. Wrong ties must not widen it.
        noise_px *= min(1.0, max(float(np.median(distance)) / 1.177, _LEAST_NOISE_PX / noise_px))
    distance = whitened_distance(terrain, ties, alignment.world_T_mast, noise_px)
    return ties.select(distance < options.epipolar_scales), noise_px


def _found(
    terrain: Terrain,
    spline: Splines,
    rows: IntArray,
    image: int,
    alignment: Alignment,
    options: FrontEndOptions,
) -> Ties:
    """Patches around points of one image found in another."""
    seen = terrain.sighting(rows, image, alignment.world_T_mast)
    camera = terrain.camera(image)
    size = np.array([camera.width_px, camera.height_px])
    margin = HALF_WIDTH_PX + 1.0
    inside = np.all((seen.uv_px > margin) & (seen.uv_px < size - 1 - margin), axis=1)
    own = terrain.camera(int(terrain.image[rows[0]]))
    own_size = np.array([own.width_px, own.height_px])
    inside &= np.all((terrain.uv_px[rows] > margin) & (terrain.uv_px[rows] < own_size - 1 - margin), axis=1)
    inside &= seen.valid & (seen.cosine > _MAX_TURN_COSINE)
    rows, seen = rows[inside], seen.select(inside)
    if not len(rows):
        return Ties.concatenate([])
    affine = terrain.affine(rows, image, alignment.world_T_mast)
    finite: BoolArray = np.asarray(np.isfinite(affine).all(axis=(1, 2)))
    stretch = np.linalg.svd(np.where(finite[:, None, None], affine, 0.0), compute_uv=False)
    usable = finite & (stretch[:, 0] < _LARGEST_STRETCH)
    # From the coarser to the finer image: what the finer one shows the coarser one may not.
    usable &= stretch[:, 1] > _SMALLEST_STRETCH
    usable &= np.linalg.det(np.where(finite[:, None, None], affine, 0.0)) > 0
    reach = _reach(terrain, rows, seen, affine, usable, alignment, options)
    usable &= np.all(reach <= MAX_REACH_PX, axis=1)
    k = np.flatnonzero(usable)
    if not len(k):
        return Ties.concatenate([])
    level = np.clip(np.rint(2 * np.log2(np.sqrt(stretch[k, 0] * stretch[k, 1]))), 0, 4).astype(np.int64)
    uv, fit = seen.uv_px[k].copy(), np.empty((len(k), 4))
    for blur in np.unique(level).tolist():
        part = np.flatnonzero(level == blur)
        uv[part], fit[part] = _aligned(
            spline(int(terrain.image[rows[0]])),
            spline(image, blur),
            (terrain.uv_px[rows[k[part]]], affine[k[part]], reach[k[part]], uv[part]),
        )
    at_start, correlation, second, moved = fit.T
    good = (correlation > _MIN_CORRELATION) & (correlation >= at_start)
    good &= (correlation - second > _MIN_LEAD) & (moved < _MAX_MOVE_PX * stretch[k, 0])
    good &= np.all((uv > margin) & (uv < size - 1 - margin), axis=1)
    return Ties(row=rows[k[good]], image=np.full(int(good.sum()), image, dtype=np.int64), uv_px=uv[good])


def _reach(
    terrain: Terrain,
    rows: IntArray,
    seen: Sighting,
    affine: FloatArray,
    usable: BoolArray,
    alignment: Alignment,
    options: FrontEndOptions,
) -> IntArray:
    """How far (n, 2) to search along u and v of the first image, in whole pixels."""
    inverse = np.linalg.inv(np.where(usable[:, None, None], affine, np.eye(2)))
    spread = seen.covariance_px2(alignment.covariance, terrain.sigma_inverse_m[rows])
    own = inverse @ spread @ np.swapaxes(inverse, 1, 2)
    sigma = np.sqrt(np.maximum(np.diagonal(own, axis1=1, axis2=2), 0.0))
    reach = np.ceil(options.search_sigmas * sigma + _SLACK_PX)
    return np.asarray(np.minimum(reach, MAX_REACH_PX + 1), dtype=np.int64)


def _aligned(
    image_a: Coefficients,
    image_b: Coefficients,
    patches: tuple[FloatArray, FloatArray, IntArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Pixels in b (n, 2) and what `align_patches` says of them, for its `uv_a`, `affine`, `reach`, `uv_b`."""
    uv_a, affine, reach, start = patches
    uv_b, fit = start.copy(), np.empty((len(uv_a), 4))
    in_parallel(
        lambda first, last: align_patches(
            first, last, image_a, image_b, uv_a, affine, reach, _STEPS, uv_b, fit
        ),
        len(uv_a),
        grain=_GRAIN,
    )
    return uv_b, fit


def _joined(obs: Observations, terrain: Terrain, ties: Ties, sigma_px: FloatArray) -> Observations:
    """Observations with the ties added to their points' tracks."""
    image = np.concatenate([obs.image, ties.image])
    track = np.concatenate([obs.track, terrain.track[ties.row]])
    order = np.lexsort((image, track))
    return replace(
        obs,
        image=image[order],
        track=track[order],
        uv_px=np.concatenate([obs.uv_px, ties.uv_px])[order],
        sigma_px=np.concatenate([obs.sigma_px, sigma_px])[order],
    )
