"""Halves of the tracks, by lot or by image halves; and frames or stops that a half does not connect."""

from dataclasses import dataclass

import numpy as np
import scipy

from pancam_graph.base.geometry import BoolArray, IntArray
from pancam_graph.data import Traverse
from pancam_graph.landmarks import Measurements
from pancam_graph.solve._diagnose import components, shared_landmarks
from pancam_graph.solve._problem import Problem

__all__ = ["Groups", "neighbours", "random_half", "upper_half"]


def random_half(traverse: Traverse, measurements: Measurements, lots: "np.random.Generator") -> BoolArray:
    """(landmarks,) True for one half, drawn by lot: one of every two landmarks that connect the same frames.

    Both halves are then equally strong everywhere, and no frame is lost without need.
    """
    n, frame = measurements.n_landmarks, traverse.image_frame[measurements.image]
    first, last = (side.reduceat(frame, measurements.starts) for side in (np.minimum, np.maximum))
    order = np.lexsort((lots.random(n), last, first))
    coins = lots.random((n + 1) // 2) < 0.5
    half = np.empty(n, dtype=bool)
    half[order] = np.column_stack([coins, ~coins]).ravel()[:n]
    return half


def upper_half(traverse: Traverse, measurements: Measurements) -> BoolArray:
    """(landmarks,) whether the mean observation of a landmark lies above the middle of the image.

    A landmark may be low in one image and high in another, as between the rows of a panorama. All its
    observations go to one half, since half of a tie connects nothing.
    """
    assert traverse.observations is not None
    height = np.array([eye.camera.height_px for eye in traverse.rig.eyes])
    height = height[traverse.image_eye][measurements.image]
    v_px = traverse.observations.uv_px[measurements.row, 1]
    return np.asarray(np.add.reduceat((v_px - (height - 1) / 2) / height, measurements.starts) < 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Groups:
    """Groups of members (frames or stops) that tracks connect."""

    seen: BoolArray
    """(members,) whether the member has a measurement that takes part."""
    group: IntArray
    """(members,) number of each member's group."""

    @staticmethod
    def of(problem: Problem, member_of_image: IntArray, n_members: int) -> "Groups":
        """Groups that the measurements of a problem connect; measurements that take no part do not count."""
        m, kept = problem.measurements, problem.kept
        member = member_of_image[m.image[kept]]
        return Groups(
            seen=np.bincount(member, minlength=n_members) > 0,
            group=components(n_members, member, m.landmark[kept])[1],
        )

    def lost_in(self, half: "Groups") -> BoolArray:
        """(members,) members that a half does not see, or cuts off from the largest part of their group."""
        lost = self.seen & ~half.seen
        rows = np.flatnonzero(self.seen & half.seen)
        parts, part, size = np.unique(
            np.column_stack([self.group, half.group])[rows], axis=0, return_inverse=True, return_counts=True
        )
        # The largest part of each group sorts first; of equal parts, the earlier one.
        order = np.lexsort((-size, parts[:, 0]))
        first = np.unique(parts[order, 0], return_index=True)[1]
        largest = np.zeros(len(parts), dtype=bool)
        largest[order[first]] = True
        lost[rows] |= ~largest[part.ravel()]
        return np.asarray(lost)

    def joins(self, members: IntArray) -> BoolArray:
        """(n,) whether all of the members (n, k) are seen and belong to one group."""
        group = np.where(self.seen, self.group, -1)[members]
        return np.asarray((group == group[:, :1]).all(axis=1) & (group[:, 0] >= 0))

    def joins_landmarks(self, measurements: Measurements, member_of_image: IntArray) -> BoolArray:
        """(landmarks,) whether all members that see a landmark are seen here and belong to one group."""
        group = np.where(self.seen, self.group, -1)[member_of_image[measurements.image]]
        low, high = (side.reduceat(group, measurements.starts) for side in (np.minimum, np.maximum))
        return np.asarray((low == high) & (low >= 0))


def neighbours(traverse: Traverse, problem: Problem) -> tuple[IntArray, IntArray]:
    """Pairs of frames of one stop that share tracks (pairs, 2), and the number of shared tracks (pairs,).

    The pairs are the spanning tree of each connected group with the most shared tracks: all relative pointing
    within a group follows from them. Ordered by the first frame, then by the second.
    """
    m, kept, n = problem.measurements, problem.kept, len(traverse.frames)
    frame = traverse.image_frame[m.image[kept]]
    shared = scipy.sparse.coo_array(shared_landmarks((n, m.n_landmarks), frame, m.landmark[kept]))
    i, j = shared.coords
    of_one_stop = (traverse.frame_stop[i] == traverse.frame_stop[j]) & (i < j)
    i, j, count = i[of_one_stop], j[of_one_stop], shared.data[of_one_stop]
    narrow = i.astype(np.int32), j.astype(np.int32)  # SciPy before 1.16 refuses wider indices of a graph
    weights = scipy.sparse.coo_array((-count, narrow), shape=(n, n)).tocsr()
    tree = scipy.sparse.coo_array(scipy.sparse.csgraph.minimum_spanning_tree(weights))
    rows, columns = tree.coords
    order = np.lexsort((columns, rows))
    pairs = np.column_stack([rows, columns])[order].astype(np.int64)
    return pairs, (-tree.data[order]).astype(np.int64)
