"""A symmetric matrix as tiles of 2 x 2, and what elimination subtracts from it.

The tiles are stored by rows, and so are the four entries of each. Only tiles on and above the diagonal are
used; below the diagonal of a tile on it, entries have no meaning.
"""

import logging
from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from pancam_graph.base.compiled import part
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks.kernel._compiling import entry

__all__ = ["add_to_panel", "row_subtraction", "subtract_row", "subtract_row_in_vectors", "tile_entry"]

_LOG = logging.getLogger(__name__)


@part
def tile_entry(row: int, column: int, n_pairs: int) -> int:
    """Where an entry of a matrix with `n_pairs` tiles to a side is stored."""
    return 4 * ((row >> 1) * n_pairs + (column >> 1)) + 2 * (row & 1) + (column & 1)


def subtract_row(
    tiles: FloatArray, row: int, arms: FloatArray, first: int, last: int, pair: IntArray
) -> None:
    """Subtract W_p' W_q from a row of tiles: p is pair `first` of a landmark, q goes from `first` to `last`.

    W_q (3, 2) is stored by rows at arms[6 q]; its columns are those of pair[q] in the matrix, whose row of
    tiles begins with tile `row`. This is the innermost loop of the elimination. Compiled functions call one
    of two forms of it, see `row_subtraction`; this one is in plain Python.
    """
    for q in range(first, last):
        for h in range(2):
            for m in range(2):
                for k in range(0, 6, 2):
                    tiles[4 * (row + pair[q]) + 2 * h + m] -= arms[6 * first + k + h] * arms[6 * q + k + m]


def _in_vectors(typing: Any, tiles: Any, row: Any, arms: Any, first: Any, last: Any, pair: Any) -> Any:
    """`subtract_row` in LLVM's own instructions: each tile is one vector of four numbers.

    Numba leaves LLVM's search for such vectors switched off, and LLVM then takes each entry alone.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        from numba.core import cgutils  # noqa: PLC0415  not public: where it is gone, the plain form is taken

        tiles, row, arms, first, last, pair = (
            context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
            for kind, value in zip(signature.args, arguments, strict=True)
        )
        index, number = row.type, ir.DoubleType()
        two, four = ir.VectorType(number, 2), ir.VectorType(number, 4)

        def row_of_arms(q: Any, k: int, order: tuple[int, ...]) -> Any:
            """Row k of W_q as a vector of four, its two numbers in the given order."""
            place = builder.gep(arms, [builder.add(builder.mul(q, index(6)), index(2 * k))])
            row_of_q = builder.load(builder.bitcast(place, two.as_pointer()), align=8)
            lanes = ir.Constant(ir.VectorType(ir.IntType(32), 4), order)
            return builder.shuffle_vector(row_of_q, row_of_q, lanes)

        rows_of_p = [row_of_arms(first, k, (0, 0, 1, 1)) for k in range(3)]
        with cgutils.for_range_slice(builder, first, last, index(1), index) as (q, _):
            column = builder.load(builder.gep(pair, [q]))
            tile = builder.gep(tiles, [builder.mul(builder.add(row, column), index(4))])
            tile = builder.bitcast(tile, four.as_pointer())
            entries = builder.load(tile, align=8)
            for k in range(3):
                product = builder.fmul(rows_of_p[k], row_of_arms(q, k, (0, 1, 0, 1)), flags=("contract",))
                entries = builder.fsub(entries, product, flags=("contract",))
            builder.store(entries, tile, align=8)
        return context.get_dummy_value()

    return types.void(tiles, types.intp, arms, types.intp, types.intp, pair), generate


subtract_in_vectors: Any = intrinsic(_in_vectors)


def subtract_row_in_vectors(
    tiles: FloatArray, row: int, arms: FloatArray, first: int, last: int, pair: IntArray
) -> None:
    """`subtract_row` in vectors, in a third of the time of the plain form. For compiled functions only."""
    subtract_in_vectors(tiles, row, arms, first, last, pair)


@cache
def row_subtraction() -> Callable[..., None]:
    """The form of `subtract_row` that compiled functions call: in vectors, or the plain one.

    Vectors are written with llvmlite, whose interface changes between versions. They are used where a trial
    compiles and gives the plain form's numbers. The trial runs only when a function is compiled, not when one
    is taken from the disk.
    """
    rng = np.random.default_rng(0)
    pair, arms = np.array([0, 2, 3]), rng.normal(size=18)
    tiles = rng.normal(size=2 * 4 * 4)
    expected = tiles.copy()
    subtract_row(expected, 4, arms, 0, 3, pair)
    try:
        trial: Any = numba.njit(subtract_row_in_vectors)
        trial(tiles, 4, arms, 0, 3, pair)
    except Exception as error:
        reason = " ".join(str(error).split())  # Numba's has many lines
        _LOG.info("elimination without vectors, which takes longer: %s", reason)
        return subtract_row
    if not np.allclose(tiles, expected, rtol=1e-12, atol=1e-12):
        _LOG.info("elimination without vectors, which takes longer: they give other numbers")
        return subtract_row
    return subtract_row_in_vectors


@overload(
    subtract_row, strict=False, jit_options={"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
)
def _subtract_row(tiles: Any, row: Any, arms: Any, first: Any, last: Any, pair: Any) -> Callable[..., None]:
    """Tells Numba what `subtract_row` is in compiled functions."""
    return row_subtraction()


@entry
def add_to_panel(
    tiles: FloatArray,
    s: FloatArray,
    first: int,
    last: int,
    row: IntArray,
    column: IntArray,
    panel: FloatArray,
) -> None:
    """Add rows first to last of a block's system, S in tiles and s, to a group's panel.

    The panel's last column takes s. `row` and `column` say where each of the block's columns is in the panel;
    -1: nowhere.
    """
    n_pairs = len(s) // 2
    for p in range(first, last):
        r = row[p]
        if r < 0:
            continue
        panel[r, panel.shape[1] - 1] += s[p]
        for q in range(p, len(s)):
            if column[q] >= 0:
                panel[r, column[q]] += tiles[tile_entry(p, q, n_pairs)]
