"""Ties between stops: where patches of the terrain of one stop lie in the images of another."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.threads import in_parallel
from pancam_graph.data import Refusal, StopMatching, Traverse
from pancam_graph.images._alignment import (
    Alignment,
    Ties,
    align_stops,
    believed,
    fit_pose,
    telemetry_alignment,
    whitened_distance,
)
from pancam_graph.images._features import Features
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._local_map import HALF_WIDTH_PX
from pancam_graph.images._patch_noise import patch_covariance_px2
from pancam_graph.images._patches import MAX_REACH_PX, QUALITIES, Coefficients, align_patches
from pancam_graph.images._terrain import Sighting, StopTerrain
from pancam_graph.images._usable import on_terrain

__all__ = ["StopMatcher", "StopTies", "agreeing", "stereo_stops"]

_CELL_PX = 64.0
_PER_CELL = 2
_STEPS = 10
_GRAIN = 64
_MIN_CORRELATION = 0.75
_MIN_LEAD = 0.05
_MAX_MOVE_PX = 1.5
_MAX_TURN_COSINE = float(np.cos(np.deg2rad(75.0)))
_SMALLEST_STRETCH = 0.5
_LARGEST_STRETCH = 4.0
_SLACK_PX = 1.5
_FIT_SCALE = 4.0
_FITS = 4
_MAX_RETURN_PX = 0.3
_LEAST_NOISE_PX = 0.05
_COMMON = 2.5
_GAP_SIGMAS, _GAP_SHARE, _GAP_RAD = 8.0, 0.02, 3e-3
_GROUP, _MOST_GROUPS = 100, 6
_COUNTS = ("a", "b", "sought", "unlike", "ambiguous", "unstable", "masked", "off_pose", "kept", "refusal")


def stereo_stops(traverse: Traverse, pairs: Sequence[tuple[int, int]]) -> BoolArray:
    """Which stops (stops,) have two eyes of one pointing whose images overlap."""
    in_stereo = np.zeros(len(traverse.stops), dtype=bool)
    for a, b in pairs:
        if traverse.image_frame[a] == traverse.image_frame[b]:
            in_stereo[traverse.image_stop[a]] = True
    return in_stereo


@dataclass(frozen=True, kw_only=True, eq=False)
class StopTies:
    """Ties of one stop's terrain with the images of another, and counts of the patches without a tie."""

    ties: Ties
    report: StopMatching
    pose: Alignment
    """The second stop in a world where the first stands at its own, by these ties; without, by telemetry."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything as arrays, for the cache."""
        counts = [int(getattr(self.report, name)) for name in _COUNTS]
        noise_px = np.array(self.report.noise_px)
        return {
            **vars(self.ties),
            "noise_px": noise_px,
            "counts": np.array(counts),
            "pose": self.pose.world_T_mast.matrix(),
            "root": self.pose.root,
        }

    @staticmethod
    def of_arrays(arrays: Mapping[str, NDArray[Any]]) -> "StopTies":
        """The inverse of `arrays`."""
        counts = dict(zip(_COUNTS, arrays["counts"].tolist(), strict=True))
        refusal, noise_px = Refusal(counts.pop("refusal")), float(arrays["noise_px"])
        return StopTies(
            ties=Ties(**{name: arrays[name] for name in ("row", "image", "uv_px", "covariance_px2")}),
            report=StopMatching(**counts, noise_px=noise_px, refusal=refusal),
            pose=Alignment(world_T_mast=gtsam.Pose3(arrays["pose"]), root=arrays["root"]),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class StopMatcher:
    """Finds the terrain of one stop in the images of another. Several threads may use it at once."""

    terrain: StopTerrain
    """Points of the stops, without those that a mask covers. Images are by their rows in it."""
    spline: Callable[[int, int], Coefficients]
    """Spline coefficients of an image, blurred by half octaves; see `Splines`."""
    usable: Callable[[int], BoolArray]
    """Which pixels (height, width) of an image show terrain, by row."""
    features: Callable[[int], Features]
    """Features of an image, by row."""
    options: FrontEndOptions

    def ties(self, one: int, other: int) -> StopTies:
        """Points of stop `one` in images of stop `other`.

        Features that look alike correct where the stops stand relative to each other; then the patch around
        a point is sought in the images where the corrected pose has it, warped by the surface there, and
        matched by least squares.
        """
        alignment = align_stops(self.terrain, self.features, one, other, self.options)
        if isinstance(alignment, Refusal):
            return _nothing(self.terrain, (one, other), _Sought(), alignment)
        t = self.terrain.traverse
        ours, theirs = (np.flatnonzero(t.image_stop == s).tolist() for s in (one, other))
        rows_of = {i: rows[self._chosen[rows]] for i, rows in self.terrain.rows_of.items() if i in ours}
        # Images of the second stop in the outer loop: each is blurred to several levels, and each level once.
        parts = [
            _found(self.terrain, self.spline, rows, j, alignment, self.options)
            for j in theirs
            for rows in rows_of.values()
            if len(rows)
        ]
        sought, ties = sum((part[0] for part in parts), _Sought()), Ties.concatenate([p[1] for p in parts])
        shown = on_terrain(self.usable, ties.image, ties.uv_px)
        sought += _Sought(masked=int(np.count_nonzero(~shown)))
        ties = ties.select(shown)
        if len(ties) < self.options.min_pair_matches:
            return _nothing(self.terrain, (one, other), sought, Refusal.FEW_GUIDED)
        n_ties = len(ties)
        ties, alignment = _measured(self.terrain, ties, (one, other), alignment, self.options)
        report = StopMatching(
            a=one,
            b=other,
            **vars(sought),
            off_pose=n_ties - len(ties),
            kept=len(ties),
            noise_px=float(np.sqrt(np.mean(ties.sigma_px**2))) if len(ties) else 0.0,
        )
        ties = _with_common_errors(ties)
        # Ties of one point in several images err alike, by the point's own patch: they count as one.
        _, of, times = np.unique(ties.row, return_inverse=True, return_counts=True)
        return StopTies(ties=ties.scaled(np.sqrt(times[of])), report=report, pose=alignment)

    @cached_property
    def _chosen(self) -> BoolArray:
        return _spread(self.terrain)


def _nothing(terrain: StopTerrain, stops: tuple[int, int], sought: "_Sought", refusal: Refusal) -> StopTies:
    a, b = stops
    report = StopMatching(a=a, b=b, **vars(sought), off_pose=0, kept=0, noise_px=0.0, refusal=refusal)
    return StopTies(ties=Ties.concatenate([]), report=report, pose=telemetry_alignment(terrain, a, b))


def agreeing(terrain: StopTerrain, there: StopTies, back: StopTies) -> tuple[StopTies, StopTies]:
    """The ties of the two stops of a terrain in both directions; none where these contradict each other.

    Either stop's terrain in the images of the other says where the two stand relative to each other. That is
    the same twice, unless one of them, or both, fitted what is alike by chance.
    """
    if there.report.refusal or back.report.refusal:
        return there, back
    masts = [stop.world_T_mast for stop in terrain.traverse.stops]
    a_T_b, b_T_a = masts[0].between(there.pose.world_T_mast), masts[1].between(back.pose.world_T_mast)
    gap = gtsam.Pose3.Logmap(a_T_b.compose(b_T_a))
    moved = b_T_a.inverse().AdjointMap()
    covariance = moved @ there.pose.covariance @ moved.T + back.pose.covariance
    sigmas = np.sqrt(gap @ np.linalg.lstsq(covariance, gap, rcond=None)[0] / len(gap))
    apart_m = float(np.linalg.norm(a_T_b.translation()))
    far = np.linalg.norm(gap[3:]) > _GAP_SHARE * apart_m or np.linalg.norm(gap[:3]) > _GAP_RAD
    if not (far and sigmas > _GAP_SIGMAS):
        return there, back
    return _contradicted(terrain, (0, 1), there), _contradicted(terrain, (1, 0), back)


def _contradicted(terrain: StopTerrain, stops: tuple[int, int], stop_ties: StopTies) -> StopTies:
    report = stop_ties.report
    return StopTies(
        ties=Ties.concatenate([]),
        report=replace(
            report,
            off_pose=report.off_pose + report.kept,
            kept=0,
            noise_px=0.0,
            refusal=Refusal.CONTRADICTION,
        ),
        pose=telemetry_alignment(terrain, *stops),
    )


@dataclass(frozen=True, kw_only=True)
class _Sought:
    """The report of two stops from counts of patches."""

    sought: int = 0
    unlike: int = 0
    ambiguous: int = 0
    unstable: int = 0
    masked: int = 0

    def __add__(self, other: "_Sought") -> "_Sought":
        return _Sought(**{name: value + getattr(other, name) for name, value in vars(self).items()})


def _spread(terrain: StopTerrain) -> BoolArray:
    """Rows of the points to match: in each cell of an image those whose place is known best."""
    cell = np.floor(terrain.uv_px / _CELL_PX).astype(np.int64)
    order = np.lexsort((terrain.sigma_inverse_m, cell[:, 0], cell[:, 1], terrain.image))
    key = np.column_stack([terrain.image, cell])[order]
    starts = np.concatenate([[True], np.any(np.diff(key, axis=0) != 0, axis=1)])
    begin = np.maximum.accumulate(np.where(starts, np.arange(len(order)), 0))
    chosen = np.zeros(len(order), dtype=bool)
    chosen[order] = np.arange(len(order)) - begin < _PER_CELL
    return chosen


def _measured(
    terrain: StopTerrain, ties: Ties, stops: tuple[int, int], alignment: Alignment, options: FrontEndOptions
) -> tuple[Ties, Alignment]:
    """The ties that agree with the pose of most ties, and that pose; covariances are from their scatter.

    Far terrain looks the same from both stops and gives ties several times better than near terrain, but near
    terrain is what places the stop: the scatter is therefore measured in groups of ties of about the same
    quality. Within a group the covariances keep their shapes and relative sizes.
    """
    prior, n = believed(telemetry_alignment(terrain, *stops), alignment), len(ties)
    quality = ties.sigma_px
    groups = np.array_split(np.argsort(quality, kind="stable"), np.clip(n // _GROUP, 1, _MOST_GROUPS))
    start_px = options.max_epipolar_px / options.epipolar_scales
    ties = ties.scaled(start_px / np.minimum(quality, max(float(np.median(quality)), 1e-12)))
    for _ in range(_FITS):
        alignment = fit_pose(terrain, ties, prior, alignment, _FIT_SCALE)
        distance, factor = whitened_distance(terrain, ties, alignment.world_T_mast), np.ones(n)
        for group in groups:
            # The median length of a Gaussian residual (2,) is 1.177 sigma; wrong ties do not widen it.
            factor[group] = min(1.0, float(np.median(distance[group])) / 1.177)
        ties = ties.scaled(np.maximum(factor, _LEAST_NOISE_PX / ties.sigma_px))
    distance = whitened_distance(terrain, ties, alignment.world_T_mast)
    return ties.select(distance < options.epipolar_scales), alignment


def _with_common_errors(ties: Ties) -> Ties:
    """The ties with what their scatter does not show: errors that all of two stops have in common.

    From nearer, an image sees more of what lies behind each bump: patches sit off their points along the
    lines of sight, all to one side. About a fortieth of the variance along the epipolar line is common to all
    ties of two stops; no sigma of single ties says that, but with this factor the stops' sigmas hold.
    """
    spread = _LEAST_NOISE_PX**2 * np.eye(2)
    return replace(ties, covariance_px2=_COMMON * ties.covariance_px2 + spread)


def _found(
    terrain: StopTerrain,
    spline: Callable[[int, int], Coefficients],
    rows: IntArray,
    image: int,
    alignment: Alignment,
    options: FrontEndOptions,
) -> tuple[_Sought, Ties]:
    """Patches around points of one image found in another."""
    seen = terrain.sighting(rows, image, alignment.world_T_mast)
    camera = terrain.camera(image)
    size = np.array([camera.width_px, camera.height_px])
    margin = HALF_WIDTH_PX + 1.0
    inside = np.all((seen.uv_px > margin) & (seen.uv_px < size - 1 - margin), axis=1)
    camera_a = terrain.camera(int(terrain.image[rows[0]]))
    size_a = np.array([camera_a.width_px, camera_a.height_px])
    inside &= np.all((terrain.uv_px[rows] > margin) & (terrain.uv_px[rows] < size_a - 1 - margin), axis=1)
    inside &= seen.valid & (seen.cosine > _MAX_TURN_COSINE)
    rows, seen = rows[inside], seen.select(inside)
    if not len(rows):
        return _Sought(), Ties.concatenate([])
    affine, bend = terrain.local_map(rows, image, alignment.world_T_mast)
    finite: BoolArray = np.asarray(np.isfinite(affine).all(axis=(1, 2)))
    stretch = np.linalg.svd(np.where(finite[:, None, None], affine, 0.0), compute_uv=False)
    usable = finite & (stretch[:, 0] < _LARGEST_STRETCH)
    # The patch of the coarser image is sought in the finer one, which shows all its detail.
    usable &= stretch[:, 1] > _SMALLEST_STRETCH
    usable &= np.linalg.det(np.where(finite[:, None, None], affine, 0.0)) > 0
    reach = _reach(terrain, rows, seen, affine, usable, alignment, options)
    usable &= np.all(reach <= MAX_REACH_PX, axis=1)
    k = np.flatnonzero(usable)
    if not len(k):
        return _Sought(), Ties.concatenate([])
    level = np.clip(np.rint(2 * np.log2(np.sqrt(stretch[k, 0] * stretch[k, 1]))), 0, 4).astype(np.int64)
    start, uv, fit = terrain.uv_px[rows[k]], seen.uv_px[k].copy(), np.empty((len(k), QUALITIES))
    first, second_at = spline(int(terrain.image[rows[0]]), 0), partial(spline, image)
    for blur in np.unique(level).tolist():
        part = np.flatnonzero(level == blur)
        patches = start[part], affine[k[part]], bend[k[part]], reach[k[part]], uv[part]
        uv[part], fit[part] = _aligned(first, second_at(blur), patches)
    at_start, correlation, second, moved = fit[:, :4].T
    alike = (correlation > _MIN_CORRELATION) & (correlation >= at_start)
    only = alike & (correlation - second > _MIN_LEAD)
    good = only & (moved < _MAX_MOVE_PX * stretch[k, 0])
    good &= np.all((uv > margin) & (uv < size - 1 - margin), axis=1)
    # The way back must end at the start: it does not where an edge hides terrain from one of the images.
    for blur in np.unique(level[good]).tolist():
        part = np.flatnonzero(good & (level == blur))
        inverse: FloatArray = np.asarray(np.linalg.inv(affine[k[part]]))
        no_bend, nowhere = np.zeros((len(part), 2, 3)), np.zeros((len(part), 2), dtype=np.int64)
        patches = uv[part], inverse, no_bend, nowhere, start[part]
        back, _ = _aligned(second_at(blur), first, patches)
        good[part] = np.linalg.norm(back - start[part], axis=1) < _MAX_RETURN_PX
    count = [int(np.count_nonzero(x)) for x in (alike, only, good)]
    sought = _Sought(
        sought=len(k), unlike=len(k) - count[0], ambiguous=count[0] - count[1], unstable=count[1] - count[2]
    )
    ties = Ties(
        row=rows[k[good]],
        image=np.full(count[2], image, dtype=np.int64),
        uv_px=uv[good],
        covariance_px2=patch_covariance_px2(fit[good, 4:], _lines(seen.select(k[good])), one_pointing=False),
    )
    return sought, ties


def _lines(seen: Sighting) -> FloatArray:
    """Unit vectors (n, 2) of the epipolar lines; 0 for a point at infinity."""
    length = np.linalg.norm(seen.d_inverse_depth, axis=1, keepdims=True)
    return np.asarray(np.where(length > 0, seen.d_inverse_depth / np.maximum(length, 1e-300), 0.0))


def _reach(
    terrain: StopTerrain,
    rows: IntArray,
    seen: Sighting,
    affine: FloatArray,
    usable: BoolArray,
    alignment: Alignment,
    options: FrontEndOptions,
) -> IntArray:
    """Reach (n, 2) of the search along u and v of the first image, in whole pixels."""
    inverse = np.linalg.inv(np.where(usable[:, None, None], affine, np.eye(2)))
    spread = seen.covariance_px2(alignment.covariance, terrain.sigma_inverse_m[rows])
    in_a = inverse @ spread @ np.swapaxes(inverse, 1, 2)
    sigma = np.sqrt(np.maximum(np.diagonal(in_a, axis1=1, axis2=2), 0.0))
    reach = np.ceil(options.search_sigmas * sigma + _SLACK_PX)
    return np.asarray(np.minimum(reach, MAX_REACH_PX + 1), dtype=np.int64)


def _aligned(
    image_a: Coefficients,
    image_b: Coefficients,
    patches: tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Pixels in b (n, 2) and their quality (n, 7); see `align_patches` for these and the arguments."""
    uv_a, affine, bend, reach, start = patches
    uv_b, fit = start.copy(), np.empty((len(uv_a), QUALITIES))
    in_parallel(
        lambda first, last: align_patches(
            first, last, image_a, image_b, uv_a, affine, bend, reach, _STEPS, uv_b, fit
        ),
        len(uv_a),
        grain=_GRAIN,
    )
    return uv_b, fit
