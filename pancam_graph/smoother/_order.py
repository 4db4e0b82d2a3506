"""The order in which the stops of a recorded traverse are added, whatever their order in the file."""

import numpy as np
import scipy

from pancam_graph.base.geometry import IntArray
from pancam_graph.data import Traverse

__all__ = ["order_of_stops", "shared_tracks"]


def shared_tracks(traverse: Traverse) -> IntArray:
    """Numbers (stops, stops) of tracks that two stops share; of tracks that it sees on the diagonal."""
    n = len(traverse.stops)
    if traverse.observations is None:
        return np.zeros((n, n), dtype=np.int64)
    stop, track = traverse.image_stop[traverse.observations.image], traverse.observations.track
    pairs = np.unique(np.column_stack([track, stop]), axis=0)
    _, row = np.unique(pairs[:, 0], return_inverse=True)
    ones = np.ones(len(pairs), dtype=np.int64)
    sees = scipy.sparse.csr_array((ones, (row, pairs[:, 1])), shape=(len(pairs), n))
    return np.asarray((sees.T @ sees).toarray())


def order_of_stops(traverse: Traverse) -> list[tuple[int, int | None]]:
    """Rows of the stops in the order in which they are added, each with the row of the stop it follows.

    It is that of the file where no stop is surer than the first, and each shares tracks with the one before.
    Else it begins with the surest stop, since what is added later is tested against what is there. The next
    stop is the one that shares most tracks with those added, and it follows the one of these with which it
    shares most: no part of the drive is added without a link to the others as long as there is one.
    """
    stops, shared = traverse.stops, shared_tracks(traverse)
    sigma = [(s.sigma_translation_m, s.sigma_rotation_rad) for s in stops]
    rows = range(len(stops))
    if min(sigma) == sigma[0] and np.all(np.diagonal(shared, 1) > 0):
        return [(i, i - 1 if i else None) for i in rows]
    first = min(rows, key=lambda i: sigma[i])
    order: list[tuple[int, int | None]] = [(first, None)]
    left, links = [i for i in rows if i != first], shared[first].copy()
    while left:
        added = [i for i, _ in order]
        stop = max(left, key=lambda i: int(links[i]))
        order.append((stop, added[int(np.argmax(shared[stop, added]))] if links[stop] else added[-1]))
        left.remove(stop)
        links += shared[stop]
    return order
