"""Sets of numbers as ascending arrays; a stable sort is fast here, since most arrays are nearly in order."""

import numpy as np

from pancam_graph.base.geometry import IntArray

__all__ = ["distinct"]


def distinct(*numbers: IntArray) -> IntArray:
    """All that occur in any of the arrays, ascending and once; as `np.unique`, several times as fast."""
    ordered = np.sort(np.concatenate(numbers), kind="stable")
    is_first = np.empty(len(ordered), dtype=bool)
    is_first[:1] = True
    np.not_equal(ordered[1:], ordered[:-1], out=is_first[1:])
    return np.asarray(ordered[is_first])
