"""Where a stop stands relative to another, from terrain points of the one and pixels of the other."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import Refusal, mean_sigma_px
from pancam_graph.images._features import Features
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._match import beyond_chance, match_in_windows
from pancam_graph.images._pairs import Segments
from pancam_graph.images._terrain import Sighting, StopTerrain

__all__ = [
    "Alignment",
    "Ties",
    "align_stops",
    "believed",
    "fit_pose",
    "telemetry_alignment",
    "whitened_distance",
]

_MAX_TURN_COSINE = float(np.cos(np.deg2rad(40.0)))
_MAX_ZOOM = 2.5
_LEAST_SEEN = 20
_STEPS_PER_OCTAVE = 2
_FINAL_STEPS = 6
_AGREE_SIGMAS = 3.0
_ROUNDS = 2
_CONTRADICTED_SIGMAS = 3.0
_WIDE_PX = 40.0
"""Median half width of windows from which several starts are tried."""
_START_WINDOW = 0.5
"""Sigmas of telemetry about each start, as a share of its own."""
_RINGS = ((0.0, 1), (3.5, 8))
"""Rings of starts: radius in sigmas of telemetry, and how many stand on it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """Pose of a stop's mast in a world where another stop stands at its own."""

    world_T_mast: gtsam.Pose3
    root: FloatArray
    """(6, k) square root of its covariance in the tangent."""

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) covariance of the pose in its tangent."""
        return np.asarray(self.root @ self.root.T)


@dataclass(frozen=True, kw_only=True, eq=False)
class Ties:
    """Points of one stop's terrain, and pixels in images of another stop that show them."""

    row: IntArray
    """(n,) row of each point in the terrain of its stop."""
    image: IntArray
    """(n,) row of the image that shows it."""
    uv_px: FloatArray
    """(n, 2) where the image shows it, raw pixels."""
    covariance_px2: FloatArray
    """(n, 2, 2) its covariance."""

    @staticmethod
    def concatenate(parts: "list[Ties]") -> "Ties":
        """The ties of all parts, one after the other."""
        empty = np.empty(0, dtype=np.int64)
        return Ties(
            row=np.concatenate([empty, *(p.row for p in parts)]),
            image=np.concatenate([empty, *(p.image for p in parts)]),
            uv_px=np.concatenate([np.empty((0, 2)), *(p.uv_px for p in parts)]),
            covariance_px2=np.concatenate([np.empty((0, 2, 2)), *(p.covariance_px2 for p in parts)]),
        )

    def select(self, rows: BoolArray | IntArray) -> "Ties":
        """Some of the ties."""
        return Ties(
            row=self.row[rows],
            image=self.image[rows],
            uv_px=self.uv_px[rows],
            covariance_px2=self.covariance_px2[rows],
        )

    def scaled(self, factor: FloatArray) -> "Ties":
        """The ties with their standard deviations multiplied by factors (n,)."""
        return replace(self, covariance_px2=self.covariance_px2 * np.square(factor)[:, None, None])

    @property
    def sigma_px(self) -> FloatArray:
        """(n,) root of the mean variance of each."""
        return mean_sigma_px(self.covariance_px2)

    def __len__(self) -> int:
        """Number of ties."""
        return len(self.row)


def telemetry_alignment(terrain: StopTerrain, a: int, b: int) -> Alignment:
    """Stop b relative to stop a by telemetry, with the pointing that the images of each stop give."""
    first, second = terrain.traverse.stops[a], terrain.traverse.stops[b]
    apart_m = float(np.linalg.norm(first.world_T_mast.translation() - second.world_T_mast.translation()))
    rotation = np.hypot(first.sigma_rotation_rad, second.sigma_rotation_rad)
    # A common error of a stop's pan cannot be told from its heading.
    pointing = max((max(f.sigma_pan_rad, f.sigma_tilt_rad) for f in terrain.traverse.frames), default=0.0)
    lever = apart_m * np.hypot(first.sigma_rotation_rad, pointing)
    translation = np.hypot(np.hypot(first.sigma_translation_m, second.sigma_translation_m), lever)
    sigma = np.repeat([np.hypot(rotation, np.sqrt(2) * pointing), translation], 3)
    return Alignment(world_T_mast=second.world_T_mast, root=np.diag(sigma)[:, sigma > 0])


def align_stops(
    terrain: StopTerrain,
    features: Callable[[int], Features],
    a: int,
    b: int,
    options: FrontEndOptions,
) -> Alignment | Refusal:
    """Stop b relative to stop a from features whose descriptors agree, or why these may agree by chance.

    Each point of a's terrain is looked for among the first sightings of b's, around where telemetry has it;
    what most of these matches say corrects the pose, and the search is repeated in the smaller windows. Where
    they contradict telemetry, it is repeated with a telemetry that pulls less (see `believed`). Where
    telemetry leaves wide windows open, the search begins where most matches agree (see `_begun`).
    """
    telemetry = telemetry_alignment(terrain, a, b)
    correction = _begun(terrain, features, (a, b), telemetry, options)
    prior, rounds = believed(telemetry, correction), _ROUNDS
    while rounds:
        rounds -= 1
        ties, half_width = _matched(terrain, features, (a, b), correction, options)
        if len(ties) < options.min_pair_matches:
            return Refusal.FEW_ALIKE
        start_px = float(np.median(half_width))
        correction = fit_pose(terrain, ties, prior, correction, start_px)
        distance = whitened_distance(terrain, ties, correction.world_T_mast)
        # Wrong matches are spread evenly over their windows: this share of them agrees by chance.
        chance = np.minimum(1.0, (_AGREE_SIGMAS / half_width) ** 2)
        if not beyond_chance(distance < _AGREE_SIGMAS, chance, options):
            return Refusal.CHANCE
        loosened = believed(telemetry, correction)
        if prior is telemetry and loosened is not telemetry:
            prior, rounds = loosened, _ROUNDS
    return correction


def _begun(
    terrain: StopTerrain,
    features: Callable[[int], Features],
    stops: tuple[int, int],
    telemetry: Alignment,
    options: FrontEndOptions,
) -> Alignment:
    """Where a search begins: telemetry, or of several starts about it the one that most matches agree with.

    Far terrain agrees with every start, and in wide windows near terrain finds what looks like it: a fit from
    one start may end metres off. Where windows are wide, each start has windows of half that width, and the
    pose that its own matches say is the candidate. The starts stand in rings on level ground.
    """
    widths = [sought.radius_px[sought.usable] for sought in _windows(terrain, stops, telemetry, options)]
    if np.median(np.concatenate([np.zeros(1), *widths])) < _WIDE_PX:
        return telemetry
    sigma_m = float(np.sqrt(np.diag(telemetry.covariance)[3:].max()))
    up = telemetry.world_T_mast.rotation().matrix()[2]
    east, north = np.linalg.svd(up[None])[2][1:]
    best, most = telemetry, 0.0
    for radius, number in _RINGS:
        for angle in 2 * np.pi * np.arange(number) / number:
            shift = radius * sigma_m * (np.cos(angle) * east + np.sin(angle) * north)
            place = telemetry.world_T_mast.compose(gtsam.Pose3(gtsam.Rot3(), shift))
            start = Alignment(world_T_mast=place, root=_START_WINDOW * telemetry.root)
            ties, half_width = _matched(terrain, features, stops, start, options)
            if len(ties) < options.min_pair_matches:
                continue
            found = fit_pose(terrain, ties, start, start, float(np.median(half_width)))
            agree = whitened_distance(terrain, ties, found.world_T_mast) < _AGREE_SIGMAS
            surplus = float(np.sum(agree - np.minimum(1.0, (_AGREE_SIGMAS / half_width) ** 2)))
            if surplus > most:
                best, most = found, surplus
    return best


def believed(telemetry: Alignment, found: Alignment) -> Alignment:
    """Telemetry as a prior beside what images found: with larger sigmas where they contradict it.

    Beyond three of its sigmas telemetry would only pull what was found away from where it is: all its sigmas
    then grow until the largest correction is one of them.
    """
    gone = gtsam.Pose3.Logmap(telemetry.world_T_mast.between(found.world_T_mast))
    largest = float(np.abs(np.linalg.lstsq(telemetry.root, gone, rcond=None)[0]).max())
    return replace(telemetry, root=telemetry.root * largest) if largest > _CONTRADICTED_SIGMAS else telemetry


def _matched(
    terrain: StopTerrain,
    features: Callable[[int], Features],
    stops: tuple[int, int],
    at: Alignment,
    options: FrontEndOptions,
) -> tuple[Ties, FloatArray]:
    """Points of the first stop matched with first sightings of the second's; their windows' half widths."""
    parts, widths = [], []
    for sought in _windows(terrain, stops, at, options):
        seen, radius = sought.seen, sought.radius_px
        segments = Segments(
            far_px=seen.uv_px,
            near_px=seen.uv_px,
            far_radius_px=radius,
            near_radius_px=radius,
            magnification=seen.zoom,
            valid=sought.usable,
        )
        of_terrain = features(sought.own).select(terrain.feature[sought.rows])
        theirs = terrain.rows_of[sought.image]
        other = features(sought.image).select(terrain.feature[theirs])
        matches = match_in_windows(of_terrain, other, segments, options)
        parts.append(
            Ties(
                row=sought.rows[matches.a],
                image=np.full(len(matches), sought.image, dtype=np.int64),
                uv_px=other.uv_px[matches.b],
                covariance_px2=np.maximum(seen.zoom[matches.a], 1.0)[:, None, None] ** 2 * np.eye(2),
            )
        )
        widths.append(radius[matches.a])
    return Ties.concatenate(parts), np.concatenate([np.empty(0), *widths])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Windows:
    """Points of one image of the first stop, and where an image of the second may show them."""

    own: int
    """Image that saw the points first."""
    image: int
    rows: IntArray
    """(n,) rows of the points."""
    seen: Sighting
    radius_px: FloatArray
    """(n,) half widths of the windows about them."""
    usable: BoolArray
    """(n,) whether the image can show each alike."""


def _windows(
    terrain: StopTerrain, stops: tuple[int, int], at: Alignment, options: FrontEndOptions
) -> Iterator[_Windows]:
    """The windows of all pairs of images of two stops that may share enough points."""
    rows_of, stop = terrain.rows_of, terrain.traverse.image_stop
    ours, theirs = ([i for i in np.flatnonzero(stop == s).tolist() if i in rows_of] for s in stops)
    for i in ours:
        for j in theirs:
            seen = terrain.sighting(rows_of[i], j, at.world_T_mast)
            radius = _radius_px(terrain, rows_of[i], seen, at, options)
            usable = _comparable(terrain, j, seen, radius)
            if np.count_nonzero(usable) >= _LEAST_SEEN:
                yield _Windows(own=i, image=j, rows=rows_of[i], seen=seen, radius_px=radius, usable=usable)


def _radius_px(
    terrain: StopTerrain, rows: IntArray, seen: Sighting, at: Alignment, options: FrontEndOptions
) -> FloatArray:
    spread = seen.covariance_px2(at.covariance, terrain.sigma_inverse_m[rows])
    largest = np.linalg.eigvalsh(spread)[:, 1]
    return np.asarray(options.search_sigmas * np.sqrt(largest) + options.search_slack_px)


def _comparable(terrain: StopTerrain, image: int, seen: Sighting, margin_px: FloatArray) -> BoolArray:
    """Which points the image can show from a side and distance similar to the first sighting's."""
    camera = terrain.camera(image)
    size = np.array([camera.width_px, camera.height_px])
    on = np.all((seen.uv_px > -margin_px[:, None]) & (seen.uv_px < size + margin_px[:, None]), axis=1)
    alike = (seen.cosine > _MAX_TURN_COSINE) & (np.abs(np.log(seen.zoom)) < np.log(_MAX_ZOOM))
    return np.asarray(seen.valid & on & alike & (margin_px < size.max() / 4))


def whitened_distance(terrain: StopTerrain, ties: Ties, world_T_mast: gtsam.Pose3) -> FloatArray:
    """Distances (n,) of ties from their points' pixels, in units of what noise and depths leave open."""
    residual, root, _ = _whitened(terrain, ties, world_T_mast)
    return np.asarray(np.linalg.norm(np.einsum("nij,nj->ni", root, residual), axis=1))


def _whitened(
    terrain: StopTerrain, ties: Ties, world_T_mast: gtsam.Pose3
) -> tuple[FloatArray, FloatArray, Sighting]:
    """Residuals (n, 2) in pixels, and the matrices (n, 2, 2) that take them to unit covariance."""
    seen = terrain.sighting(ties.row, ties.image, world_T_mast)
    covariance = ties.covariance_px2 + seen.covariance_px2(
        np.zeros((6, 6)), terrain.sigma_inverse_m[ties.row]
    )
    return ties.uv_px - seen.uv_px, np.linalg.inv(np.linalg.cholesky(covariance)), seen


def fit_pose(
    terrain: StopTerrain,
    ties: Ties,
    prior: Alignment,
    start: Alignment,
    start_scale: float,
) -> Alignment:
    """The pose that brings most ties onto their points, against the prior.

    Many ties may be wrong: weights follow Geman and McClure with a scale that shrinks from `start_scale`,
    in units of the noise, to 1 (graduated non-convexity: Blake and Zisserman 1987).
    """
    octaves = max(0.0, float(np.log2(start_scale)))
    shrinking = start_scale * 0.5 ** np.arange(0, octaves, 1 / _STEPS_PER_OCTAVE)
    pose, columns = start.world_T_mast, prior.root.shape[1]
    information = np.eye(columns)
    for scale in [*shrinking, *[1.0] * _FINAL_STEPS]:
        residual, root, seen = _whitened(terrain, ties, pose)
        r = np.einsum("nij,nj->ni", root, residual)
        J = root @ seen.d_pose @ prior.root
        weight = (scale**2 / (scale**2 + np.sum(r * r, axis=1))) ** 2 * seen.valid
        # The tangent at the pose is taken for that at the prior, from which it differs little.
        gone = gtsam.Pose3.Logmap(prior.world_T_mast.between(pose))
        q = np.linalg.lstsq(prior.root, gone, rcond=None)[0]
        information = np.eye(columns) + np.einsum("n,nik,nil->kl", weight, J, J)
        step = np.linalg.solve(information, np.einsum("n,nik,ni->k", weight, J, r) - q)
        pose = pose.retract(prior.root @ step)
    return Alignment(world_T_mast=pose, root=prior.root @ np.linalg.inv(np.linalg.cholesky(information)).T)
