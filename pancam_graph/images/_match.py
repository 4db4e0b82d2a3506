"""Matching features of two images within the windows that the geometry leaves open."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.images._features import DESCRIPTOR_NORM, Features
from pancam_graph.images._options import FrontEndOptions
from pancam_graph.images._pairs import Segments

__all__ = ["Matches", "match_in_windows"]

_CELL_PX = 48.0
_SAME_PLACE_PX = 3.0
_SIZE_RATIO = 2.5
_NONE = np.float32(np.inf)


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
    best = np.full(len(features_a), -1, dtype=np.int64)
    best_d2 = np.full(len(features_a), _NONE)  # squared distances are whole numbers, exact in float32
    for_b = np.full(len(features_b), -1, dtype=np.int64)
    for_b_d2 = np.full(len(features_b), _NONE)
    limit = (options.max_descriptor_distance * DESCRIPTOR_NORM) ** 2
    by_v = np.argsort(features_b.uv_px[:, 1], kind="stable")
    sorted_v = features_b.uv_px[by_v, 1]
    d_a, d_b = (f.descriptor.astype(np.float32) for f in (features_a, features_b))
    norm_a, norm_b = np.sum(d_a * d_a, axis=1), np.sum(d_b * d_b, axis=1)
    for rows in _cells(segments):
        window = segments.select(rows)
        low, high = window.bounds_px()
        near = by_v[np.searchsorted(sorted_v, low[1]) : np.searchsorted(sorted_v, high[1], side="right")]
        near = np.sort(near[(features_b.uv_px[near, 0] >= low[0]) & (features_b.uv_px[near, 0] <= high[0])])
        if not len(near):
            continue
        allowed = window.reach(features_b.uv_px[near])
        size_ratio = (features_a.size_px[rows] * window.magnification)[:, None] / features_b.size_px[near]
        allowed &= (size_ratio < _SIZE_RATIO) & (size_ratio > 1 / _SIZE_RATIO)
        d2 = norm_a[rows, None] + norm_b[near] - 2 * (d_a[rows] @ d_b[near].T)
        d2[~allowed] = _NONE

        columns = np.arange(len(near))
        # Best of b for each of a; the second best must be at another place.
        first = d2.argmin(axis=1)
        at = np.arange(len(rows))
        d2_first = d2[at, first]
        uv = features_b.uv_px[near]
        apart = (np.abs(uv[:, 0] - uv[first, 0][:, None]) > _SAME_PLACE_PX) | (
            np.abs(uv[:, 1] - uv[first, 1][:, None]) > _SAME_PLACE_PX
        )
        d2_second = np.where(apart, d2, _NONE).min(axis=1)
        good = (d2_first <= limit) & (d2_first < options.ratio**2 * d2_second)
        best[rows[good]] = near[first[good]]
        best_d2[rows[good]] = d2_first[good]
        # Best of a for each of b, over all cells; good or not, it takes part in the mutual check.
        first_a = d2.argmin(axis=0)
        d2_a = d2[first_a, columns]
        row_a = rows[first_a]
        better = (d2_a < for_b_d2[near]) | ((d2_a == for_b_d2[near]) & (d2_a < _NONE) & (row_a < for_b[near]))
        for_b[near[better]] = row_a[better]
        for_b_d2[near[better]] = d2_a[better]
    found = np.flatnonzero(best >= 0)
    mutual = found[for_b[best[found]] == found]
    return Matches(a=mutual, b=best[mutual], distance=np.sqrt(best_d2[mutual]) / DESCRIPTOR_NORM)


def _cells(segments: Segments) -> list[IntArray]:
    """Rows of valid segments that start near each other, so that they share candidates."""
    valid = np.flatnonzero(segments.valid)
    if not len(valid):
        return []
    column, row = np.floor(segments.far_px[valid] / _CELL_PX).astype(np.int64).T
    order = np.lexsort((valid, column, row))
    changes = np.flatnonzero((np.diff(row[order]) != 0) | (np.diff(column[order]) != 0)) + 1
    return np.split(valid[order], changes)
