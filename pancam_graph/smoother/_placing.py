"""Triangulation and refinement of landmarks with new observations, and rejection of outliers among these."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from pancam_graph.base.geometry import BoolArray, IntArray
from pancam_graph.landmarks import (
    CameraViews,
    Landmarks,
    Measurements,
    rays_of,
    refine,
    residuals,
    triangulate,
)
from pancam_graph.smoother._ledger import Fate, Ledger
from pancam_graph.smoother._sets import distinct
from pancam_graph.smoother._station import Patch
from pancam_graph.solve import robust_scale, snoop

__all__ = ["Placed", "Seen", "believed", "combined", "gathered", "placed_anew"]

_FEW_VIEWS = 4
"""Landmarks with at most this many observations may have an outlier though all their residuals are small."""
_WIDEST = 3.0
"""Largest ratio assumed of the actual noise to the sigmas of observations."""
_HIDDEN = 3.0
"""A landmark of more observations is tested if its largest squared residual, times this, reaches the
limit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """Landmarks with their observations from the stations of a patch."""

    patch: Patch
    track: IntArray
    """(landmarks,) track numbers, ascending"""
    measurements: Measurements
    """Of these landmarks; `row` counts rows of the ledger, `image` images of the patch."""
    landmarks: Landmarks

    def part(self, which: BoolArray, rows: BoolArray) -> "Placed":
        """Some landmarks (landmarks,) with some of their observations (n,), at least one of each."""
        return Placed(
            patch=self.patch,
            track=self.track[which],
            measurements=self.measurements.part(np.flatnonzero(rows & which[self.measurements.landmark])),
            landmarks=Landmarks(vector=self.landmarks.vector[which], origin_m=self.landmarks.origin_m[which]),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """Landmarks of which some have new observations."""

    placed: Placed
    touched: BoolArray
    """(landmarks,) whether observations were added or removed"""
    fresh: BoolArray
    """(landmarks,) whether it is new, without a place yet"""
    accepted: BoolArray
    """(n,) whether each measurement takes part"""


def combined(ledger: Ledger, image_station: IntArray, patch: Patch, parts: Sequence[Placed]) -> Placed:
    """Landmarks of several blocks joined in another patch."""
    track = np.concatenate([p.track for p in parts])
    order = np.argsort(track)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    begin = np.cumsum([0, *(len(p.track) for p in parts)])
    landmark = np.concatenate([rank[b + p.measurements.landmark] for b, p in zip(begin, parts, strict=False)])
    row = np.concatenate([p.measurements.row for p in parts])
    return Placed(
        patch=patch,
        track=track[order],
        measurements=_measurements(ledger, image_station, patch, row, landmark),
        landmarks=Landmarks(
            vector=np.concatenate([p.landmarks.vector for p in parts])[order],
            origin_m=np.concatenate([p.landmarks.origin_m for p in parts])[order],
        ),
    )


def _measurements(
    ledger: Ledger, image_station: IntArray, patch: Patch, row: IntArray, landmark: IntArray
) -> Measurements:
    """Measurements from rows of the ledger (n,) of landmarks (n,), sorted by landmark and then by image."""
    image = ledger.image[row]
    image = patch.image(image, image_station[image])
    # Mostly runs that are in order already: a stable sort merges them.
    order = np.argsort(landmark * int(patch.image_begin[-1]) + image, kind="stable")
    row = row[order]
    return Measurements(
        row=row,
        image=image[order],
        landmark=landmark[order],
        uv_px=ledger.uv_px.take(row, axis=0),
        whitening=ledger.whitening.take(row, axis=0),
    )


def gathered(
    ledger: Ledger,
    image_station: IntArray,
    patch: Patch,
    known: Placed | None,
    rows: IntArray,
    lost: IntArray,
) -> Seen:
    """Known landmarks without the rows `lost`, and with `rows` added, of their tracks or of new ones.

    Outliers among the rows are included, but not accepted.
    """
    new, gone = ledger.track[rows], distinct(ledger.track[lost])
    if known is not None and len(lost):
        stay = ~np.isin(known.measurements.row, lost)
        left = np.bincount(known.measurements.landmark, stay, minlength=len(known.track)) > 0
        known = known.part(left, stay) if left.any() else None
    none = np.zeros(0, dtype=np.int64)
    old_track = none if known is None else known.track
    track = distinct(old_track, new)
    at = np.searchsorted(track, old_track)
    old = none if known is None else known.measurements.row
    old_landmark = none if known is None else at[known.measurements.landmark]
    all_rows = np.concatenate([old, rows])
    landmark = np.concatenate([old_landmark, np.searchsorted(track, new)])
    vector, origin = np.zeros((len(track), 4)), np.zeros((len(track), 3))
    fresh, touched = np.ones(len(track), dtype=bool), np.zeros(len(track), dtype=bool)
    touched[np.searchsorted(track, new)] = True
    touched |= np.isin(track, gone)
    if known is not None:
        vector[at], origin[at], fresh[at] = known.landmarks.vector, known.landmarks.origin_m, False
    measurements = _measurements(ledger, image_station, patch, all_rows, landmark)
    return Seen(
        placed=Placed(
            patch=patch,
            track=track,
            measurements=measurements,
            landmarks=Landmarks(vector=vector, origin_m=origin),
        ),
        touched=touched,
        fresh=fresh,
        accepted=ledger.fate[measurements.row] != int(Fate.OUTLIER),
    )


def placed_anew(seen: Seen, views: CameraViews) -> Seen:
    """Triangulate fresh landmarks and refine all touched ones, with the cameras held."""
    placed = seen.placed
    m, landmarks, weight = placed.measurements, placed.landmarks, seen.accepted.astype(float)
    if seen.fresh.any():
        rows = np.flatnonzero(seen.fresh[m.landmark])
        part = m.part(rows)
        triangulated = triangulate(*rays_of(part, views), part.landmark, weight[rows])
        vector, origin = landmarks.vector.copy(), landmarks.origin_m.copy()
        vector[seen.fresh], origin[seen.fresh] = triangulated.vector, triangulated.origin_m
        landmarks = Landmarks(vector=vector, origin_m=origin)
    which = np.flatnonzero(seen.touched)
    landmarks = refine(landmarks, m, views, weight, beyond_infinity=True, only=which)
    return replace(seen, placed=replace(placed, landmarks=landmarks))


def believed(seen: Seen, views: CameraViews, cutoff_sigma: float | None) -> Seen:
    """Reject observations of touched landmarks that contradict the others, by data snooping (`snoop`).

    Only landmarks that may have an outlier are tested. Observations of a landmark behind its camera are
    always rejected; with no cutoff, these alone.
    """
    placed = seen.placed
    m, n = placed.measurements, placed.measurements.n_landmarks
    whitened, in_front = residuals(placed.landmarks, m, views)
    if cutoff_sigma is None:
        # A landmark behind a camera may have been triangulated from too few rays: triangulate it from all.
        behind = (np.bincount(m.landmark, ~in_front, minlength=n) > 0) & seen.touched
        if behind.any():
            all_of = seen.accepted | behind[m.landmark]
            seen = replace(
                placed_anew(replace(seen, touched=behind, fresh=behind, accepted=all_of), views),
                touched=seen.touched,
                fresh=seen.fresh,
            )
            _, in_front = residuals(seen.placed.landmarks, m, views)
        return replace(seen, accepted=np.where(seen.touched[m.landmark], in_front, seen.accepted))
    weight = seen.accepted.astype(float)
    square = weight * np.sum(whitened**2, axis=1)
    total, count = np.bincount(m.landmark, square, minlength=n), np.bincount(m.landmark, weight, minlength=n)
    largest = np.maximum.reduceat(square, m.starts)
    tail = scipy.special.erfc(cutoff_sigma / np.sqrt(2.0))
    limit = float(scipy.special.chdtri(1, tail))
    suspect = (total >= limit) & ((count <= _FEW_VIEWS) | (largest * _HIDDEN >= limit))
    suspect |= np.bincount(m.landmark, ~in_front | ~seen.accepted, minlength=n) > 0
    suspect &= seen.touched
    if not suspect.any():
        return seen
    # The noise scale comes from all landmarks of the block: the touched ones may be few, and all wrong.
    judged = count > 2
    scale = float(np.sqrt(np.median(total[judged] / (2 * count[judged] - 3)))) if judged.any() else 1.0
    scale = robust_scale(scale, m, views)
    rows = np.flatnonzero(suspect[m.landmark])
    part = m.part(rows)
    snooping = snoop(
        Landmarks(vector=placed.landmarks.vector[suspect], origin_m=placed.landmarks.origin_m[suspect]),
        part,
        views,
        seen.accepted[rows],
        cutoff_sigma=cutoff_sigma,
        min_scale=1.0,
        scale=float(np.clip(scale, 1.0, _WIDEST)),
    )
    accepted, vector, origin = (
        seen.accepted.copy(),
        placed.landmarks.vector.copy(),
        placed.landmarks.origin_m.copy(),
    )
    accepted[rows] = snooping.accepted
    vector[suspect], origin[suspect] = snooping.landmarks.vector, snooping.landmarks.origin_m
    landmarks = refine(
        Landmarks(vector=vector, origin_m=origin),
        m,
        views,
        accepted.astype(float),
        beyond_infinity=True,
        only=np.flatnonzero(suspect),
    )
    _, in_front = residuals(landmarks, m, views)
    accepted &= in_front | ~suspect[m.landmark]
    return replace(seen, placed=replace(placed, landmarks=landmarks), accepted=accepted)
