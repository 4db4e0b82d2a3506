"""The surface that one stereo frame sees: from two pictures to a range image, and to layers of a grid."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import ImageError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.data import StereoNodes
from pancam_graph.io import read_picture
from pancam_graph.terrain import kernel
from pancam_graph.terrain._drive import Drive, Pair
from pancam_graph.terrain._grid import Grid, Layer
from pancam_graph.terrain._match import disparity_limits, match, rectified_picture
from pancam_graph.terrain._rectify import rectify

__all__ = ["Points", "Surface", "ground_spacing_m", "surface_of"]

_ROCK_M = 0.4
"""Height of rocks above the ground at the mast's foot up to which the nearest of them are looked for."""
_NEAREST_M = 0.5
_FARTHEST_SHARE = 0.15
"""Standard deviation of a depth, as a share of it, from which on a point is left out."""
_NORMAL_PX = 2
_STEEPEST = 0.2
"""Least upward part of a normal with which the error of a depth is carried into one of the height."""
_SLOPE_CELLS = 3
"""Cells to each side over which the slope of the ground is taken that errors along the ground lift."""
_ACROSS_PX = 0.05
"""Standard deviation of where a pixel looks, across its line of sight."""
_ALIKE = 5.0
"""Points of a frame in one cell of which one counts as a measurement: windows of neighbours overlap, and
their errors are alike by 0.84, 0.63, 0.43, 0.26 and 0.10 at 1, 2, 3, 4 and 6 pixels (rendered ground)."""
_UNSEEN = 0.04
"""Standard deviation of a cell's height about what points of the frame show of it, over the distance of
neighbouring rows along the ground: what lies between rows is not seen, and hollows are hidden. From rendered
ground (docs/terrain.md)."""
_JUMP_PX = 0.6
"""Difference of two neighbours' disparities between which something is hidden: on level ground it is the
baseline over the mast's height, 0.13."""
_EDGE_PX, _EDGE_JUMP_PX = 7, 1.6
"""Width of the square around a point in which disparities may not differ by more: a window that lies across
an edge gives the background the disparity of what stands before it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """Points of a frame in the world."""

    xyz_m: FloatArray
    """(n, 3)"""
    sigma_m: FloatArray
    """(n,) standard deviation along the line of sight, the frame's own."""
    covariance_m2: FloatArray
    """(n, 3, 3) of the frame's own errors: along the line of sight, and across it."""
    grey: FloatArray
    """(n,) samples."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SharedErrors:
    """Errors that the places of one frame have in common: those of its pose and angles, and of the rig."""

    world_R_camera: FloatArray
    """(3, 3) of the left camera"""
    world_t_camera: FloatArray
    """(3,)"""
    depth_m: FloatArray
    """(depths,)"""
    nodes: StereoNodes

    def of_heights(
        self, x_m: FloatArray, y_m: FloatArray, height_m: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Variances (rows, columns) of the heights of cells at x (columns,) and y (rows,); NaN where none."""
        variance = np.empty_like(height_m)
        kernel.shared_variances(
            x_m,
            y_m,
            height_m,
            _SLOPE_CELLS,
            1 / _STEEPEST,
            np.ascontiguousarray(self.world_R_camera),
            np.ascontiguousarray(self.world_t_camera),
            self.nodes.extent,
            self.depth_m,
            self.nodes.covariance,
            variance,
        )
        return variance


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A range image in the world: points of the left, rectified picture of a pair."""

    pair: Pair
    world_T_point: tuple[FloatArray, FloatArray]
    """Directions (h, w, 3) of depth 1 and their origin (3,), with the refined pointing."""
    depth_m: NDArray[np.float32]
    """(h, w) along the axis; NaN where nothing was found."""
    sigma_m: NDArray[np.float32]
    """(h, w) standard deviation of the depth."""
    disparity_px: NDArray[np.float32]
    """(h, w)"""
    grey: NDArray[np.float32]
    """(h, w) samples of the left picture."""
    focal_px: float
    stands_m: float
    """Height of the camera above the ground at the foot of the mast."""
    tilt_sigma_rad: float
    """Of that part of the tilt's error which is the frame's alone."""
    shared: "SharedErrors | None" = None
    """Errors that its places have in common; None: unknown."""

    @cached_property
    def points_m(self) -> FloatArray:
        """World points (h, w, 3); NaN where nothing was found."""
        rays, origin = self.world_T_point
        return origin + rays * self.depth_m[..., None]

    @cached_property
    def away_m(self) -> FloatArray:
        """Distances (h, w) of the points from the camera along the ground; NaN where nothing was found."""
        _, origin = self.world_T_point
        return np.asarray(np.hypot(self.points_m[..., 0] - origin[0], self.points_m[..., 1] - origin[1]))

    def layer(
        self, grid: Grid, ring_m: tuple[float, float], move: tuple[FloatArray, FloatArray] | None = None
    ) -> Layer | None:
        """The frame's surface on a grid; None where it sees nothing of it.

        Points whose distances from the camera along the ground lie beyond those of `ring_m` are left out.
        `move` (rotation, translation) is from the refined world to another.
        """
        _, origin = self.world_T_point
        with np.errstate(invalid="ignore"):
            within = (self.away_m >= ring_m[0]) & (self.away_m <= ring_m[1])
        if not within.any():
            return None
        part = _box(within)
        points = np.where(within[part][..., None], self.points_m[part], np.nan)
        if move is not None:
            points = points @ move[0].T + move[1]
        places = grid.place(points)
        low = np.floor(np.nanmin(places, axis=(0, 1))[:2]).astype(int).clip(0)
        high = np.ceil(np.nanmax(places, axis=(0, 1))[:2]).astype(int) + 1
        high = np.minimum(high, [grid.columns, grid.rows])
        if np.any(high <= low):
            return None
        places[..., :2] -= low
        total = np.zeros((5, high[1] - low[1], high[0] - low[0]), dtype=np.float32)
        variance, grey, disparity = (
            np.ascontiguousarray(band[part])
            for band in (self.height_variance_m2, self.grey, self.disparity_px)
        )
        kernel.raster_quads(places, variance, grey, disparity, _JUMP_PX, _ALIKE, total)
        seen = total[0] > 0
        height, grey = (np.where(seen, total[k], np.float32(np.nan)) for k in (1, 2))
        # An error of the pointing moves the whole frame: cells do not average it out.
        x, y = grid.part(int(low[1]), int(low[0]), *seen.shape).middles()
        centre = origin if move is None else move[0] @ origin + move[1]
        away2 = (x - centre[0]) ** 2 + ((y - centre[1]) ** 2)[:, None]
        unseen_m = _UNSEEN * ground_spacing_m(np.sqrt(away2), self.stands_m, self.focal_px)
        whole = total[4] + (self.tilt_sigma_rad**2 * away2 + unseen_m**2).astype(np.float32)
        return Layer(
            frame=self.pair.frame,
            first_row=int(low[1]),
            first_column=int(low[0]),
            height_m=height,
            variance_m2=np.where(seen, whole, np.float32(np.nan)),
            grey=grey,
            shared_m2=None
            if self.shared is None or move is not None
            else self.shared.of_heights(x, y, height),
        )

    @cached_property
    def height_variance_m2(self) -> NDArray[np.float32]:
        """Variance (h, w) of the height of the surface at a place, from that of depths and the normals."""
        (rays, _), points_m = self.world_T_point, self.points_m
        k = _NORMAL_PX
        right, down = np.full_like(points_m, np.nan), np.full_like(points_m, np.nan)
        right[:, k:-k] = points_m[:, 2 * k :] - points_m[:, : -2 * k]
        down[k:-k] = points_m[2 * k :] - points_m[: -2 * k]
        normal = np.cross(down, right)
        length = np.linalg.norm(normal, axis=-1)
        known = np.isfinite(length) & (length > 0)
        normal = np.where(known[..., None], normal / np.where(known, length, 1.0)[..., None], (0.0, 0.0, 1.0))
        across = np.abs(np.sum(rays * normal, axis=-1)) / np.maximum(np.abs(normal[..., 2]), _STEEPEST)
        aside = _ACROSS_PX * self.depth_m / self.focal_px
        return np.asarray((across * self.sigma_m) ** 2 + aside**2, dtype=np.float32)

    def points(self, reach_m: float, every: int = 1) -> Points:
        """Every n-th of the points, those within reach along the ground, with covariances and samples."""
        found = np.flatnonzero(np.isfinite(self.depth_m))[::every]
        found = found[self.away_m.ravel()[found] <= reach_m]
        rays, origin = self.world_T_point
        ray = rays.reshape(-1, 3)[found]
        depth, sigma = self.depth_m.ravel()[found].astype(float), self.sigma_m.ravel()[found].astype(float)
        length = np.linalg.norm(ray, axis=1)
        unit = ray / length[:, None]
        along = unit[:, :, None] * unit[:, None, :]
        aside = (_ACROSS_PX * depth / self.focal_px) ** 2
        sigma_m = sigma * length
        covariance = sigma_m[:, None, None] ** 2 * along + aside[:, None, None] * (np.eye(3) - along)
        return Points(
            xyz_m=origin + ray * depth[:, None],
            sigma_m=sigma_m,
            covariance_m2=covariance,
            grey=self.grey.ravel()[found].astype(float),
        )


def _box(within: BoolArray) -> tuple[slice, slice]:
    """Rows and columns around all that is true."""
    rows, columns = (np.flatnonzero(within.any(axis=k)) for k in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def ground_spacing_m(away_m: FloatArray, stands_m: float, focal_px: float) -> FloatArray:
    """Distance of neighbouring rows' points on level ground, by the distance from the foot of the mast."""
    return np.asarray((away_m**2 + stands_m**2) / (stands_m * focal_px))


def surface_of(drive: Drive, pair: Pair, masks: tuple[BoolArray, BoolArray], farthest_m: float) -> Surface:
    """Match the pictures of a pair; `masks` say where each shows terrain.

    Raises ImageError for a picture that cannot be read.
    """
    traverse = drive.traverse
    rectified = rectify(drive, pair)
    pictures = []
    for row, usable, uv_px in zip((pair.left, pair.right), masks, rectified.maps, strict=True):
        samples = read_picture(traverse, row).samples
        if samples.shape != usable.shape:
            raise ImageError(f"image {traverse.images[row].id}: expected a picture as large as its mask")
        pictures.append(rectified_picture(samples, usable, uv_px))
    rays = rectified.rays()
    stands_m = traverse.rig.mast_height_m
    down = -rays[..., 2].min()
    nearest_m = max(max(stands_m - _ROCK_M, 0.5 * stands_m) / max(down, 1e-3), _NEAREST_M)
    limits = disparity_limits(rectified, min(nearest_m, farthest_m / 2), 2 * farthest_m)
    found = match(pictures[0][0], pictures[1][0], (pictures[0][1], pictures[1][1]), limits)
    depth = rectified.depth_m(found.disparity_px.astype(float))
    with np.errstate(invalid="ignore"):
        share = found.sigma_px * depth / (rectified.left.fx_px * rectified.baseline_m)
        known = (share < _FARTHEST_SHARE) & (depth < 2 * farthest_m) & ~_at_edges(found.disparity_px)
        depth = np.where(known, depth, np.nan)
    return Surface(
        pair=pair,
        world_T_point=(rays, rectified.world_t_left),
        depth_m=depth.astype(np.float32),
        sigma_m=(share * depth).astype(np.float32),
        disparity_px=found.disparity_px,
        grey=found.grey,
        focal_px=rectified.left.fx_px,
        stands_m=stands_m,
        tilt_sigma_rad=float(drive.own_tilt_sigma_rad[pair.frame]),
        shared=_shared(drive, pair),
    )


def _shared(drive: Drive, pair: Pair) -> SharedErrors | None:
    nodes = None if drive.stereo is None else drive.stereo.of(pair.left, pair.right)
    if drive.stereo is None or nodes is None:
        return None
    return SharedErrors(
        world_R_camera=drive.world_R_camera[pair.left],
        world_t_camera=drive.world_t_camera[pair.left],
        depth_m=drive.stereo.depth_m,
        nodes=nodes,
    )


def _at_edges(disparity_px: NDArray[np.float32]) -> BoolArray:
    """Which pixels (h, w) have an edge near them, across which disparities jump."""
    seen, square = np.isfinite(disparity_px), np.ones((_EDGE_PX, _EDGE_PX), np.uint8)
    most = cv2.dilate(np.where(seen, disparity_px, np.float32(-1e6)), square)
    least = cv2.erode(np.where(seen, disparity_px, np.float32(1e6)), square)
    return np.asarray(most - least > _EDGE_JUMP_PX)
