"""Matching features of two images within the windows that the geometry leaves open."""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.compiled import entry
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.images._features import DESCRIPTOR_NORM, Features
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._pairs import Segments

__all__ = ["Matches", "beyond_chance", "match_in_windows"]

Descriptors: TypeAlias = NDArray[np.uint8]

_CELL_PX = 16.0
_SAME_PLACE_PX = 3.0
_SIZE_RATIO = 2.5
_NONE = np.int64(np.iinfo(np.int64).max)
_CHANCE_SIGMAS = 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Matches:
    """Pairs of features, one to one, sorted by the feature of a."""

    a: IntArray
    """(n,) row in the features of image a."""
    b: IntArray
    """(n,) row in the features of image b."""
    distance: FloatArray
    """(n,) distance of the descriptors, which have unit length."""

    @staticmethod
    def none() -> "Matches":
        """No matches."""
        empty = np.empty(0, dtype=np.int64)
        return Matches(a=empty, b=empty, distance=np.empty(0))

    def __len__(self) -> int:
        """Number of matches."""
        return len(self.a)

    def select(self, rows: BoolArray | IntArray) -> "Matches":
        """Some of the matches."""
        return Matches(a=self.a[rows], b=self.b[rows], distance=self.distance[rows])


def match_in_windows(
    features_a: Features, features_b: Features, segments: Segments, options: FrontEndOptions
) -> Matches:
    """Features of a and b that are each other's best within the windows (one per feature of a).

    The best must be closer than `options.ratio` times the second best, where there is one at another
    place of the same window. Equal distances go to the feature listed first.
    """
    rows = np.flatnonzero(segments.valid)
    if not len(rows) or not len(features_b):
        return Matches.none()
    corner, shape, order, begin = _gridded(features_b.uv_px)
    best, best_d2 = np.full(len(features_a), -1, dtype=np.int64), np.zeros(len(features_a), dtype=np.int64)
    for_b = np.full(len(features_b), -1, dtype=np.int64)
    limit = (options.max_descriptor_distance * DESCRIPTOR_NORM) ** 2
    _search(
        rows,
        (segments.far_px, segments.near_px, segments.far_radius_px, segments.near_radius_px),
        features_a.size_px * segments.magnification,
        features_a.descriptor,
        features_b.uv_px[order],
        features_b.size_px[order],
        features_b.descriptor[order],
        order,
        corner,
        shape,
        begin,
        limit,
        options.ratio**2,
        best,
        best_d2,
        for_b,
    )
    matched = np.flatnonzero(best >= 0)
    mutual = matched[for_b[best[matched]] == matched]
    return Matches(a=mutual, b=best[mutual], distance=np.sqrt(best_d2[mutual]) / DESCRIPTOR_NORM)


def beyond_chance(agrees: BoolArray, chance: FloatArray, options: FrontEndOptions) -> bool:
    """Whether more matches (n,) agree than by chance; `chance` (n,) is that of each wrong match to agree."""
    expected, spread = float(chance.sum()), float(np.sqrt(np.sum(chance * (1 - chance))))
    least = max(options.min_pair_matches, expected + _CHANCE_SIGMAS * spread)
    return bool(np.count_nonzero(agrees) >= least)


def _gridded(uv_px: FloatArray) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
    """Pixels by cells of a grid: its corner (2,), its columns and rows, the order, where each cell begins."""
    corner = uv_px.min(axis=0)
    column, row = np.floor((uv_px - corner) / _CELL_PX).astype(np.int64).T
    shape = np.array([column.max() + 1, row.max() + 1])
    cell = row * shape[0] + column
    order = np.argsort(cell, kind="stable")
    return corner, shape, order, np.searchsorted(cell[order], np.arange(shape[0] * shape[1] + 1))


@entry
def _search(
    rows: IntArray,
    windows: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    size_a: FloatArray,
    descriptor_a: Descriptors,
    uv_b: FloatArray,
    size_b: FloatArray,
    descriptor_b: Descriptors,
    name_b: IntArray,
    corner: FloatArray,
    shape: IntArray,
    begin: IntArray,
    limit: float,
    ratio2: float,
    best: IntArray,
    best_d2: IntArray,
    for_b: IntArray,
) -> None:
    """The best feature of b for each of the `rows` of a, if it is good, and the best of a for each of b.

    `windows` are those of `Segments`, `size_a` the sizes of a's features as b should show them. Features of b
    are sorted by cell (see `_gridded`), and `name_b` gives their rows before that.
    """
    far, near, far_radius, near_radius = windows
    inside, d2_inside = np.empty(len(uv_b), dtype=np.int64), np.empty(len(uv_b), dtype=np.int64)
    for_b_d2 = np.full(len(uv_b), _NONE)
    for a in rows:
        u, v = far[a]
        along_u, along_v = near[a, 0] - u, near[a, 1] - v
        length2 = max(along_u * along_u + along_v * along_v, 1e-12)
        r0, r1 = far_radius[a], near_radius[a]
        left = math.floor((min(u - r0, u + along_u - r1) - corner[0]) / _CELL_PX)
        right = math.floor((max(u + r0, u + along_u + r1) - corner[0]) / _CELL_PX)
        top = math.floor((min(v - r0, v + along_v - r1) - corner[1]) / _CELL_PX)
        bottom = math.floor((max(v + r0, v + along_v + r1) - corner[1]) / _CELL_PX)
        left, right = max(left, 0), min(right, shape[0] - 1)
        if left > right:
            continue
        count, first, first_d2 = 0, -1, _NONE
        for row in range(max(top, 0), min(bottom, shape[1] - 1) + 1):
            for b in range(begin[row * shape[0] + left], begin[row * shape[0] + right + 1]):
                du, dv = uv_b[b, 0] - u, uv_b[b, 1] - v
                t = min(max((du * along_u + dv * along_v) / length2, 0.0), 1.0)
                du, dv = du - t * along_u, dv - t * along_v
                radius = r0 + t * (r1 - r0)
                if du * du + dv * dv > radius * radius:
                    continue
                size_ratio = size_a[a] / size_b[b]
                if not 1 / _SIZE_RATIO < size_ratio < _SIZE_RATIO:
                    continue
                # 32 bits throughout: the compiler then computes with vectors.
                total = np.int32(0)
                for k in range(descriptor_a.shape[1]):
                    change = np.int32(np.int32(descriptor_a[a, k]) - np.int32(descriptor_b[b, k]))
                    total = np.int32(total + np.int32(change * change))
                d2 = np.int64(total)
                inside[count], d2_inside[count] = b, d2
                count += 1
                if d2 < first_d2 or (d2 == first_d2 and name_b[b] < name_b[first]):
                    first, first_d2 = b, d2
                if d2 < for_b_d2[b]:
                    for_b_d2[b], for_b[name_b[b]] = d2, a
        if first < 0 or first_d2 > limit:
            continue
        second_d2 = _NONE
        for i in range(count):
            b = inside[i]
            if (
                abs(uv_b[b, 0] - uv_b[first, 0]) > _SAME_PLACE_PX
                or abs(uv_b[b, 1] - uv_b[first, 1]) > _SAME_PLACE_PX
            ):
                second_d2 = min(second_d2, d2_inside[i])
        if second_d2 == _NONE or first_d2 < ratio2 * second_d2:
            best[a], best_d2[a] = name_b[first], first_d2
