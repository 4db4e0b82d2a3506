"""Disparities of a rectified pair: semi-global matching, then slanted windows."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.base.splines import spline_taps
from pancam_graph.base.threads import in_parallel
from pancam_graph.terrain import kernel
from pancam_graph.terrain._rectify import Rectified

__all__ = ["Match", "disparity_limits", "match", "rectified_picture", "refined", "roughness"]

_BLUR_PX = 0.3
"""Blur of what slanted windows compare: more of it hides the detail that says most, and with none the noise
between pixels differs from that at pixels."""
_WIDEST_START_PX = 1100
"""Widest picture in which semi-global matching works; a wider one is made smaller for it."""
_BLOCK_PX = 5
_MARGIN_PX = 3
_AGREE_PX = 1.5
"""By how much the disparities that each picture finds in the other may differ."""
_PER_SPREAD, _PER_ROUGHNESS, _LEAST_SIGMA_PX = 0.64, 1.2, 0.02
"""Standard deviation of a disparity over the spread of its windows, over the roughness around it, and what is
added to both in squares: from rendered images with truth (docs/terrain.md)."""
_ROUGH_PX = 4
"""Pixels to each side over which roughness is taken: windows have 3, their neighbours' centres one more."""
_GRAIN = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class Match:
    """Disparities of the left picture's pixels."""

    disparity_px: NDArray[np.float32]
    """(height, width); NaN where none was found."""
    sigma_px: NDArray[np.float32]
    """(height, width) standard deviation."""
    grey: NDArray[np.float32]
    """(height, width) samples of the left picture."""


def rectified_picture(
    picture: NDArray[Any], usable: BoolArray, uv_px: FloatArray
) -> tuple[NDArray[np.float32], BoolArray]:
    """A picture at pixels (h, w, 2), by its cubic spline, and where windows of it are usable there."""
    taps = spline_taps(0.0)
    spline: Any = cv2.sepFilter2D(
        picture.astype(np.float32), cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101
    )
    out = np.empty(uv_px.shape[:2], dtype=np.float32)
    uv_px = np.ascontiguousarray(uv_px)
    in_parallel(lambda a, b: kernel.resample(a, b, spline, uv_px, out), len(out), grain=_GRAIN)
    column, row = (np.nan_to_num(np.rint(uv_px[..., k]), nan=-1).astype(np.int64) for k in (0, 1))
    inside = (column >= 0) & (row >= 0)
    there = inside & usable[np.clip(row, 0, usable.shape[0] - 1), np.clip(column, 0, usable.shape[1] - 1)]
    # A window across the edge of a picture compares with nothing on one side.
    square = np.ones((2 * _MARGIN_PX + 1,) * 2, np.uint8)
    inner = cv2.erode(there.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return out, np.asarray(inner > 0)


def match(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    there: tuple[BoolArray, BoolArray],
    disparities: tuple[float, float],
) -> Match:
    """Disparities of a pair of rectified pictures (h, w), within limits.

    `there` says which pixels of each picture show terrain. Pixels of the left that the right one does not see
    have none: what each finds in the other must agree.
    """
    start = _started(left, right, there, disparities)
    disparity, spread = refined(left, right, start)
    u = np.arange(left.shape[1], dtype=np.float32)[None] - disparity
    at = np.rint(np.nan_to_num(u, nan=-1)).astype(np.int64)
    inside = (at >= 0) & (at < left.shape[1])
    seen = there[0] & inside & np.take_along_axis(there[1], np.where(inside, at, 0), axis=1)
    disparity = np.where(seen, disparity, np.float32(np.nan))
    rough = roughness(disparity)
    sigma = np.sqrt((_PER_SPREAD * spread) ** 2 + (_PER_ROUGHNESS * rough) ** 2 + _LEAST_SIGMA_PX**2)
    return Match(disparity_px=disparity, sigma_px=sigma.astype(np.float32), grey=left)


def roughness(disparity_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """Root mean square (h, w) of disparities about a plane through those of the square around each pixel.

    A window takes the surface for a plane: what it misses errs as the surface bends. Of pixels without a
    disparity, and outside, nothing counts; slopes along rows and columns are fitted each for itself.
    """
    r = _ROUGH_PX
    along, flat = np.arange(-r, r + 1.0), np.ones(2 * r + 1)
    seen = np.isfinite(disparity_px)
    weight = seen.astype(np.float64)
    middle = float(np.median(disparity_px[seen])) if seen.any() else 0.0
    # About a value in their midst, so that squares lose no digits.
    value = np.where(seen, disparity_px - middle, 0.0)

    def summed(values: FloatArray, across: FloatArray, down: FloatArray) -> FloatArray:
        return np.asarray(cv2.sepFilter2D(values, cv2.CV_64F, across, down, borderType=cv2.BORDER_CONSTANT))

    n = np.maximum(summed(weight, flat, flat), 1.0)
    mean = summed(value, flat, flat) / n
    variance = summed(value**2, flat, flat) / n - mean**2
    for across, down in ((along, flat), (flat, along)):
        place = summed(weight, across, down) / n
        spread = np.maximum(summed(weight, across**2, down**2) / n - place**2, 1e-9)
        variance -= (summed(value, across, down) / n - place * mean) ** 2 / spread
    return np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)


def _started(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    there: tuple[BoolArray, BoolArray],
    disparities: tuple[float, float],
) -> NDArray[np.float32]:
    """Disparities by semi-global matching (Hirschmueller 2008); NaN where none was found."""
    height, width = left.shape
    smaller = -(-width // _WIDEST_START_PX)
    low = int(np.floor(disparities[0] / smaller)) - 1
    count = -(-(int(np.ceil(disparities[1] / smaller)) - low + 1) // 16) * 16
    dark, bright = (
        (float(q) for q in np.quantile(left[there[0]], (0.002, 0.998))) if there[0].any() else (0.0, 1.0)
    )
    small = []
    for picture in (left, right):
        scaled = np.clip((picture - dark) * (255 / max(bright - dark, 1e-6)), 0, 255).astype(np.uint8)
        if smaller > 1:
            size = -(-width // smaller), -(-height // smaller)
            scaled = cv2.resize(scaled, size, interpolation=cv2.INTER_AREA)
        small.append(scaled)
    # Beside the picture there is room for the disparities of its outer columns.
    before, behind = max(low + count, 0), max(-low, 0)
    create: Any = cv2.StereoSGBM.create
    matcher = create(
        minDisparity=low,
        numDisparities=count,
        blockSize=_BLOCK_PX,
        P1=8 * _BLOCK_PX**2,
        P2=32 * _BLOCK_PX**2,
        uniquenessRatio=5,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )

    def sought(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.float32]:
        wide = (cv2.copyMakeBorder(p, 0, 0, before, behind, cv2.BORDER_REPLICATE) for p in (first, second))
        found = matcher.compute(*wide)[:, before : before + first.shape[1]].astype(np.float32) / 16
        return np.where(found >= low, found, np.float32(np.nan))

    start = sought(*small)
    # Mirrored, the right picture is the one that looks for its pixels in the other.
    back = sought(*(np.ascontiguousarray(p[:, ::-1]) for p in small[::-1]))[:, ::-1]
    column = np.arange(start.shape[1]) - np.nan_to_num(start)
    at = np.clip(np.rint(column), 0, start.shape[1] - 1).astype(np.int64)
    agree = np.abs(np.take_along_axis(back, at, axis=1) - start) <= _AGREE_PX
    start = np.where(agree, start, np.float32(np.nan))
    if smaller > 1:
        start = cv2.resize(smaller * start, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.where(there[0], start, np.float32(np.nan)).astype(np.float32)


def refined(
    left: NDArray[np.float32], right: NDArray[np.float32], start_px: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Disparities (h, w) from a start that is right within a pixel, and their spread; see `refine_rows`."""
    taps, both = spline_taps(_BLUR_PX), np.array([1, 4, 1]) / 6
    splines: list[Any] = [
        cv2.sepFilter2D(p.astype(np.float32), cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101)
        for p in (left, right)
    ]
    own: Any = cv2.sepFilter2D(splines[0], cv2.CV_32F, both, both, borderType=cv2.BORDER_REFLECT_101)
    rows = cv2.sepFilter2D(splines[1], cv2.CV_32F, np.ones(1), both, borderType=cv2.BORDER_REFLECT_101)
    padded = np.pad(rows, ((0, 0), (1, 2)), mode="reflect")
    finer = np.empty((*left.shape, kernel.FINER), dtype=np.float32)
    for k in range(kernel.FINER):
        x = k / kernel.FINER
        weights = (
            (1 - x) ** 3 / 6,
            2 / 3 - x * x + x**3 / 2,
            2 / 3 - (1 - x) ** 2 + (1 - x) ** 3 / 2,
            x**3 / 6,
        )
        finer[..., k] = sum(np.float32(a) * padded[:, n : n + left.shape[1]] for n, a in enumerate(weights))
    finer = finer.reshape(left.shape[0], -1)
    disparity, spread = (np.empty(left.shape, dtype=np.float32) for _ in range(2))
    start_px = np.ascontiguousarray(start_px, dtype=np.float32)
    in_parallel(
        lambda a, b: kernel.refine_rows(a, b, own, finer, start_px, disparity, spread),
        len(left),
        grain=_GRAIN,
    )
    return disparity, spread


def disparity_limits(rectified: Rectified, nearest_m: float, farthest_m: float) -> tuple[float, float]:
    """Disparities of the nearest and of the farthest depth, the smaller first."""
    per_m = rectified.left.fx_px * rectified.baseline_m
    return rectified.shift_px + per_m / farthest_m, rectified.shift_px + per_m / nearest_m
