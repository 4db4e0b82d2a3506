"""Where images show the rover itself: it stands still relative to the mast while the rover drives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray, wrap_angle
from pancam_graph.data import Traverse
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._pairs import MAX_ZOOM, PairGeometry, Relative, move_pixels

__all__ = ["find_rover", "rover_partners"]

_SAME_POINTING_RAD = np.deg2rad(1.0)
_MAX_PARTNERS = 3
_DECK_DISTANCE_M = 2.0
_WORKING_PX = 512
_COARSER = 2
_WINDOW_PX = 15
_HIGH_PASS_PX = 6.0
_ALIKE = 0.75
_TEXTURE = 2.0
_HALF_STEP = 0.3
_MIN_WINDOWS = 4.0
_BRIDGED_PX = 15
_EDGE_PX = 3
_GRID = 17
_DEPTHS = 8
_EYE_HEIGHTS_M = (0.8, 3.0)
_FARTHEST_M = 60.0
_LOWEST_HORIZON_RAD = np.deg2rad(3.0)

_Moves = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Windows:
    """An image (height, width) with its smooth part taken out, and the contrast in a window at each pixel."""

    detail: NDArray[np.float32]
    mean: NDArray[np.float32]
    spread: NDArray[np.float32]
    """Standard deviation in each pixel's window; infinite where that is hardly more than noise."""

    @staticmethod
    def of(grey: NDArray[np.float32]) -> "_Windows":
        # Vignetting and haze look alike in all images: the smooth part is taken out.
        detail = grey - cv2.GaussianBlur(grey, (0, 0), _HIGH_PASS_PX)
        mean = _window_mean(detail)
        spread = np.sqrt(np.maximum(_window_mean(detail * detail) - mean**2, 0.0))
        shown = np.where(spread > _TEXTURE * _noise(grey), spread, np.float32(np.inf))
        return _Windows(detail=detail, mean=mean, spread=shown)

    def padded(self, margin: int) -> "_Windows":
        """This image with an empty margin on all sides."""
        detail, mean = (np.pad(x, margin) for x in (self.detail, self.mean))
        shown = np.pad(self.spread, margin, constant_values=np.float32(np.inf))
        return _Windows(detail=detail, mean=mean, spread=shown)


def _window_mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.blur(values, (_WINDOW_PX, _WINDOW_PX)))


def rover_partners(traverse: Traverse, row: int, *, available: BoolArray) -> list[int]:
    """Rows of a few images of other stops in which the same eye looks the same way, nearest stops first.

    `available` (images,) says which images may be used.
    """
    angles = traverse.pan_tilt_rad[traverse.image_frame]
    pan, tilt = wrap_angle(angles[:, 0] - angles[row, 0]), angles[:, 1] - angles[row, 1]
    alike = np.hypot(pan * np.cos(angles[row, 1]), tilt) < _SAME_POINTING_RAD
    alike &= available & (traverse.image_eye == traverse.image_eye[row])
    alike &= traverse.image_stop != traverse.image_stop[row]
    rows = np.flatnonzero(alike)
    away = np.abs(traverse.image_stop[rows] - traverse.image_stop[row])
    return [int(r) for r in rows[np.lexsort((rows, away))][:_MAX_PARTNERS]]


def find_rover(
    traverse: Traverse,
    row: int,
    image: NDArray[Any],
    samples: Callable[[int], NDArray[Any]],
    partners: Sequence[int],
    options: FrontEndOptions,
) -> BoolArray:
    """Which pixels of an image (height, width) show the rover, its shadow, or dust on the lens.

    `samples` gives the samples of partners by row. Each partner (see `rover_partners`) is laid over the image
    as if the rover had not moved. Where the two then look alike, window by window, what they show moved
    along. No pixel is called rover where terrain would look alike too: within 3 degrees of the horizontal and
    above, and where ground 0.8 to 3 m below the eye would hardly move in the image between the two stops.
    """
    rover = np.zeros(image.shape, dtype=bool)
    for partner in partners:
        pair = PairGeometry(traverse, row, partner, options.mount_sigma_rad)
        rover |= _standing_still(pair, image, samples(partner), options)
    return rover


def _standing_still(
    pair: PairGeometry, image_a: NDArray[Any], image_b: NDArray[Any], options: FrontEndOptions
) -> BoolArray:
    decided, reach_px, map_u, map_v = _prediction(pair, image_a.shape, options)
    if not decided.any():
        return np.zeros(image_a.shape, dtype=bool)
    scale = min(1.0, _WORKING_PX / max(image_a.shape))
    laid_over = cv2.remap(image_b.astype(np.float32), map_u, map_v, cv2.INTER_LINEAR)
    size = (round(scale * image_a.shape[1]), round(scale * image_a.shape[0]))
    greys = [_resized(x.astype(np.float32), size) for x in (image_a, laid_over)]
    there = cv2.resize(decided.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    # An error of pointing shifts the rover as a whole: the shift is found in small images, then refined.
    small = (max(1, size[0] // _COARSER), max(1, size[1] // _COARSER))
    coarse_a, coarse_b = (_Windows.of(_resized(x, small)) for x in greys)
    there_small = cv2.resize(there.astype(np.uint8), small, interpolation=cv2.INTER_NEAREST) > 0
    radius = int(np.ceil(reach_px * scale / _COARSER))
    shift = _best_shift(coarse_a, coarse_b.padded(radius), there_small, (0, 0), radius)
    a, b = (_Windows.of(x) for x in greys)
    b = b.padded(_COARSER * (radius + 1) + 1)
    shift = _best_shift(a, b, there, (_COARSER * shift[0], _COARSER * shift[1]), _COARSER)
    alike = np.zeros(there.shape, dtype=bool)
    for du in (-1, 0, 1):
        for dv in (-1, 0, 1):
            alike |= _correlation(a, b, (shift[0] + du, shift[1] + dv)) > _ALIKE
    region = _tidied((alike & there).astype(np.uint8))
    full = cv2.resize(region, image_a.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return np.asarray(full & decided)


def _prediction(
    pair: PairGeometry, shape: tuple[int, ...], options: FrontEndOptions
) -> tuple[BoolArray, float, NDArray[np.float32], NDArray[np.float32]]:
    """Where terrain would move visibly, the pointing's error in pixels, and where b would show the deck.

    The two maps (height, width) have the pixel of b for each pixel of a: u, v.
    """
    height, width = shape
    v, u = np.meshgrid(np.linspace(0, height - 1, _GRID), np.linspace(0, width - 1, _GRID), indexing="ij")
    uv_px = np.column_stack([u.ravel(), v.ravel()])
    rays = pair.camera_a.unproject(uv_px)
    fixed = replace(pair, rover_fixed=True)
    b_T_a, d_b_T_a = (
        fixed.b_T_a(fixed.no_correction),
        fixed.d_b_T_a(fixed.no_correction, np.diag(fixed.sigma)),
    )
    deck = rays.origin_m + _DECK_DISTANCE_M * rays.direction
    on_b, _ = fixed.transfer(deck, b_T_a)
    spread = _spread_px(fixed, deck, b_T_a, d_b_T_a)
    reach_px = options.search_sigmas * float(np.median(spread)) + 1.0
    pixel_rad = float(
        np.median(_angle_rad(pair.camera_a.unproject(uv_px + np.array([1.0, 0.0])).direction, rays.direction))
    )

    down = -pair.elevation_rad(uv_px)
    decided = rays.valid & (down > _LOWEST_HORIZON_RAD)
    nearest, farthest = (np.minimum(h / np.sin(np.maximum(down, 1e-2)), _FARTHEST_M) for h in _EYE_HEIGHTS_M)
    world, d_world = pair.b_T_a(pair.no_correction), pair.d_b_T_a(pair.no_correction, np.diag(pair.sigma))
    for share in np.linspace(0, 1, _DEPTHS):
        depth = nearest ** (1 - share) * farthest**share
        points = rays.origin_m + depth[:, None] * rays.direction
        terrain, rover = world.of(points), b_T_a.of(points)
        zoom = np.linalg.norm(terrain, axis=1) / depth
        alike = (zoom < MAX_ZOOM) & (zoom > 1 / MAX_ZOOM)
        least = 2 * reach_px * pixel_rad + options.search_sigmas / 2 * _spread_rad(points, terrain, d_world)
        decided &= ~(alike & (_angle_rad(terrain, rover) < least))
    grid_v, grid_u = np.mgrid[:height, :width].astype(np.float32)
    at = grid_u * ((_GRID - 1) / (width - 1)), grid_v * ((_GRID - 1) / (height - 1))

    def spread_out(values: FloatArray) -> NDArray[np.float32]:
        nodes = values.reshape(_GRID, _GRID).astype(np.float32)
        return np.asarray(cv2.remap(nodes, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    map_u, map_v = spread_out(on_b[:, 0]), spread_out(on_b[:, 1])
    return spread_out(decided.astype(float)) > 1 - 1e-3, reach_px, map_u, map_v


def _spread_px(pair: PairGeometry, points_m: FloatArray, b_T_a: Relative, d_b_T_a: _Moves) -> FloatArray:
    """Standard deviation (n,) of the pixels in b of points (n, 3) in the frame of camera a."""
    _, d_uv, _ = pair.camera_b.project_with_jacobian(b_T_a.of(points_m))
    return np.asarray(np.sqrt(np.sum(move_pixels(points_m, d_uv, d_b_T_a) ** 2, axis=(1, 2))))


def _spread_rad(points_m: FloatArray, from_b: FloatArray, d_b_T_a: _Moves) -> FloatArray:
    """Standard deviation (n,) of the directions in which b sees points (n, 3), also outside its field."""
    d_R, d_t = d_b_T_a
    moved = points_m @ np.swapaxes(d_R, 1, 2) + d_t[:, None]
    range_m = np.maximum(np.linalg.norm(from_b, axis=1), 1e-3)
    return np.asarray(np.sqrt(np.sum(moved**2, axis=(0, 2))) / range_m)


def _angle_rad(a: FloatArray, b: FloatArray) -> FloatArray:
    cross, dot = np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ni,ni->n", a, b)
    return np.asarray(np.arctan2(cross, dot))


def _resized(grey: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _best_shift(
    a: _Windows, b: _Windows, there: BoolArray, around: tuple[int, int], radius: int
) -> tuple[int, int]:
    """The shift of b, whole pixels, that makes most of it look like a; the smallest of equals."""
    offsets = sorted(
        ((u, v) for u in range(-radius, radius + 1) for v in range(-radius, radius + 1)),
        key=lambda s: (s[0] ** 2 + s[1] ** 2, s),
    )
    shifts = [(around[0] + u, around[1] + v) for u, v in offsets]
    return max(shifts, key=lambda s: int(np.count_nonzero((_correlation(a, b, s) > _ALIKE) & there)))


def _correlation(a: _Windows, b: _Windows, shift: tuple[int, int]) -> NDArray[np.float32]:
    """Correlation of each window of a with that of b, moved; 0 where either shows nothing.

    b is `padded`, by at least as much as it is moved.
    """
    height, width = a.detail.shape
    margin_v, margin_u = ((n - m) // 2 for n, m in zip(b.detail.shape, a.detail.shape, strict=True))
    top, left = margin_v - shift[1], margin_u - shift[0]
    detail, mean, spread = (x[top : top + height, left : left + width] for x in (b.detail, b.mean, b.spread))
    return np.asarray((_window_mean(a.detail * detail) - a.mean * mean) / (a.spread * spread))


def _noise(grey: NDArray[np.float32]) -> float:
    """Standard deviation of the noise, from the quietest tenth of the image."""
    change = cv2.blur(np.abs(np.diff(grey, axis=1)), (_WINDOW_PX, _WINDOW_PX))
    return max(float(np.quantile(change, 0.1)) / 1.128, _HALF_STEP)


def _tidied(region: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The region without specks, with gaps on smooth parts and holes closed, and a little wider."""
    bridge = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_BRIDGED_PX, _BRIDGED_PX))
    padded = np.pad(region, _BRIDGED_PX, mode="edge")
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, bridge)
    closed = np.ascontiguousarray(closed[_BRIDGED_PX:-_BRIDGED_PX, _BRIDGED_PX:-_BRIDGED_PX])
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=4)
    large = stats[:count, cv2.CC_STAT_AREA] >= _MIN_WINDOWS * _WINDOW_PX**2
    large[0] = False
    kept = large[labels].astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(1 - kept, connectivity=4)
    left, top, wide, tall = stats[:count, :4].T
    inner = (left > 0) & (top > 0) & (left + wide < region.shape[1]) & (top + tall < region.shape[0])
    inner[0] = False  # the region itself
    kept |= inner[labels].astype(np.uint8)
    return np.asarray(cv2.dilate(kept, np.ones((2 * _EDGE_PX + 1,) * 2, np.uint8)))
