"""Links between frames that chance alone explains: few accepted tracks among many that were rejected."""

import numpy as np
import scipy

from pancam_graph.base.geometry import BoolArray, IntArray
from pancam_graph.solve._diagnose import shared_landmarks
from pancam_graph.solve._problem import Problem

__all__ = ["accident", "chance_links"]

_LEAST_CHANCE = 0.01
"""Probability of so many accidental agreements, from which on a link is not believed."""


def chance_links(problem: Problem, cutoff_px: float) -> BoolArray:
    """Accepted measurements (n,) that join frames by links that chance alone explains.

    Of N tracks that two frames share, K are accepted in both. A wrong track agrees with the cameras by
    accident if it comes within `cutoff_px` of its epipolar line, so the N - K rejected tracks let a number of
    accidents be expected. If K accidents are then not rare, the link is not believed, however well it fits:
    it may have moved the cameras to where it fits. Of a track whose frames fall apart without such links,
    the part with the most measurements is kept.
    """
    m, frame = problem.measurements, problem.template.traverse.image_frame[problem.measurements.image]
    kept = problem.kept
    shape = (len(problem.template.traverse.frames), m.n_landmarks)
    shared = shared_landmarks(shape, frame, m.landmark)
    accepted = scipy.sparse.coo_array(shared_landmarks(shape, frame[kept], m.landmark[kept]))
    a, b = accepted.coords
    a, b, n_accepted = (column[a < b] for column in (a, b, accepted.data))
    outside = np.zeros(len(m.row), dtype=bool)
    if len(a) == 0:
        return outside
    n_rejected = np.asarray(shared[a, b]).ravel() - n_accepted
    expected = np.maximum(n_rejected * accident(problem, cutoff_px), 1e-300)
    # The upper tail of a Poisson distribution is an incomplete gamma function.
    weak = scipy.special.gammainc(n_accepted, expected) > _LEAST_CHANCE
    links = set(zip(a[weak].tolist(), b[weak].tolist(), strict=True))
    for landmark in _joining(problem, frame, np.unique(np.r_[a[weak], b[weak]])):
        rows = np.arange(m.begin[landmark], m.begin[landmark + 1])
        rows = rows[kept[rows]]
        part = _parts(frame[rows].tolist(), links)
        outside[rows] = part != np.bincount(part).argmax()
    return outside


def accident(problem: Problem, cutoff_px: float) -> float:
    """Probability that a wrong track comes within the cutoff of its epipolar line."""
    rig = problem.template.traverse.rig
    narrowest = min(min(eye.camera.width_px, eye.camera.height_px) for eye in rig.eyes)
    return float(min(2 * np.sqrt(2.0) * cutoff_px / narrowest, 1.0))


def _joining(problem: Problem, frame: IntArray, frames: IntArray) -> IntArray:
    """Landmarks with accepted measurements in two or more of some frames."""
    m, rows = problem.measurements, problem.kept & np.isin(frame, frames)
    sights = np.unique(np.column_stack([m.landmark[rows], frame[rows]]), axis=0)
    landmark, count = np.unique(sights[:, 0], return_counts=True)
    return np.asarray(landmark[count >= 2])


def _parts(frames: list[int], weak: set[tuple[int, int]]) -> IntArray:
    """Part (n,) of each measurement of a landmark, by its frame; links that are not weak join frames."""
    names = sorted(set(frames))
    part = {name: i for i, name in enumerate(names)}
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            if (first, second) not in weak and part[first] != part[second]:
                old, new = part[second], part[first]
                part = {name: new if p == old else p for name, p in part.items()}
    return np.array([part[f] for f in frames])
