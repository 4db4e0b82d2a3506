"""From layers to one picture: equal brightness, seams where they are least visible, and soft transitions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.images import Evening, Small, even_out
from pancam_graph.mosaic._warp import Layer

__all__ = ["Look", "blend", "choose_look"]

_SEAM_PIXELS = 1.5e6
"""Seams are sought in layers shrunk until they have about this many pixels together."""
_DARK, _BRIGHT = 0.003, 0.997
"""Shares of the pixels that become the darkest and the brightest of 8 bits."""
_BANDS = 7
_LEVELS = 12000.0
"""Value of the brightest sample in the blender's 16-bit integers; the rest of their range is for
differences."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """What two mosaics must share to be compared: the image that each pixel is taken from, and brightness."""

    labels: NDArray[np.int32]
    """(rows, columns) number of the image that is shown; -1 where there is none."""
    evening: Evening
    """How images are made equally bright."""
    dark: float
    bright: float
    """Brightness, after gains and vignetting, that becomes 1 and 255 in 8 bits."""
    brightest: float
    """The greatest brightness in any layer."""

    def to_8_bits(self, samples: NDArray[np.float32]) -> NDArray[np.uint8]:
        """A blended mosaic (rows, columns) in 8 bits: from dark to bright, 0 where there is none."""
        scale = np.float32(254.0 / (self.bright - self.dark))
        grey = np.clip(np.rint(1 + (samples - np.float32(self.dark)) * scale), 1, 255)
        return np.asarray(np.where(np.isnan(samples), 0, np.nan_to_num(grey)), dtype=np.uint8)


def choose_look(
    layers: Sequence[tuple[int, Layer]], height_px: int, width_px: int, evening: Evening | None = None
) -> Look:
    """Evening, seams and contrast for the layers of a mosaic, each with the number of its image.

    Gains and vignetting are estimated in overlaps, unless they are given. Seams are those of least difference
    (graph cut, Kwatra and others 2003, OpenCV's finder), sought in shrunken layers.
    """
    area = sum(layer.grey.size for _, layer in layers)
    shrink = 1
    while area / shrink**2 > _SEAM_PIXELS and shrink < 8:
        shrink *= 2
    brightest = max(float(np.quantile(_some(layer.grey, layer.valid), 0.999)) for _, layer in layers)
    small = [_small(number, layer, shrink, 250.0 / max(brightest, 1e-6)) for number, layer in layers]
    evening = evening or even_out(small)
    labels = _labels(layers, small, evening, (height_px, width_px))
    shown = np.concatenate(
        [_some(_evened(n, layer, evening), layer.valid & (labels[layer.box] == n)) for n, layer in layers]
    )
    dark, bright = np.quantile(shown, [_DARK, _BRIGHT]) if len(shown) else (0.0, 1.0)
    most = max(float(_evened(n, layer, evening).max(initial=0)) for n, layer in layers)
    return Look(
        labels=labels,
        evening=evening,
        dark=float(dark),
        bright=float(max(bright, dark + 1e-6)),
        brightest=max(most, 1e-6),
    )


def _some(grey: NDArray[np.float32], wanted: NDArray[np.bool_]) -> FloatArray:
    """Brightness of some pixels, every fourth of every fourth row."""
    return np.asarray(grey[::4, ::4][wanted[::4, ::4]], dtype=np.float64)


def _small(number: int, layer: Layer, shrink: int, scale: float) -> Small:
    """A layer, `shrink` times smaller, its brightness multiplied with `scale`."""
    height, width = (-(-n // shrink) for n in layer.grey.shape)
    pad = (0, height * shrink - layer.grey.shape[0], 0, width * shrink - layer.grey.shape[1])
    bands = []
    for band, border in (
        (layer.grey * np.float32(scale), cv2.BORDER_REPLICATE),
        (layer.chosen.astype(np.float32), cv2.BORDER_CONSTANT),
        (layer.radius_squared.astype(np.float32), cv2.BORDER_REPLICATE),
    ):
        padded = cv2.copyMakeBorder(band, *pad, border)
        bands.append(cv2.resize(padded, (width, height), interpolation=cv2.INTER_AREA))
    grey, chosen, radius_squared = (np.asarray(b, dtype=np.float32) for b in bands)
    return Small(
        number=number,
        left_px=layer.left_px // shrink,
        top_px=layer.top_px // shrink,
        grey=grey,
        chosen=np.asarray(chosen > 1 - 1e-4),
        radius_squared=radius_squared,
    )


def _evened(number: int, layer: Layer, evening: Evening) -> NDArray[np.float32]:
    return np.asarray(layer.grey * evening.factor(number, layer.radius_squared), dtype=np.float32)


def _labels(
    layers: Sequence[tuple[int, Layer]], small: Sequence[Small], evening: Evening, size: tuple[int, int]
) -> NDArray[np.int32]:
    finder: Any = cv2.detail.GraphCutSeamFinder("COST_COLOR_GRAD")
    even = [cv2.merge([s.grey * evening.factor(s.number, s.radius_squared)] * 3) for s in small]
    corners = [(s.left_px, s.top_px) for s in small]
    masks = finder.find(even, corners, [s.chosen.astype(np.uint8) * np.uint8(255) for s in small])
    labels = np.full(size, -1, dtype=np.int32)
    for (number, layer), mask in zip(layers, masks, strict=True):
        height, width = layer.grey.shape
        coarse = mask.get() if hasattr(mask, "get") else mask
        factor = -(-height // coarse.shape[0])
        full = cv2.resize(
            coarse, (coarse.shape[1] * factor, coarse.shape[0] * factor), interpolation=cv2.INTER_LINEAR
        )
        labels[layer.box][(full[:height, :width] > 127) & layer.chosen] = number
    return _filled(labels, layers)


def _filled(labels: NDArray[np.int32], layers: Sequence[tuple[int, Layer]]) -> NDArray[np.int32]:
    """Labels in which every covered pixel has the number of a layer that covers it.

    A pixel that a user's mask covers is taken from that image only where no other image is.
    """
    out = labels.copy()
    there = np.zeros(labels.shape, dtype=bool)
    for number, layer in layers:
        there[layer.box] |= layer.valid & (labels[layer.box] == number)
    out[~there] = -1
    for chosen_only in (True, False):
        for number, layer in layers:
            part = out[layer.box]
            part[(layer.chosen if chosen_only else layer.valid) & (part < 0)] = number
    return np.asarray(out)


def blend(layers: Sequence[tuple[int, Layer]], look: Look) -> NDArray[np.float32]:
    """The mosaic (rows, columns) of layers, samples after gains and vignetting; NaN where there is none.

    Coarse detail is blended over wide transitions, fine detail over narrow ones (multi-band: Burt and Adelson
    1983, OpenCV's blender). Where a layer does not reach the seam that `look` gives it, another layer is
    taken.
    """
    labels = _filled(look.labels, layers)
    height, width = labels.shape
    blender: Any = cv2.detail.MultiBandBlender(0, _BANDS)
    blender.prepare((0, 0, width, height))
    scale = _LEVELS / look.brightest
    for number, layer in layers:
        mask = (layer.valid & (labels[layer.box] == number)).astype(np.uint8) * np.uint8(255)
        if not mask.any():
            continue
        grey = _evened(number, layer, look.evening) * np.float32(scale)
        fine = np.clip(np.rint(grey), 0, _LEVELS).astype(np.int16)
        # A layer is continued beyond its edge with its value there: else it would be blended with black.
        blender.feed(cv2.merge([_continued(fine, layer.valid)] * 3), mask, (layer.left_px, layer.top_px))
    picture, _ = blender.blend(None, None)
    samples = np.maximum(picture[:, :, 0], 0).astype(np.float32) / np.float32(scale)
    return np.asarray(np.where(labels >= 0, samples, np.float32(np.nan)), dtype=np.float32)


def _continued(grey: NDArray[np.int16], valid: NDArray[np.bool_]) -> NDArray[np.int16]:
    """Brightness, filled with that of the nearest valid pixel where there is none."""
    if valid.all():
        return grey
    _, nearest = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    value = np.zeros(int(nearest.max()) + 1, dtype=np.int16)
    value[nearest[valid]] = grey[valid]
    return np.asarray(value[nearest])
