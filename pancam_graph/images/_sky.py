"""Which pixels of an image show only sky."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray

__all__ = ["find_sky"]

_BLOCK_PX = 16
_SEED_BLUR_PX = 2.0
_SEED_RAD = np.deg2rad(0.5)
_NOISE_RATIO = 1.7
_HALF_STEP = 0.3
_EDGE_BLUR_PX = 4.0
_EDGE = 3.0
_LOWEST_RAD = np.deg2rad(-10.0)
_SPECK = 1e-3
_NEIGHBOURS_PX = 31


def find_sky(image: NDArray[Any], elevation_rad: FloatArray) -> BoolArray:
    """Which pixels of an image (height, width) are sky, to some ten pixels above the skyline.

    `elevation_rad` (height, width) is each pixel's angle above the horizontal, by telemetry. It says only
    where sky may be, for a slope may rise above the horizontal and a valley's far rim lie below. Sky begins
    where the image shows no more structure than its noise, and goes from there down each column to the first
    edge: hills beyond the skyline stay, however smooth. Specks (hot pixels, cosmic rays) belong to the sky
    around them; clouds with structure count as terrain.
    """
    if not (elevation_rad > _SEED_RAD).any():
        return np.zeros(image.shape, dtype=bool)
    grey = image.astype(np.float32)
    gradient = np.hypot(*_gradient(grey, _EDGE_BLUR_PX))
    seeds, level = _seeds(grey, elevation_rad, gradient)
    if not seeds.any():
        return np.zeros(image.shape, dtype=bool)
    plain = _filled((gradient < _EDGE * level).astype(np.uint8), round(_SPECK * grey.size))
    plain &= elevation_rad > _LOWEST_RAD
    # Sky ends at the first edge from above. A column in which that edge is weak ends where its neighbours do.
    down = np.where(plain.all(axis=0), len(plain), plain.argmin(axis=0)).astype(np.float32)
    down = cv2.erode(down[None], np.ones((1, _NEIGHBOURS_PX), np.uint8))[0]
    reached = np.arange(len(plain))[:, None] < down
    _, labels = cv2.connectedComponents((plain & reached).astype(np.uint8), connectivity=4)
    # On a smooth slope above the horizontal few blocks are as quiet as noise.
    above, count = elevation_rad > _SEED_RAD, int(labels.max()) + 1
    quiet = 2 * np.bincount(labels[seeds & above], minlength=count)
    is_sky = quiet > np.maximum(np.bincount(labels[above], minlength=count), 1)
    is_sky[0] = False
    return np.asarray(is_sky[labels])


def _seeds(
    grey: NDArray[np.float32], elevation_rad: FloatArray, gradient: NDArray[Any]
) -> tuple[BoolArray, float]:
    """Pixels of blocks above the horizontal without structure, and the `gradient` (height, width) there."""
    high = _blocks(elevation_rad).min(axis=2) > _SEED_RAD
    change = np.abs(np.diff(grey, axis=1, append=grey[:, -2:-1]))
    noise = np.maximum(_blocks(change)[high].mean(axis=1) / 1.128, _HALF_STEP)
    du, dv = (_blocks(g)[high] for g in _gradient(grey, _SEED_BLUR_PX))
    # Skies brighten towards the horizon and lenses darken towards the corners: a gradient is no structure.
    slopeless = np.hypot(du - du.mean(axis=1, keepdims=True), dv - dv.mean(axis=1, keepdims=True))
    # The median gradient that white noise has.
    expected = 1.177 * noise / (np.sqrt(8 * np.pi) * _SEED_BLUR_PX**2)
    quiet = np.zeros_like(high)
    quiet[high] = np.median(slopeless, axis=1) < _NOISE_RATIO * expected
    if not quiet.any():
        return np.zeros(grey.shape, dtype=bool), 0.0
    level = float(np.median(np.median(_blocks(gradient)[quiet], axis=1)))
    seeds = np.zeros(grey.shape, dtype=bool)
    whole = np.kron(quiet, np.ones((_BLOCK_PX, _BLOCK_PX), dtype=bool))[: grey.shape[0], : grey.shape[1]]
    seeds[: whole.shape[0], : whole.shape[1]] = whole
    return seeds, level


def _gradient(grey: NDArray[np.float32], blur_px: float) -> tuple[NDArray[Any], NDArray[Any]]:
    blurred = cv2.GaussianBlur(grey, (0, 0), blur_px)
    du, dv = (cv2.Sobel(blurred, cv2.CV_32F, x, 1 - x, ksize=3, scale=1 / 8) for x in (1, 0))
    return du, dv


def _filled(region: NDArray[np.uint8], largest_px: int) -> BoolArray:
    """The region with those holes that are small, and away from the image's border."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(1 - region, connectivity=4)
    height, width = region.shape
    left, top, wide, tall, area = stats[:count].T
    inner = (left > 0) & (top > 0) & (left + wide < width) & (top + tall < height)
    hole = inner & (area <= largest_px)
    hole[0] = False  # the region itself
    return np.asarray((region > 0) | hole[labels])


def _blocks(values: NDArray[Any]) -> NDArray[Any]:
    """Whole blocks of an image, (rows of blocks, columns of blocks, pixels); one block of a smaller image."""
    tall, wide = (max(1, n // _BLOCK_PX) for n in values.shape)
    high, broad = min(_BLOCK_PX, values.shape[0]), min(_BLOCK_PX, values.shape[1])
    blocks = values[: tall * high, : wide * broad].reshape(tall, high, wide, broad)
    return np.asarray(blocks.transpose(0, 2, 1, 3).reshape(tall, wide, -1))
