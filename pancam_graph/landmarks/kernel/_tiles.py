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
from numba.extending import intrinsic, overload

from pancam_graph.base.compiled import entry, part
from pancam_graph.base.geometry import FloatArray, IntArray

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


def subtract_row_in_vectors(
    tiles: FloatArray, row: int, arms: FloatArray, first: int, last: int, pair: IntArray
) -> None:
    """`subtract_row` with each tile as one vector of four numbers: a third of the time of the plain form.

    For compiled functions only.
    """
    p = 6 * first
    p00, p01, p10, p11, p20, p21 = arms[p], arms[p + 1], arms[p + 2], arms[p + 3], arms[p + 4], arms[p + 5]
    for q in range(first, last):
        tile_subtraction(tiles, 4 * (row + pair[q]), arms, 6 * q, p00, p01, p10, p11, p20, p21)


def _subtract_tile(
    typing: Any,
    tiles: Any,
    tile: Any,
    arms: Any,
    arm: Any,
    p00: Any,
    p01: Any,
    p10: Any,
    p11: Any,
    p20: Any,
    p21: Any,
) -> Any:
    """Subtract W_p' W_q from the tile at tiles[tile], with W_q at arms[arm], in LLVM's own instructions.

    Numba leaves LLVM's search for such vectors switched off, and LLVM then takes each entry alone.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number, word = ir.DoubleType(), ir.IntType(32)
        two, four = ir.VectorType(number, 2), ir.VectorType(number, 4)
        tiles, arms = (
            context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 2)
        )
        tile, arm = arguments[1], arguments[3]

        def each_twice(left: Any, right: Any) -> Any:
            """A vector (left, left, right, right)."""
            vector = ir.Constant(four, ir.Undefined)
            for k, value in enumerate((left, left, right, right)):
                vector = builder.insert_element(vector, value, word(k))
            return vector

        at = builder.bitcast(builder.gep(tiles, [tile]), four.as_pointer())
        entries = builder.load(at, align=8)
        for k in range(3):
            place = builder.gep(arms, [builder.add(arm, arm.type(2 * k))])
            row_of_q = builder.load(builder.bitcast(place, two.as_pointer()), align=8)
            both = builder.shuffle_vector(
                row_of_q, row_of_q, ir.Constant(ir.VectorType(word, 4), (0, 1, 0, 1))
            )
            product = builder.fmul(each_twice(*arguments[4 + 2 * k : 6 + 2 * k]), both, flags=("contract",))
            entries = builder.fsub(entries, product, flags=("contract",))
        builder.store(entries, at, align=8)
        return context.get_dummy_value()

    index, number = numba.types.intp, numba.types.float64
    return numba.types.void(tiles, index, arms, index, *(number,) * 6), generate


tile_subtraction: Any = intrinsic(_subtract_tile)


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
        _LOG.info("elimination without vectors, which takes longer: %s", error)
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
