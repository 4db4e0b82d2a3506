"""What landmarks join: images, frames or stops (the *owners*) that see the same landmark."""

import numpy as np

from pancam_graph.base.geometry import BoolArray, IntArray
from pancam_graph.landmarks.kernel._compiling import entry

__all__ = ["connect", "count_links", "count_pairs"]


@entry
def count_links(begin: IntArray, owner: IntArray, kept: BoolArray, n: IntArray, in_use: IntArray) -> None:
    """Count the landmarks that each owner shares with another one.

    `owner` (observations,) and `kept`, whether each observation is in use, are sorted by landmark; those of
    landmark j are begin[j] to begin[j + 1]. Adds to `n` (owners,) the landmarks that an owner shares with
    another, and to `in_use` (owners,) those that observations in use let it share.
    """
    seen_in, used_in = np.full(len(n), -1), np.full(len(n), -1)
    for j in range(len(begin) - 1):
        n_seen, n_used = 0, 0
        for i in range(begin[j], begin[j + 1]):
            by = owner[i]
            if seen_in[by] != j:
                seen_in[by] = j
                n_seen += 1
            if kept[i] and used_in[by] != j:
                used_in[by] = j
                n_used += 1
        if n_seen < 2:
            continue
        for i in range(begin[j], begin[j + 1]):
            by = owner[i]
            if seen_in[by] == j:
                seen_in[by] = -1  # an owner counts once, with however many observations
                n[by] += 1
                if n_used >= 2 and used_in[by] == j:
                    in_use[by] += 1


@entry
def count_pairs(begin: IntArray, owner: IntArray, kept: BoolArray, n_owners: int, pairs: IntArray) -> None:
    """Count the pairs of observations of a landmark by one owner, by how many of the two are in use.

    Arguments as for `count_links`. Adds to `pairs` (3,) for none, one and both in use. Only landmarks that
    several owners see and of which an observation is in use; owners with another number of them are left out.
    """
    seen_in = np.full(n_owners, -1)
    n, used = np.zeros(n_owners, dtype=np.int64), np.zeros(n_owners, dtype=np.int64)
    for j in range(len(begin) - 1):
        n_seen, any_used = 0, False
        for i in range(begin[j], begin[j + 1]):
            by = owner[i]
            if seen_in[by] != j:
                seen_in[by], n[by], used[by] = j, 0, 0
                n_seen += 1
            n[by] += 1
            if kept[i]:
                used[by] += 1
                any_used = True
        if n_seen < 2 or not any_used:
            continue
        for i in range(begin[j], begin[j + 1]):
            by = owner[i]
            if seen_in[by] == j:
                seen_in[by] = -1
                if n[by] == 2:
                    pairs[used[by]] += 1


@entry
def connect(owner: IntArray, landmark: IntArray, first: IntArray, leader: IntArray) -> None:
    """Group the owners that common landmarks connect, directly or by way of others (union-find).

    `owner` and `landmark` (observations,), in any order. `first` (landmarks,) is -1 and `leader` (owners,)
    counts from 0 at the call; afterwards `leader` is the lowest owner of each one's group.
    """
    for i in range(len(owner)):
        a, b = owner[i], first[landmark[i]]
        if b < 0:
            first[landmark[i]] = a
            continue
        while leader[a] != a:
            leader[a] = leader[leader[a]]
            a = leader[a]
        while leader[b] != b:
            leader[b] = leader[leader[b]]
            b = leader[b]
        leader[max(a, b)] = min(a, b)
    for i in range(len(leader)):  # leaders are lower, so theirs are final
        leader[i] = leader[leader[i]]
