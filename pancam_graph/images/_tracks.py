"""From matches of pairs to tracks: one number for each terrain point."""

from dataclasses import dataclass

import numpy as np
import scipy

from pancam_graph.base.compiled import entry
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray

__all__ = ["Links", "apart_tracks", "join_tracks", "shared_still", "spread_tracks"]

_CELLS = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class Links:
    """Matches over all pairs of images: each says that two features show the same point."""

    image_a: IntArray
    """(n,) row of the first image."""
    feature_a: IntArray
    """(n,) row of the feature among those of the first image."""
    image_b: IntArray
    """(n,) row of the second image."""
    feature_b: IntArray
    """(n,) row of the feature among those of the second image."""
    distance: FloatArray
    """(n,) distance of the two descriptors; the smaller, the better."""

    @staticmethod
    def concatenate(parts: "list[Links]") -> "Links":
        """The links of several pairs in one."""
        names = ("image_a", "feature_a", "image_b", "feature_b")
        empty = np.empty(0, dtype=np.int64)
        columns = {n: np.concatenate([empty, *(getattr(p, n) for p in parts)]) for n in names}
        return Links(**columns, distance=np.concatenate([np.empty(0), *(p.distance for p in parts)]))


def join_tracks(links: Links) -> tuple[IntArray, IntArray, IntArray]:
    """Join links to tracks that hold at most one feature of each image.

    Links are taken best first (ties: in the order of their images and features). One that would put two
    features of an image into a track is refused, and only it: both its ends stay in the tracks they have. So
    if two features of an image compete for a track, the worse one stays out, alone or with the features
    linked to it, and the track remains. Returns columns `image`, `feature`, `track` of equal length, sorted
    by track, then image; tracks are numbered from 0 in the order of their first image and feature.
    """
    if not len(links.distance):
        empty = np.empty(0, dtype=np.int64)
        return empty, empty, empty
    width = 1 + max(int(links.feature_a.max()), int(links.feature_b.max()))
    ends = np.concatenate([links.image_a * width + links.feature_a, links.image_b * width + links.feature_b])
    nodes, index = np.unique(ends, return_inverse=True)
    image, feature = np.divmod(nodes, width)
    from_node, to_node = index.reshape(2, -1)
    order = np.lexsort((to_node, from_node, links.distance))
    n = len(nodes)
    track_of, size = np.arange(n), np.ones(n, dtype=np.int64)
    after, last, seen = np.full(n, -1), np.arange(n), np.full(int(image.max()) + 1, -1)
    _join(from_node[order], to_node[order], image, track_of, size, after, last, seen)
    # Nodes are sorted by image and feature, so a track's first node is its lowest.
    lowest = np.full(n, n)
    np.minimum.at(lowest, track_of, np.arange(n))
    rows = np.flatnonzero(size[track_of] > 1)
    rows = rows[np.argsort(lowest[track_of[rows]], kind="stable")]
    first = lowest[track_of[rows]]
    return image[rows], feature[rows], np.cumsum(np.diff(first, prepend=first[:1]) > 0)


@entry
def _join(
    from_node: IntArray,
    to_node: IntArray,
    image: IntArray,
    track_of: IntArray,
    size: IntArray,
    after: IntArray,
    last: IntArray,
    seen: IntArray,
) -> None:
    """Join the tracks of the nodes of each link in turn, unless both have a node in one image.

    Each track begins as its own node: `track_of` (nodes,) is its number, `size` counts its nodes, `after` is
    the next node of the same track (-1: none) and `last` its last, for the numbers that are tracks; the first
    node of a track has its number. `image` is that of each node, `seen` (images,) scratch, all -1.
    """
    for k in range(len(from_node)):
        keep, gone = track_of[from_node[k]], track_of[to_node[k]]
        if keep == gone:
            continue
        if size[gone] > size[keep] or (size[gone] == size[keep] and gone < keep):
            keep, gone = gone, keep
        node = keep
        while node >= 0:
            seen[image[node]] = k
            node = after[node]
        node, clash = gone, False
        while node >= 0:
            clash = clash or seen[image[node]] == k
            node = after[node]
        if clash:
            continue
        node = gone
        while node >= 0:
            track_of[node] = keep
            node = after[node]
        after[last[keep]], last[keep] = gone, last[gone]
        size[keep] += size[gone]


def apart_tracks(image: IntArray, track: IntArray, uv_px: FloatArray, least_px: float) -> BoolArray:
    """Which observations (n,) to keep, so that no image has two that are nearer to each other than that.

    Columns as `join_tracks` returns them, with pixels (n, 2). Of tracks that come near each other in any
    image the one with more observations stays, whole, then the one with the lower number.
    """
    near: list[IntArray] = [np.empty((0, 2), dtype=np.int64)]
    for i in np.unique(image).tolist():
        rows = np.flatnonzero(image == i)
        close = scipy.spatial.cKDTree(uv_px[rows]).query_pairs(least_px, output_type="ndarray")
        near.append(track[rows[close]].reshape(-1, 2))
    length = np.bincount(track)
    rank = np.empty(len(length), dtype=np.int64)
    rank[np.lexsort((np.arange(len(length)), -length))] = np.arange(len(length))
    pairs = np.concatenate(near)
    better = np.where((rank[pairs[:, 0]] < rank[pairs[:, 1]])[:, None], pairs, pairs[:, ::-1])
    stays = [True] * len(length)
    # In the order of the better ones, each is decided before it decides about others.
    for keep, gone in better[np.argsort(rank[better[:, 0]], kind="stable")].tolist():
        if stays[keep]:
            stays[gone] = False
    return np.asarray(np.array(stays, dtype=bool)[track])


def shared_still(track: IntArray, kept: BoolArray) -> IntArray:
    """Rows of the observations that are `kept` (n,) and whose tracks (n,) keep two or more."""
    return np.flatnonzero(kept & (np.bincount(track, kept)[track] >= 2))


def spread_tracks(
    image: IntArray, track: IntArray, uv_px: FloatArray, size_px: FloatArray, most: int
) -> BoolArray:
    """Which observations (n,) to keep, so that no image has many more than `most`, evenly over its cells.

    Columns as `join_tracks` returns them, with pixels (n, 2) and the images' widths and heights (images, 2).
    Each image takes the longest track of each of its cells before the second longest of any; a track stays
    whole where any of its images takes it.
    """
    length = np.bincount(track)
    taken = np.zeros(len(length), dtype=bool)
    for i in np.unique(image).tolist():
        rows = np.flatnonzero(image == i)
        column, row = np.clip(uv_px[rows] / size_px[i] * _CELLS, 0, _CELLS - 1).astype(np.int64).T
        cell = row * _CELLS + column
        order = np.lexsort((track[rows], -length[track[rows]], cell))
        rank = np.arange(len(rows)) - np.searchsorted(cell[order], cell[order])
        taken[track[rows[order[np.argsort(rank, kind="stable")[:most]]]]] = True
    return np.asarray(taken[track])
