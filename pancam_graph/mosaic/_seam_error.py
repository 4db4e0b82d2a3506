"""How well the images of a mosaic agree where they overlap: displacements of windows, in pixels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.mosaic._phase import WINDOW_PX, Displacements, displacements
from pancam_graph.mosaic._placed import POINTINGS, PlacedImage, Pointing
from pancam_graph.mosaic._projections import Cylinder
from pancam_graph.mosaic._surface import Surface
from pancam_graph.mosaic._warp import STEP_PX, Lattice, Layer, largest_gap, warp

__all__ = ["CASES", "Case", "Overlap", "SeamError", "native_px_per_degree", "seam_error"]

Case = Literal["telemetry", "telemetry_own_surface", "refined"]
CASES: tuple[Case, ...] = ("telemetry", "telemetry_own_surface", "refined")
"""`telemetry`: telemetry's pointing on the surface that the adjusted landmarks span, as mosaics are drawn.
`telemetry_own_surface`: the same pointing on the surface of landmarks that were triangulated with it, the
best that telemetry can do by itself. `refined`: the refined pointing on the adjusted surface."""

_STRIDE_PX = WINDOW_PX // 2
_MAX_WINDOWS = 600
_MAX_SIDE_PX = 4096
_GREATEST_SIGMA_PX = 0.1
"""Largest formal sigma of a window's displacement, pixels; a window above it has too little texture."""
_LEAST_COHERENCE = 0.5
"""Least coherence of a window; below it the two images differ by more than a shift (a shadow that moved, a
near thing before a far one)."""
_DRAWN: tuple[tuple[Case, Pointing, Pointing], ...] = (
    ("telemetry", "telemetry", "refined"),
    ("telemetry_own_surface", "telemetry", "telemetry"),
    ("refined", "refined", "refined"),
)
"""Each case with its pointing, and the pointing whose landmarks span its surface."""
_BLOCK = 128
_CLOSE_UP_PX = (168, 112)
"""Width and height of a close-up, pixels."""
_DETAIL_PX = 12.0
_STEEPEST_DEG = 65.0
"""Above and below, columns of a panorama converge too fast for windows to keep their shape."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Overlap:
    """Two images that overlap, and how far apart they show the same texture."""

    images: tuple[str, str]
    """Ids of the two images."""
    azimuth_deg: FloatArray
    """(n,) azimuth of the middle of each used window."""
    elevation_deg: FloatArray
    """(n,) elevation of the middle of each used window."""
    shift_px: dict[Case, FloatArray]
    """(n, 2) by which the second image is displaced in each window, right and down, in pixels of the images
    at their centre."""
    windows: int
    """Windows of 64 pixels that both images fill."""
    plain: int
    """Of these, left out for too little texture."""
    unlike: int
    """Of these, left out because the images differ by more than a shift."""
    close_up: dict[Pointing, NDArray[np.uint8]]
    """Where texture is sharpest, the first image in red and the second in green and blue, (rows, columns,
    3): grey where they agree. Empty without used windows."""

    def median_px(self, case: Case) -> float:
        """Median displacement of the used windows; NaN for none."""
        return _median(self.shift_px[case])


@dataclass(frozen=True, kw_only=True, eq=False)
class SeamError:
    """The overlaps of a mosaic."""

    overlaps: tuple[Overlap, ...]

    @property
    def used(self) -> int:
        """Windows used, of all overlaps."""
        return sum(len(o.azimuth_deg) for o in self.overlaps)

    def median_px(self, case: Case) -> float:
        """Median displacement of the used windows of all overlaps; NaN for none."""
        return _median(np.concatenate([np.empty((0, 2)), *(o.shift_px[case] for o in self.overlaps)]))


def _median(shift_px: FloatArray) -> float:
    return float(np.median(np.hypot(*shift_px.T))) if len(shift_px) else float("nan")


def native_px_per_degree(images: Sequence[PlacedImage]) -> float:
    """Pixels per degree at the centre of the images of one eye."""
    camera = images[0].at["telemetry"].camera
    centre = 0.5 * np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    ray = camera.unproject(centre + np.array([[0.0, -0.5], [0.0, 0.5]])).direction
    return float(1 / np.rad2deg(np.linalg.norm(ray[1] - ray[0])))


def seam_error(
    images: Sequence[PlacedImage], surfaces: dict[Pointing, Surface], overview: Lattice, px_per_degree: float
) -> SeamError:
    """Displacements in all overlaps of the images of a panorama.

    Each overlap is drawn from both images at the scale of the images. The windows are the same in all cases:
    those that both images fill, with texture enough to tell displacements to 0.1 px and nothing but a shift
    between the images, in every case. `surfaces` are those that each pointing's own landmarks span,
    `overview` is the lattice of a cylinder with the whole panorama.
    """
    cylinder = overview.projection
    assert isinstance(cylinder, Cylinder)
    seen = [overview.seen_by(image.at["refined"])[1] for image in images]
    overlaps = []
    for i, first in enumerate(images):
        for j in range(i + 1, len(images)):
            both = seen[i] & seen[j]
            if both.any():
                around = _around(cylinder, both, px_per_degree)
                overlap = _overlap(first, images[j], surfaces, around)
                if overlap is not None:
                    overlaps.append(overlap)
    return SeamError(overlaps=tuple(overlaps))


def _around(overview: Cylinder, cells: BoolArray, px_per_degree: float) -> Cylinder:
    """The cylinder that holds cells (rows, columns) of another's lattice, at another scale."""
    rows, columns = np.flatnonzero(np.any(cells, axis=1)), np.any(cells, axis=0)
    if overview.closed:  # the lattice of a mosaic goes one cell beyond its last column
        columns = columns[: overview.width_px // STEP_PX]
        start, gap = largest_gap(columns)
        first, count = (start + gap) % len(columns), len(columns) - gap
    else:
        first = int(np.argmax(columns))
        count = len(columns) - int(np.argmax(columns[::-1])) - first
    cell_deg = STEP_PX / overview.px_per_degree
    width, height = (
        min(max(2, round(n * cell_deg * px_per_degree)), _MAX_SIDE_PX)
        for n in (count, int(rows[-1]) + 1 - int(rows[0]))
    )
    return Cylinder(
        origin_m=overview.origin_m,
        width_px=width,
        height_px=height,
        px_per_degree=px_per_degree,
        left_deg=overview.left_deg - first * cell_deg,
        top_deg=overview.top_deg - float(rows[0]) * cell_deg,
    )


def _overlap(
    first: PlacedImage, second: PlacedImage, surfaces: dict[Pointing, Surface], around: Cylinder
) -> Overlap | None:
    """Displacements between two images, in all cases; None where no window fits."""
    lattice = {p: Lattice.over(around, surface) for p, surface in surfaces.items()}
    drawn: dict[Case, tuple[_Canvas, _Canvas]] = {
        case: (
            _Canvas.of(warp(first, pointing, lattice[ground]), around),
            _Canvas.of(warp(second, pointing, lattice[ground]), around),
        )
        for case, pointing, ground in _DRAWN
    }
    common: BoolArray = np.all([canvas.valid for pair in drawn.values() for canvas in pair], axis=0)
    at = _windows(common, around)
    if not len(at):
        return None
    measured = {case: _displaced(*pair, at) for case, pair in drawn.items()}
    sure: BoolArray = np.all([m.sigma_px < _GREATEST_SIGMA_PX for m in measured.values()], axis=0)
    alike: BoolArray = np.all([m.coherence > _LEAST_COHERENCE for m in measured.values()], axis=0)
    good = sure & alike
    middle: FloatArray = at[good].astype(float) + 0.5 * (WINDOW_PX - 1)
    elevation_deg = around.elevation_deg(middle[:, 1])
    level = np.column_stack([np.cos(np.deg2rad(elevation_deg)), np.ones(len(middle))])
    close_up: dict[Pointing, NDArray[np.uint8]] = {}
    if good.any():
        sharpest = middle[np.argmin(measured["refined"].sigma_px[good])]
        close_up = {p: _close_up(*drawn[p], common, sharpest) for p in POINTINGS}
    return Overlap(
        images=(first.id, second.id),
        azimuth_deg=around.azimuth_deg(middle[:, 0]),
        elevation_deg=elevation_deg,
        shift_px={case: m.shift_px[good] * level for case, m in measured.items()},
        windows=len(at),
        plain=int(np.sum(alike & ~sure)),
        unlike=int(np.sum(~alike)),
        close_up=close_up,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Canvas:
    """One image over a whole cylinder."""

    grey: NDArray[np.float32]
    valid: BoolArray

    @staticmethod
    def of(layers: list[Layer], around: Cylinder) -> "_Canvas":
        grey = np.zeros((around.height_px, around.width_px), dtype=np.float32)
        valid = np.zeros(grey.shape, dtype=bool)
        for layer in layers:
            grey[layer.box] = np.where(layer.valid, layer.grey, grey[layer.box])
            valid[layer.box] |= layer.valid
        return _Canvas(grey=grey, valid=valid)


def _close_up(first: _Canvas, second: _Canvas, common: BoolArray, middle: FloatArray) -> NDArray[np.uint8]:
    """A piece of two images, one in red, the other in green and blue."""
    corner = []
    for centre, size, length in zip(middle, common.shape[::-1], _CLOSE_UP_PX, strict=True):
        corner.append(int(np.clip(round(centre - length / 2), 0, max(size - length, 0))))
    part = slice(corner[1], corner[1] + _CLOSE_UP_PX[1]), slice(corner[0], corner[0] + _CLOSE_UP_PX[0])
    shown = common[part]
    channels = []
    for canvas in (first, second):
        # Only detail is compared: unequal exposure and vignetting would colour the whole picture.
        weight = cv2.GaussianBlur(shown.astype(np.float32), (0, 0), _DETAIL_PX)
        smooth = cv2.GaussianBlur(np.where(shown, canvas.grey[part], 0), (0, 0), _DETAIL_PX)
        detail = canvas.grey[part] - smooth / np.maximum(weight, 1e-6)
        spread = 2.5 * max(float(np.std(detail[shown])), 1e-6)
        channels.append(np.where(shown, np.clip(120 + 120 * detail / spread, 0, 255), 235).astype(np.uint8))
    return np.stack([channels[0], channels[1], channels[1]], axis=-1)


def _windows(common: BoolArray, around: Cylinder) -> IntArray:
    """Columns and rows (n, 2) of the corners of windows in which all is valid, evenly thinned if too many."""
    height, width = common.shape
    filled = np.pad(np.cumsum(np.cumsum(common, axis=0), axis=1), ((1, 0), (1, 0)))
    row, column = (np.arange(0, n - WINDOW_PX + 1, _STRIDE_PX, dtype=np.int64) for n in (height, width))
    v, u = (a.ravel() for a in np.meshgrid(row, column, indexing="ij"))
    steep = np.abs(around.elevation_deg(v + 0.5 * (WINDOW_PX - 1))) > _STEEPEST_DEG
    end_v, end_u = v + WINDOW_PX, u + WINDOW_PX
    area = filled[end_v, end_u] - filled[v, end_u] - filled[end_v, u] + filled[v, u]
    at = np.column_stack([u, v])[(area == WINDOW_PX**2) & ~steep]
    return np.asarray(at[:: max(1, -(-len(at) // _MAX_WINDOWS))])


def _displaced(first: _Canvas, second: _Canvas, at: IntArray) -> Displacements:
    # In blocks, so that not all windows are in memory as complex numbers at once.
    parts = []
    for block in np.array_split(at, max(1, -(-len(at) // _BLOCK))):
        cut = [
            np.stack([c.grey[v : v + WINDOW_PX, u : u + WINDOW_PX] for u, v in block.tolist()])
            for c in (first, second)
        ]
        parts.append(displacements(*cut))
    return Displacements(
        **{n: np.concatenate([getattr(p, n) for p in parts]) for n in ("shift_px", "sigma_px", "coherence")}
    )
