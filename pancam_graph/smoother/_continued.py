"""A drive that has grown: a smoother that has its first stops goes on where an earlier run left it."""

from dataclasses import replace

import numpy as np

from pancam_graph.base.geometry import BoolArray, IntArray
from pancam_graph.data import Observations, Traverse
from pancam_graph.io import rig_json
from pancam_graph.smoother._ledger import Fate
from pancam_graph.smoother._smoother import TraverseSmoother
from pancam_graph.smoother._smoother_options import SmootherOptions

__all__ = ["brought_up_to_date", "rows_in", "what_differs"]

_SAME = 1e-12
"""Radians and metres by which poses that files keep in other forms may differ."""
_MOST_CHANGED = 0.2
"""Share of a drive's observations that may have changed: with more, to begin anew is quicker, and surer."""


def what_differs(smoother: TraverseSmoother, traverse: Traverse, options: SmootherOptions) -> str | None:
    """Why a smoother cannot go on with a traverse, in words; None: it can.

    It can where options and rig are the traverse's, where all its stops, with their frames and images, are
    among the traverse's, and where at most a fifth of its observations is gone or has changed.
    """
    known = smoother.traverse
    if smoother.options != options:
        return "other options"
    if smoother.n_factors:
        return "factors of its own"
    if rig_json(smoother.rig, name="", passed=True) != rig_json(traverse.rig, name="", passed=True):
        return "another rig"
    stops = {stop.id: stop for stop in traverse.stops}
    frames, images = {f.id: f for f in traverse.frames}, {i.id: i for i in traverse.images}
    for stop in known.stops:
        other = stops.get(stop.id)
        if (
            other is None
            or not other.world_T_mast.equals(stop.world_T_mast, _SAME)
            or np.any(other.sigmas != stop.sigmas)
        ):
            return f"another stop {stop.id}"
    for frame in known.frames:
        if frames.get(frame.id) != frame:
            return f"another frame {frame.id}"
    for image in known.images:
        found = images.get(image.id)
        if found is None or (found.frame, found.camera) != (image.frame, image.camera):
            return f"another image {image.id}"
    of_known, there = {stop.id for stop in known.stops}, {frame.id for frame in known.frames}
    if any(frame.stop in of_known and frame.id not in there for frame in traverse.frames):
        return "fewer frames of a stop"
    gone, _ = _changed(known, smoother.fate, traverse)
    if known.observations is not None and gone.sum() > _MOST_CHANGED * len(known.observations):
        return f"{int(gone.sum())} other observations"
    return None


def rows_in(smoother: TraverseSmoother, traverse: Traverse) -> IntArray:
    """Rows of a traverse's observations that are those of a smoother (n,); -1: it has been taken back."""
    return _rows_in(smoother.traverse, smoother.fate, traverse)


def _rows_in(mine: Traverse, fate: IntArray, traverse: Traverse) -> IntArray:
    """The same of the drive of a smoother, and what became of its observations."""
    theirs = traverse.observations
    if mine.observations is None or theirs is None:
        return np.zeros(0, dtype=np.int64)
    row_of = {image.id: row for row, image in enumerate(traverse.images)}
    image = np.array([row_of[i.id] for i in mine.images], dtype=np.int64)[mine.observations.image]
    width = 1 + max(int(mine.observations.track.max()), int(theirs.track.max(initial=0)))
    key, of_mine = theirs.image * width + theirs.track, image * width + mine.observations.track
    order = np.argsort(key, kind="stable")
    place = np.searchsorted(key, of_mine, sorter=order).clip(max=max(len(key) - 1, 0))
    row = order[place] if len(key) else np.zeros(len(of_mine), dtype=np.int64)
    found = key[row] == of_mine if len(key) else np.zeros(len(of_mine), dtype=bool)
    return np.where(found & (fate != int(Fate.REMOVED)), row, -1)


def _changed(mine: Traverse, fate: IntArray, traverse: Traverse) -> tuple[BoolArray, BoolArray]:
    """Observations of a smoother's drive that a traverse has no more, or otherwise; what its images see more.

    `fate` (observations,) is what became of the former.
    """
    theirs = traverse.observations
    if mine.observations is None or theirs is None:
        return np.zeros(0, dtype=bool), np.zeros(0, dtype=bool)
    row = _rows_in(mine, fate, traverse)
    there = row >= 0
    same = there.copy()
    a, b = mine.observations, theirs.select(row[there])
    same[there] &= np.all(a.uv_px[there] == b.uv_px, axis=1)
    same[there] &= np.isclose(a.sigma_px[there], b.sigma_px, rtol=_SAME, atol=0)
    if a.covariance_px2 is not None and b.covariance_px2 is not None:
        close = np.isclose(a.covariance_px2[there], b.covariance_px2, rtol=1e-9, atol=1e-15)
        same[there] &= close.all(axis=(1, 2))
    gone = ~same & (fate != int(Fate.REMOVED))
    known = {image.id for image in mine.images}
    of_mine = np.array([image.id in known for image in traverse.images])[theirs.image]
    kept = np.zeros(len(theirs), dtype=bool)
    kept[row[same]] = True
    return gone, of_mine & ~kept


def brought_up_to_date(smoother: TraverseSmoother, traverse: Traverse) -> None:
    """Take back observations of the smoother's images that a traverse has no more, and add those it lacks.

    For after its stops are added: what new stops see first may be seen from the old ones too.
    """
    mine, theirs = smoother.traverse, traverse.observations
    gone, new = _changed(mine, smoother.fate, traverse)
    if gone.any() and mine.observations is not None:
        smoother.remove(mine.observations.select(gone))
    if new.any() and theirs is not None:
        smoother.add_observations(_of_images(smoother, traverse, theirs.select(new)))


def _of_images(smoother: TraverseSmoother, traverse: Traverse, observations: Observations) -> Observations:
    """Observations of a traverse with their images as rows of a smoother's."""
    row_of = {name: row for row, name in enumerate(smoother.images)}
    row = np.array([row_of.get(image.id, -1) for image in traverse.images], dtype=np.int64)
    return replace(observations, image=row[observations.image], point_track={})
