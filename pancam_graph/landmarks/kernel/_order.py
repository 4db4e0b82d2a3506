"""Observations in the order of elimination, cameras at a point of linearisation, landmarks eliminated."""

from typing import NamedTuple

import numpy as np

from pancam_graph.base.compiled import entry
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray

__all__ = ["Bearings", "Reduced", "Sights", "arrange"]


class Sights(NamedTuple):
    """Observations of landmarks in the order of elimination; structure that no step changes.

    An *occurrence* is one unit (images moved alike by all variables) that sees a landmark. Columns of a block
    come in *pairs*, each segment beginning with one. A landmark touches some pairs, ascending; `place` says
    which of them each segment of an occurrence's chain begins with.
    """

    image: IntArray
    """(n,)"""
    uv_px: FloatArray
    """(n, 2)"""
    whitening: FloatArray
    """(n, 2, 2)"""
    occurrence_begin: IntArray
    """(occurrences + 1,) first observation of each"""
    occurrence_unit: IntArray
    """(occurrences,)"""
    occurrence_row: IntArray
    """(occurrences,) the unit's row among those of its block"""
    place_begin: IntArray
    """(occurrences + 1,) first entry in `place` of each"""
    place: IntArray
    landmark_begin: IntArray
    """(landmarks + 1,) first occurrence of each"""
    pair_begin: IntArray
    """(landmarks + 1,) first pair of each"""
    pair: IntArray
    """(pairs,) number of the pair in the block"""


class Bearings(NamedTuple):
    """Cameras at one linearisation point, and how they move with the variables."""

    to_pixel: FloatArray
    """(images, 3, 3) world directions to homogeneous pixels"""
    centre_m: FloatArray
    """(images, 3)"""
    calibration: FloatArray
    """(images, 3, 3) K"""
    unit_R: FloatArray
    """(units, 3, 3) world_R_base: the body whose twist moves the unit's images"""
    unit_t: FloatArray
    """(units, 3)"""
    segment_begin: IntArray
    """(units + 1,)"""
    segment_width: IntArray
    """(segments,) columns of each"""
    plain: BoolArray
    """(segments,) whether the chain is the unit matrix: the variable's tangent is the base's twist"""
    chain: FloatArray
    """(segments, rows, widest): takes a variable's tangent to the base's twist (6 rows, rotation first), and
    where calibrations are free to changes of fx, fy, skew, cx, cy (5 more)"""


class Reduced(NamedTuple):
    """What is left of landmarks after elimination, by landmark."""

    factor: FloatArray
    """(landmarks, 6) lower Cholesky factor of V by rows"""
    gamma: FloatArray
    """(landmarks, 3) L^-1 g"""
    arms: FloatArray
    """(6 pairs,) L^-1 E' of each landmark: three rows of two columns for each pair"""
    cost: FloatArray
    """(landmarks,) true robust cost"""
    undetermined: BoolArray
    """(landmarks,) whether the weak prior alone holds a direction"""


@entry
def arrange(
    landmarks: IntArray,
    begin: IntArray,
    image: IntArray,
    image_unit: IntArray,
    segment_begin: IntArray,
    segment_pairs: IntArray,
    segment_pair: IntArray,
    n_pairs: int,
    first_landmark: int,
    rows: IntArray,
    sights: Sights,
    cursor: IntArray,
) -> int:
    """Put a block's landmarks into the order of elimination; returns how many units see them.

    `landmarks` (m,) are rows in measurements whose observations of landmark j are begin[j] to begin[j + 1].
    Fills `rows` (n,), the measurement of each observation, and the structure of `sights` from where `cursor`
    (observations, occurrences, places, pairs) stands, and moves the cursor on.
    """
    unit_row = np.full(len(segment_begin) - 1, -1)
    place_of = np.full(n_pairs, -1)
    starts = np.empty(n_pairs, dtype=np.int64)
    n_units = 0
    n_obs, n_occurrences, n_places, n_touched = cursor[0], cursor[1], cursor[2], cursor[3]
    for m in range(len(landmarks)):
        j, first_occurrence = landmarks[m], n_occurrences
        first_obs, last_obs = n_obs, n_obs + begin[j + 1] - begin[j]
        for i in range(begin[j], begin[j + 1]):  # sorted by unit as they come
            unit, k = image_unit[image[i]], n_obs
            while k > first_obs and image_unit[sights.image[k - 1]] > unit:
                sights.image[k], rows[k] = sights.image[k - 1], rows[k - 1]
                k -= 1
            sights.image[k], rows[k] = image[i], i
            n_obs += 1
        n_starts, before = 0, -1
        for i in range(first_obs, last_obs):
            unit = image_unit[sights.image[i]]
            if unit == before:
                continue
            before = unit
            if unit_row[unit] < 0:
                unit_row[unit] = n_units
                n_units += 1
            sights.occurrence_begin[n_occurrences] = i
            sights.occurrence_unit[n_occurrences] = unit
            sights.occurrence_row[n_occurrences] = unit_row[unit]
            n_occurrences += 1
            for segment in range(segment_begin[unit], segment_begin[unit + 1]):
                first = segment_pair[segment]
                if place_of[first] < 0:
                    place_of[first] = segment_pairs[segment]
                    k = n_starts
                    while k > 0 and starts[k - 1] > first:
                        starts[k] = starts[k - 1]
                        k -= 1
                    starts[k] = first
                    n_starts += 1
        sights.landmark_begin[first_landmark + m] = first_occurrence
        sights.pair_begin[first_landmark + m] = n_touched
        place = 0
        for k in range(n_starts):
            many = place_of[starts[k]]
            place_of[starts[k]] = place
            for q in range(many):
                sights.pair[n_touched] = starts[k] + q
                n_touched += 1
            place += many
        for o in range(first_occurrence, n_occurrences):
            sights.place_begin[o] = n_places
            unit = sights.occurrence_unit[o]
            for segment in range(segment_begin[unit], segment_begin[unit + 1]):
                sights.place[n_places] = place_of[segment_pair[segment]]
                n_places += 1
        for k in range(n_starts):
            place_of[starts[k]] = -1
    cursor[0], cursor[1], cursor[2], cursor[3] = n_obs, n_occurrences, n_places, n_touched
    return n_units
