"""A square root with more rows: QR of both, where their sum of squares would lose digits.

Where a weak prior alone holds a direction, as one of 1 km on all stops holds the origin, normal equations
lose it among the rounding errors of what images say. The square root of the images' part alone has fewer rows
than columns there; to stack the prior's rows under it loses nothing.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import scipy

from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination._panels import Pattern, Root

__all__ = ["Rows", "with_rows"]

Rows = tuple[Sequence[int], Sequence[slice], FloatArray]
"""Groups, columns in each of them, and rows (n, all these columns + 1), the residual last."""
_RANK_TOLERANCE = 1e-10
"""A pivot counts as zero up to this share of the length of its column."""


def with_rows(root: Root, more: Iterable[Rows]) -> Root:
    """Square root of R'R + J'J from the rows R of a root and further rows J, by QR of one group at a time.

    The groups of each of `more` must be a clique of the root's pattern. Rank-revealing, as `Panels.root` is.
    """
    st = root.structure
    waiting: list[list[FloatArray]] = [[rows] for rows in root.rows]
    position = {g: i for i, g in enumerate(st.order)}
    for groups, columns, rows in more:
        first = min(groups, key=position.__getitem__)
        waiting[first].append(_in_panel(st, first, groups, columns, rows))
    out: list[FloatArray] = [np.zeros((0, 0))] * len(st.dim)
    for g in st.order:
        out[g], rest = _reduced(np.concatenate(waiting[g]), int(st.dim[g]))
        if len(st.after[g]) > 1 and len(rest):
            others = st.after[g][1:]
            slices = [slice(0, int(st.dim[h])) for h in others]
            waiting[others[0]].append(_in_panel(st, others[0], others, slices, rest))
    return Root(structure=st, rows=tuple(out))


def _in_panel(
    st: Pattern, first: int, groups: Sequence[int], columns: Sequence[slice], rows: FloatArray
) -> FloatArray:
    """Rows in the columns of a group's panel."""
    begin = dict(zip(st.after[first], st.begin[first].tolist(), strict=False))
    out = np.zeros((len(rows), int(st.begin[first][-1]) + 1))
    at = 0
    for g, within in zip(groups, columns, strict=True):
        width = within.stop - within.start
        out[:, begin[g] + within.start : begin[g] + within.stop] += rows[:, at : at + width]
        at += width
    out[:, -1] = rows[:, -1]
    return out


def _reduced(rows: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Rows that determine the first n columns, and what the others say of the columns after these."""
    if n == 0:
        return rows[:0], rows
    length = np.linalg.norm(rows[:, :n], axis=0)
    scaled = rows[:, :n] / np.where(length > 0, length, 1.0)
    turn, upper, pivot = scipy.linalg.qr(scaled, pivoting=True)
    rank = int(np.sum(np.abs(np.diag(upper)) > _RANK_TOLERANCE))
    turned = turn.T @ rows
    turned[:, pivot] = np.triu(turned[:, pivot])
    return turned[:rank], turned[rank:, n:]
