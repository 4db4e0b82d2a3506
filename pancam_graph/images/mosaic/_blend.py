"""From layers to one picture: equal exposures, seams where they show least, and soft transitions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.geometry import FloatArray
from pancam_graph.images.mosaic._warp import Layer

__all__ = ["Look", "blend", "choose_look"]

_SEAM_PIXELS = 1.5e6
"""Seams are sought in layers shrunk until they have about this many pixels together."""
_DARK, _BRIGHT = 0.003, 0.997
"""Shares of the pixels that become the darkest and the brightest of 8 bits."""
_BANDS = 7
_NO_GAIN = 1.0
"""How many pixels of an overlap the prior for a gain of 1 counts as much as."""
_LEAST_COMMON = 50
"""Pixels, in shrunken layers, from which an overlap tells a ratio of brightness."""
_FINE = 16.0
"""Steps of the blender's integers per step of 8 bits."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """What two mosaics must share to be compared: whose pixels are taken where, and how bright they are."""

    labels: NDArray[np.int32]
    """(rows, columns) number of the image that is shown; -1 where there is none."""
    gain: dict[int, float]
    """By image, what its brightness is multiplied with."""
    dark: float
    bright: float
    """Brightness, gains included, that becomes 1 and 255."""


def choose_look(layers: Sequence[tuple[int, Layer]], height_px: int, width_px: int) -> Look:
    """Gains, seams and contrast for the layers of a mosaic, each with the number of its image.

    Gains make overlaps equally bright; seams are those of least difference (graph cut, Kwatra and others
    2003, OpenCV's finder), sought in shrunken layers.
    """
    area = sum(layer.grey.size for _, layer in layers)
    shrink = 1
    while area / shrink**2 > _SEAM_PIXELS and shrink < 8:
        shrink *= 2
    brightest = max(float(np.quantile(_some(layer), 0.999)) for _, layer in layers)
    small = [_shrunk(layer, shrink, 250.0 / max(brightest, 1e-6)) for _, layer in layers]
    corners = [(layer.left_px // shrink, layer.top_px // shrink) for _, layer in layers]
    gain = _gains(layers, small, corners)
    labels = _labels(layers, small, corners, gain, (height_px, width_px))
    shown = np.concatenate([gain[n] * _some(layer, labels[layer.box] == n) for n, layer in layers])
    dark, bright = np.quantile(shown, [_DARK, _BRIGHT]) if len(shown) else (0.0, 1.0)
    return Look(labels=labels, gain=gain, dark=float(dark), bright=float(max(bright, dark + 1e-6)))


def _some(layer: Layer, wanted: NDArray[np.bool_] | None = None) -> FloatArray:
    """Brightness of valid pixels of a layer, every fourth of every fourth row."""
    chosen = layer.valid if wanted is None else layer.valid & wanted
    return np.asarray(layer.grey[::4, ::4][chosen[::4, ::4]], dtype=np.float64)


def _shrunk(layer: Layer, shrink: int, scale: float) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Brightness in 8 bits and mask of a layer at a fraction of its size."""
    height, width = (-(-n // shrink) for n in layer.grey.shape)
    grey = np.clip(layer.grey * np.float32(scale), 0, 255).astype(np.uint8)
    mask = layer.valid.astype(np.uint8) * np.uint8(255)
    if shrink > 1:
        pad = (0, height * shrink - grey.shape[0], 0, width * shrink - grey.shape[1])
        grey, mask = (
            cv2.resize(cv2.copyMakeBorder(a, *pad, border), (width, height), interpolation=cv2.INTER_AREA)
            for a, border in ((grey, cv2.BORDER_REPLICATE), (mask, cv2.BORDER_CONSTANT))
        )
    return grey, ((mask == 255) * np.uint8(255)).astype(np.uint8)


def _gains(
    layers: Sequence[tuple[int, Layer]],
    small: Sequence[tuple[NDArray[np.uint8], NDArray[np.uint8]]],
    corners: Sequence[tuple[int, int]],
) -> dict[int, float]:
    """Gains, by image: least squares on the logarithms of brightness ratios in all overlaps.

    OpenCV's compensator has a fixed prior for gains of 1, which leaves a tenth of a real change of exposure.
    """
    numbers = sorted({number for number, _ in layers})
    row = {number: k for k, number in enumerate(numbers)}
    # Groups of images without overlap keep gains about 1.
    normal, right = _NO_GAIN * np.eye(len(numbers)), np.zeros(len(numbers))
    for a, (first, _) in enumerate(layers):
        for b in range(a + 1, len(layers)):
            second = layers[b][0]
            cut = _common(small[a][0].shape, corners[a], small[b][0].shape, corners[b])
            if first == second or cut is None:
                continue
            both = (small[a][1][cut[0]] > 0) & (small[b][1][cut[1]] > 0)
            if np.count_nonzero(both) < _LEAST_COMMON:
                continue
            sums = [
                float(grey[part][both].sum(dtype=np.float64))
                for (grey, _), part in zip((small[a], small[b]), cut, strict=True)
            ]
            ratio = np.log(max(sums[1], 1.0) / max(sums[0], 1.0))
            weight = float(np.count_nonzero(both))
            i, j = row[first], row[second]
            normal[[i, j], [i, j]] += weight
            normal[[i, j], [j, i]] -= weight
            right[i] += weight * ratio
            right[j] -= weight * ratio
    return dict(zip(numbers, np.exp(np.linalg.solve(normal, right)).tolist(), strict=True))


def _common(
    shape_a: tuple[int, ...], corner_a: tuple[int, int], shape_b: tuple[int, ...], corner_b: tuple[int, int]
) -> tuple[tuple[slice, slice], tuple[slice, slice]] | None:
    """What two boxes share, as slices of each; None for nothing. Corners are columns and rows."""
    low = np.maximum(corner_a, corner_b)
    high = np.minimum(np.add(corner_a, shape_a[::-1]), np.add(corner_b, shape_b[::-1]))
    if np.any(high <= low):
        return None
    parts = []
    for corner in (corner_a, corner_b):
        (u0, v0), (u1, v1) = (low - corner).tolist(), (high - corner).tolist()
        parts.append((slice(v0, v1), slice(u0, u1)))
    return parts[0], parts[1]


def _labels(
    layers: Sequence[tuple[int, Layer]],
    small: Sequence[tuple[NDArray[np.uint8], NDArray[np.uint8]]],
    corners: Sequence[tuple[int, int]],
    gain: dict[int, float],
    size: tuple[int, int],
) -> NDArray[np.int32]:
    finder: Any = cv2.detail.GraphCutSeamFinder("COST_COLOR_GRAD")
    even = [
        cv2.merge([(grey * gain[number]).astype(np.float32)] * 3)
        for (number, _), (grey, _) in zip(layers, small, strict=True)
    ]
    masks = finder.find(even, corners, [mask.copy() for _, mask in small])
    labels = np.full(size, -1, dtype=np.int32)
    for (number, layer), mask in zip(layers, masks, strict=True):
        height, width = layer.grey.shape
        coarse = mask.get() if hasattr(mask, "get") else mask
        factor = -(-height // coarse.shape[0])
        full = cv2.resize(
            coarse, (coarse.shape[1] * factor, coarse.shape[0] * factor), interpolation=cv2.INTER_LINEAR
        )
        labels[layer.box][(full[:height, :width] > 127) & layer.valid] = number
    return _filled(labels, layers)


def _filled(labels: NDArray[np.int32], layers: Sequence[tuple[int, Layer]]) -> NDArray[np.int32]:
    """Labels in which whatever a layer covers has one, and no pixel one of an image that is not there."""
    out = labels.copy()
    there = np.zeros(labels.shape, dtype=bool)
    for number, layer in layers:
        there[layer.box] |= layer.valid & (labels[layer.box] == number)
    out[~there] = -1
    for number, layer in layers:
        part = out[layer.box]
        part[layer.valid & (part < 0)] = number
    return np.asarray(out)


def blend(layers: Sequence[tuple[int, Layer]], look: Look) -> NDArray[np.uint8]:
    """The mosaic (rows, columns) of layers in 8 bits; 0 where there is none.

    Transitions are as wide as what they blend is coarse (multi-band: Burt and Adelson 1983, OpenCV's
    blender). Where a layer does not reach the seam that `look` has for it, another one is taken.
    """
    labels = _filled(look.labels, layers)
    height, width = labels.shape
    blender: Any = cv2.detail.MultiBandBlender(0, _BANDS)
    blender.prepare((0, 0, width, height))
    scale = 254.0 / (look.bright - look.dark)
    for number, layer in layers:
        mask = (layer.valid & (labels[layer.box] == number)).astype(np.uint8) * np.uint8(255)
        if not mask.any():
            continue
        grey = 1.0 + (layer.grey * np.float32(look.gain[number]) - look.dark) * scale
        fine = np.clip(np.rint(grey * _FINE), -(2**14), 2**14).astype(np.int16)
        # Beyond its edge a layer goes on as at its edge, or the transition would be towards black.
        blender.feed(cv2.merge([_continued(fine, layer.valid)] * 3), mask, (layer.left_px, layer.top_px))
    picture, _ = blender.blend(None, None)
    grey8 = np.clip(np.rint(picture[:, :, 0] / _FINE), 1, 255).astype(np.uint8)
    return np.asarray(np.where(labels >= 0, grey8, 0), dtype=np.uint8)


def _continued(grey: NDArray[np.int16], valid: NDArray[np.bool_]) -> NDArray[np.int16]:
    """Brightness with that of the nearest valid pixel where there is none."""
    if valid.all():
        return grey
    _, nearest = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    value = np.zeros(int(nearest.max()) + 1, dtype=np.int16)
    value[nearest[valid]] = grey[valid]
    return np.asarray(value[nearest])
