"""The arrays of the elimination: observations in its order, cameras, and what it leaves of landmarks."""

from typing import NamedTuple

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, Int32Array, IntArray
from pancam_graph.landmarks.kernel._compiling import entry
from pancam_graph.landmarks.kernel._observe import Cameras

__all__ = ["Bearings", "Reduced", "Sights", "arrange"]


class Sights(NamedTuple):
    """Observations of landmarks in the order of elimination. A step changes nothing of it.

    A *unit* is a set of images that all variables move alike. An *occurrence* is one unit that sees one
    landmark. A unit's *chain* consists of *segments*, one for each variable that moves it. Landmarks are
    eliminated in *blocks*; the columns of a block's variables are numbered in *pairs*, and each segment
    begins with a new pair. For each landmark, `pair` lists the pairs of all variables that move its units,
    ascending, and `place` says where in that list each segment of an occurrence begins.
    """

    image: IntArray
    """(n,) image of each observation"""
    uv_px: FloatArray
    """(n, 2)"""
    whitening: FloatArray
    """(n, 2, 2) takes residuals in pixels to unit covariance"""
    occurrence_begin: IntArray
    """(occurrences + 1,) first observation of each, and n"""
    occurrence_unit: Int32Array
    """(occurrences,) the unit of each"""
    occurrence_row: Int32Array
    """(occurrences,) row of that unit among the units that see a landmark of the block"""
    place_begin: IntArray
    """(occurrences + 1,) first entry in `place` of each"""
    place: Int32Array
    """(places,) by occurrence and segment: where in its landmark's list of pairs the segment begins"""
    landmark_begin: IntArray
    """(landmarks + 1,) first occurrence of each"""
    pair_begin: IntArray
    """(landmarks + 1,) first pair of each"""
    pair: Int32Array
    """(pairs,) number of the pair in the block"""


class Bearings(NamedTuple):
    """Cameras at a point of linearisation, and how the variables move them."""

    cameras: Cameras
    unit_R: FloatArray
    """(units, 3, 3) world_R_base; a unit's base is the body whose twist moves its images"""
    unit_t: FloatArray
    """(units, 3) origin of the base in the world, metres"""
    segment_begin: IntArray
    """(units + 1,) first segment of each unit's chain"""
    segment_width: IntArray
    """(segments,) number of columns of each"""
    plain: BoolArray
    """(segments,) whether the variable's tangent is the base's twist: the segment is the unit matrix"""
    chain: FloatArray
    """(segments, rows, widest) takes a variable's tangent to the base's twist (6 rows, rotation first), and
    to changes of fx, fy, skew, cx and cy (5 more rows, where calibrations are free)"""


class Reduced(NamedTuple):
    """What elimination keeps of each landmark, to find its step and its covariance later.

    V = L L' is a landmark's information, g its gradient, E its products with the cameras' variables.
    """

    factor: FloatArray
    """(landmarks, 6) L by rows: entries 00, 10, 11, 20, 21, 22"""
    gamma: FloatArray
    """(landmarks, 3) L^-1 g"""
    arms: FloatArray
    """(6 pairs,) W = L^-1 E' of each landmark: three rows of two columns for each of its pairs"""
    cost: FloatArray
    """(landmarks,) robust cost of the landmark's observations"""
    undetermined: BoolArray
    """(landmarks,) whether nothing but the weak prior holds one of its directions"""


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
    """Put the landmarks of a block into the order of elimination. Returns how many units see them.

    `landmarks` (m,) are rows of the measurements, in which begin[j] to begin[j + 1] are the observations of
    landmark j. Writes `rows` (n,), the measurement of each observation, and all but pixels and whitenings of
    `sights`. Writing begins where `cursor` (observations, occurrences, places, pairs) stands, and moves it
    on.
    """
    unit_row = np.full(len(segment_begin) - 1, -1)
    place_of = np.full(n_pairs, -1)
    starts = np.empty(n_pairs, dtype=np.int64)
    n_units = 0
    n_obs, n_occurrences, n_places, n_touched = cursor[0], cursor[1], cursor[2], cursor[3]
    for m in range(len(landmarks)):
        j, first_occurrence = landmarks[m], n_occurrences
        first_obs, last_obs = n_obs, n_obs + begin[j + 1] - begin[j]
        for i in range(
            begin[j], begin[j + 1]
        ):  # insertion into the observations so far, which are sorted by unit
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
