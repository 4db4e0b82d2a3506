"""Images resampled to the pixels of a mosaic."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.mosaic._placed import PlacedCamera, PlacedImage, Pointing
from pancam_graph.mosaic._projections import Ground, Projection
from pancam_graph.mosaic._surface import Surface

__all__ = ["STEP_PX", "Lattice", "Layer", "largest_gap", "warp"]

STEP_PX = 8
"""Distance of lattice points in pixels of a mosaic. Points of the lattice are projected, pixels between are
interpolated, which is accurate to some thousandths of a pixel."""

_GREATEST_LEVEL = 6
_EDGE_PX = 4
"""Width of the border of an image that is not drawn, pixels: raw frames are too bright or too dark there."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """One image at the pixels of a mosaic, in the box that it covers."""

    left_px: int
    top_px: int
    grey: NDArray[np.float32]
    valid: BoolArray
    """Where the image has data."""
    chosen: BoolArray
    """Where it has data that the user's mask does not cover."""
    radius_squared: NDArray[np.float16]
    """Squared distance from the middle of the image, in half diagonals: 1 in its corners."""

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns of the box in the mosaic."""
        height, width = self.grey.shape
        return slice(self.top_px, self.top_px + height), slice(self.left_px, self.left_px + width)


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattice:
    """World points at every eighth pixel of a mosaic, and in one column and one row beyond the last."""

    projection: Projection
    points_m: FloatArray
    """(rows, columns, 3) world points."""

    @staticmethod
    def over(projection: Projection, surface: Surface) -> "Lattice":
        """The lattice of a mosaic."""
        columns, rows = (n // STEP_PX + 2 for n in (projection.width_px, projection.height_px))
        column, row = np.meshgrid(STEP_PX * np.arange(columns), STEP_PX * np.arange(rows))
        points = projection.points_m(surface, column.ravel().astype(float), row.ravel().astype(float))
        return Lattice(projection=projection, points_m=points.reshape(rows, columns, 3))

    def seen_by(self, placed: PlacedCamera) -> tuple[NDArray[np.float32], BoolArray]:
        """Pixels (rows, columns, 2) of the lattice in a camera, NaN far from its image; and seen cells.

        Cells (rows - 1, columns - 1) count as seen if a corner of them is, or if the image could reach in.
        """
        rows, columns = self.points_m.shape[:2]
        pixels = np.full((rows * columns, 2), np.nan, dtype=np.float32)
        to_point = self.points_m.reshape(-1, 3) - placed.centre_m
        axis, half_rad = _cone(placed)
        range_m = np.maximum(np.linalg.norm(to_point, axis=1), 1e-9)
        near = np.flatnonzero(to_point @ axis > np.cos(min(half_rad, 3.0)) * range_m)
        uv, valid = placed.project(self.points_m.reshape(-1, 3)[near])
        pixels[near[valid]] = uv[valid]
        seen = np.zeros(rows * columns, dtype=bool)
        seen[near] = valid & placed.camera.contains(uv)
        grown = cv2.dilate(seen.reshape(rows, columns).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        cells = grown[:-1, :-1] | grown[1:, :-1] | grown[:-1, 1:] | grown[1:, 1:]
        return pixels.reshape(rows, columns, 2), cells


def _cone(placed: PlacedCamera) -> tuple[FloatArray, float]:
    """Axis (3,) in the world and half angle of a cone that holds a camera's field, with a margin."""
    camera = placed.camera
    right, bottom = camera.width_px - 1.0, camera.height_px - 1.0
    edge = np.array([[x, y] for x in (0, right / 2, right) for y in (0, bottom / 2, bottom)])
    ray = camera.unproject(edge).direction
    axis = ray[4]
    half = float(np.arccos(np.clip((ray @ axis).min(), -1.0, 1.0)))
    return placed.world_R_camera @ axis, 1.2 * half + np.deg2rad(2.0)


def largest_gap(covered: BoolArray) -> tuple[int, int]:
    """Start and length of the longest run of what is not covered (n,), which goes round; (0, 0) for none."""
    n = len(covered)
    if not covered.any():
        return 0, n
    ends = np.flatnonzero(covered)
    lengths = np.diff(np.append(ends, ends[0] + n)) - 1
    k = int(np.argmax(lengths))
    return ((int(ends[k]) + 1) % n, int(lengths[k])) if lengths[k] else (0, 0)


def warp(image: PlacedImage, pointing: Pointing, lattice: Lattice) -> list[Layer]:
    """An image in a mosaic: one layer, two where it lies across the ends of a closed one, or none.

    On the ground, what the user's mask covers is left out: it is taken not to be ground.
    """
    projection = lattice.projection
    pixels, cells = lattice.seen_by(image.at[pointing])
    rows = np.flatnonzero(cells.any(axis=1))
    if not len(rows):
        return []
    columns: BoolArray = np.any(cells, axis=0)
    runs = [(int(np.argmax(columns)), len(columns) - int(np.argmax(columns[::-1])))]
    start, gap = largest_gap(columns)
    if projection.closed and gap and start > 0 and start + gap < len(columns):
        runs = [(0, start), (start + gap, len(columns))]
    layers = []
    for first, last in runs:
        top, left = STEP_PX * int(rows[0]), STEP_PX * first
        height = min(STEP_PX * (int(rows[-1]) + 1), projection.height_px) - top
        width = min(STEP_PX * last, projection.width_px) - left
        if height < 1 or width < 1:
            continue
        part = pixels[rows[0] : rows[-1] + 2, first : last + 1]
        at_u, at_v = np.meshgrid(
            np.arange(width, dtype=np.float32) / STEP_PX, np.arange(height, dtype=np.float32) / STEP_PX
        )
        # Eighths are exact in the fixed-point fractions with which OpenCV interpolates.
        uv = cv2.remap(
            np.ascontiguousarray(part), at_u, at_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        layer = _sample(image, np.asarray(uv, dtype=np.float32), left, top)
        if isinstance(projection, Ground):
            layer = replace(layer, valid=layer.chosen)
        if layer.valid.any():
            layers.append(_trimmed(layer))
    return layers


def _trimmed(layer: Layer) -> Layer:
    """The layer cropped to the cells in which it has data."""
    kept = []
    for axis in (1, 0):
        filled = np.flatnonzero(layer.valid.any(axis=axis))
        first = int(filled[0]) // STEP_PX * STEP_PX
        kept.append(slice(first, int(filled[-1]) + 1))
    rows, columns = kept
    return Layer(
        left_px=layer.left_px + columns.start,
        top_px=layer.top_px + rows.start,
        grey=np.ascontiguousarray(layer.grey[rows, columns]),
        valid=np.ascontiguousarray(layer.valid[rows, columns]),
        chosen=np.ascontiguousarray(layer.chosen[rows, columns]),
        radius_squared=np.ascontiguousarray(layer.radius_squared[rows, columns]),
    )


def _sample(image: PlacedImage, uv: NDArray[np.float32], left_px: int, top_px: int) -> Layer:
    """The layer of an image at pixels (rows, columns, 2)."""
    height, width = image.grey.shape
    u, v = np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])
    inside = (u >= _EDGE_PX) & (u <= width - 1 - _EDGE_PX) & (v >= _EDGE_PX) & (v <= height - 1 - _EDGE_PX)
    u, v = np.where(inside, u, -1.0).astype(np.float32), np.where(inside, v, -1.0).astype(np.float32)
    flags = image.usable.astype(np.uint8) * (1 + image.wanted.astype(np.uint8))
    flag = cv2.remap(flags, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    valid, chosen = inside & (flag > 0), inside & (flag > 1)
    level = _levels(uv)
    grey = np.zeros(u.shape, dtype=np.float32)
    source: NDArray[Any] = image.grey.astype(np.float32)
    for k in range(_GREATEST_LEVEL + 1):
        rows, columns = (np.flatnonzero((valid & (level == k)).any(axis=a)) for a in (1, 0))
        if len(rows):
            part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            at = [(c[part] + np.float32(0.5)) / np.float32(2**k) - np.float32(0.5) for c in (u, v)]
            drawn = cv2.remap(source, at[0], at[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            grey[part] = np.where(level[part] == k, drawn, grey[part])
        if min(source.shape) < 2:
            break
        # Even sizes, so that a pixel of a coarser level is made of whole pixels of the finer one.
        padded = cv2.copyMakeBorder(
            source, 0, source.shape[0] % 2, 0, source.shape[1] % 2, cv2.BORDER_REPLICATE
        )
        source = cv2.resize(
            padded, (padded.shape[1] // 2, padded.shape[0] // 2), interpolation=cv2.INTER_AREA
        )
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    squared = ((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / float(middle @ middle)
    return Layer(
        left_px=left_px,
        top_px=top_px,
        grey=grey,
        valid=valid,
        chosen=chosen,
        radius_squared=squared.astype(np.float16),
    )


def _levels(uv: NDArray[np.float32]) -> NDArray[np.int8]:
    """How often the image must be halved so that no detail is lost between the pixels of the mosaic."""
    if min(uv.shape[:2]) < 2:
        return np.zeros(uv.shape[:2], dtype=np.int8)
    # Pixels of the image per pixel of the mosaic, along its finer direction: sharp rather than smooth.
    down, right = (np.hypot(*np.moveaxis(np.gradient(uv, axis=a), -1, 0)) for a in (0, 1))
    scale = np.nan_to_num(np.minimum(down, right), nan=1.0)
    level = np.clip(np.rint(np.log2(np.maximum(scale, 1.0))), 0, _GREATEST_LEVEL)
    return np.asarray(level, dtype=np.int8)
