"""The strongest features of a picture of which no pointing is known, and which of them look alike."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.images._features import DESCRIPTOR_NORM, describe, strongest
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._normalise import normalise

__all__ = ["StrongFeatures", "alike", "strong_features"]

_LONGEST_PX = 1400
"""Longer side to which larger pictures are reduced: a start needs no more."""
_MOST = 2500
_DIRECTIONS = 4
"""Gradient directions that one place may have."""
_SAME_PIXEL_PX = 1.5


@dataclass(frozen=True, kw_only=True, eq=False)
class StrongFeatures:
    """Features of one picture, strongest first, with descriptors turned to the gradient's direction."""

    uv_px: FloatArray
    """(n, 2) in the picture as it is stored."""
    descriptor: NDArray[np.float32]
    """(n, 128) square-rooted SIFT descriptors of length `DESCRIPTOR_NORM`."""
    siblings: IntArray
    """(n, 4) rows of the features at the same place with another direction, and of itself, repeated."""

    @staticmethod
    def none() -> "StrongFeatures":
        """No features."""
        return StrongFeatures(
            uv_px=np.empty((0, 2)),
            descriptor=np.empty((0, 128), dtype=np.float32),
            siblings=np.empty((0, _DIRECTIONS), dtype=np.int64),
        )

    def __len__(self) -> int:
        """Number of features."""
        return len(self.uv_px)

    def first(self, count: int) -> "StrongFeatures":
        """The strongest ones."""
        siblings = self.siblings[:count]
        own = np.arange(len(siblings))[:, None]
        return StrongFeatures(
            uv_px=self.uv_px[:count],
            descriptor=self.descriptor[:count],
            siblings=np.where(siblings < count, siblings, own),
        )


def strong_features(image: NDArray[Any], usable: BoolArray, options: FrontEndOptions) -> StrongFeatures:
    """The strongest features of an image (height, width), evenly over it, where it is `usable`.

    Returns none, never an error, for an image without texture.
    """
    scale = min(1.0, _LONGEST_PX / max(image.shape))
    grey = normalise(image, options.tile_px, options.max_contrast_gain)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]  # uint8 stays
        usable = cv2.resize(usable.astype(np.uint8), grey.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    sift: Any = cv2.SIFT.create(
        nfeatures=0, contrastThreshold=options.contrast_threshold, enable_precise_upscale=True
    )
    keypoints = sift.detect(grey, None)
    table = np.array([(k.pt[1], k.pt[0], k.size, k.response) for k in keypoints]).reshape(-1, 4)
    rows = strongest(table, usable, _MOST)
    place = {tuple(table[row, :3]): n for n, row in enumerate(rows[np.argsort(-table[rows, 3])])}
    chosen = [k for k, line in zip(keypoints, table, strict=True) if tuple(line[:3]) in place]
    chosen.sort(key=lambda k: place[k.pt[1], k.pt[0], k.size])
    kept, descriptor = describe(sift, grey, chosen)
    uv_px = np.array([k.pt for k in kept], dtype=float).reshape(-1, 2)
    _, of = np.unique(uv_px, axis=0, return_inverse=True)
    return StrongFeatures(
        uv_px=(uv_px + 0.5) / scale - 0.5,
        descriptor=descriptor.astype(np.float32),
        siblings=_siblings(of.ravel()),
    )


def _siblings(of: IntArray) -> IntArray:
    """Rows (n, 4) of equal numbers (n,); where there are fewer, the row itself fills the rest."""
    out = np.repeat(np.arange(len(of))[:, None], _DIRECTIONS, axis=1)
    order = np.argsort(of, kind="stable")
    bounds = [*np.flatnonzero(np.diff(of[order], prepend=-1)), len(of)]
    for begin, end in pairwise(bounds):
        rows = order[begin:end]
        out[rows, : min(len(rows), _DIRECTIONS)] = rows[:_DIRECTIONS]
    return out


def alike(a: StrongFeatures, b: StrongFeatures, options: FrontEndOptions) -> tuple[IntArray, IntArray]:
    """Rows of the features of a and of b that are each other's best, and better than any at another place.

    What stands at the same pixel in both is left out: dust on the lens and what is printed into pictures
    would say that the head had not turned.
    """
    if not len(a) or not len(b):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    likeness = a.descriptor @ b.descriptor.T
    rows = np.arange(len(a))
    best = likeness.argmax(axis=1)
    mutual = likeness[likeness.argmax(axis=0), np.arange(len(b))][best] == likeness[rows, best]
    nearest = likeness[rows, best]
    rows, best, nearest = rows[mutual], best[mutual], nearest[mutual]
    others = likeness[rows]
    np.put_along_axis(others, b.siblings[best], -np.inf, axis=1)
    second = others.max(axis=1)
    # Descriptors are rounded: their own lengths differ a little from the norm.
    length_a = np.einsum("ni,ni->n", a.descriptor, a.descriptor)[rows]
    length_b = np.einsum("ni,ni->n", b.descriptor, b.descriptor)[best]
    d2 = np.maximum(length_a + length_b - 2 * nearest, 0)
    second_d2 = np.maximum(length_a + DESCRIPTOR_NORM**2 - 2 * second, 0)
    good = (d2 < options.ratio**2 * second_d2) & (
        d2 < (options.max_descriptor_distance * DESCRIPTOR_NORM) ** 2
    )
    good &= np.linalg.norm(a.uv_px[rows] - b.uv_px[best], axis=1) > _SAME_PIXEL_PX
    rows, best = rows[good], best[good]
    _, first = np.unique(np.round(np.column_stack([a.uv_px[rows], b.uv_px[best]])), axis=0, return_index=True)
    return rows[first], best[first]
