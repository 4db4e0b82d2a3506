"""A symmetric matrix as tiles of 2 x 2, and what elimination subtracts from it.

The tiles are stored by rows, and so are the four entries of each. Only tiles on and above the diagonal are
used; below the diagonal of a tile on it, entries have no meaning.
"""

from collections.abc import Callable

from pancam_graph.base.compiled import chosen, part
from pancam_graph.base.geometry import FloatArray, Int32Array, IntArray
from pancam_graph.landmarks.kernel._compiling import entry

__all__ = ["add_to_panels", "subtract_row", "tile_entry"]


@part
def tile_entry(row: int, column: int, n_pairs: int) -> int:
    """Where an entry of a matrix with `n_pairs` tiles to a side is stored."""
    return 4 * ((row >> 1) * n_pairs + (column >> 1)) + 2 * (row & 1) + (column & 1)


def _fastest(plain: Callable[..., None]) -> Callable[..., None]:
    from pancam_graph.landmarks.kernel._vectors import row_subtraction  # noqa: PLC0415  late: imports Numba

    return row_subtraction(plain)


@chosen(_fastest)
def subtract_row(
    tiles: FloatArray, row: int, arms: FloatArray, first: int, last: int, pair: Int32Array
) -> None:
    """Subtract W_p' W_q from a row of tiles: p is pair `first` of a landmark, q goes from `first` to `last`.

    W_q (3, 2) is stored by rows at arms[6 q]; its columns are those of pair[q] in the matrix, whose row of
    tiles begins with tile `row`. This is the innermost loop of the elimination. Compiled functions call one
    of two forms of it, see `_vectors.row_subtraction`; this one is for plain Python.
    """
    for q in range(first, last):
        for h in range(2):
            for m in range(2):
                for k in range(0, 6, 2):
                    tiles[4 * (row + pair[q]) + 2 * h + m] -= arms[6 * first + k + h] * arms[6 * q + k + m]


@entry
def add_to_panels(
    tiles: FloatArray,
    s: FloatArray,
    row: IntArray,
    groups: IntArray,
    begin: IntArray,
    column: IntArray,
    first: int,
    last: int,
    panel_begin: IntArray,
    panel_width: IntArray,
    numbers: FloatArray,
) -> None:
    """Add a block's system, S in tiles and s, to the panels of those of its groups from `first` to `last`.

    Rows begin[i] to begin[i + 1] of the system are those of groups[i]; `row` (columns,) and `column` (groups,
    columns) say where each of the block's columns is in the panel of a group; -1: nowhere. The panel of group
    g is `numbers` from panel_begin[g] on, row by row; its last column takes s.
    """
    n_pairs = len(s) // 2
    for i in range(len(groups)):
        g = groups[i]
        if g < first or g >= last:
            continue
        for p in range(begin[i], begin[i + 1]):
            if row[p] < 0:
                continue
            at = panel_begin[g] + row[p] * panel_width[g]
            numbers[at + panel_width[g] - 1] += s[p]
            for q in range(p, len(s)):
                if column[i, q] >= 0:
                    numbers[at + column[i, q]] += tiles[tile_entry(p, q, n_pairs)]
