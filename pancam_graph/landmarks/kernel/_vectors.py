"""The innermost loop of the elimination in LLVM's own instructions. Imported only where it is compiled."""

import logging
from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from pancam_graph.base.geometry import FloatArray, Int32Array

__all__ = ["row_subtraction", "subtract_row_in_vectors"]

_LOG = logging.getLogger(__name__)


def _in_vectors(typing: Any, tiles: Any, row: Any, arms: Any, first: Any, last: Any, pair: Any) -> Any:
    """`_tiles.subtract_row` in LLVM's own instructions: each tile is one vector of four numbers.

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
            if column.type != index:
                column = builder.sext(column, index)
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
    tiles: FloatArray, row: int, arms: FloatArray, first: int, last: int, pair: Int32Array
) -> None:
    """`subtract_row` in vectors, in a third of the time of the plain form. For compiled functions only."""
    subtract_in_vectors(tiles, row, arms, first, last, pair)


@cache
def row_subtraction(plain: Callable[..., None]) -> Callable[..., None]:
    """The form of `subtract_row` that compiled functions call: in vectors, or the plain one.

    Vectors are written with llvmlite, whose interface changes between versions. They are used where a trial
    compiles and gives the plain form's numbers. The trial runs only when a function is compiled, not when one
    is taken from the disk.
    """
    rng = np.random.default_rng(0)
    pair, arms = np.array([0, 2, 3], dtype=np.int32), rng.normal(size=18)
    tiles = rng.normal(size=2 * 4 * 4)
    expected = tiles.copy()
    plain(expected, 4, arms, 0, 3, pair)
    try:
        trial: Any = numba.njit(subtract_row_in_vectors)
        trial(tiles, 4, arms, 0, 3, pair)
    except Exception as error:
        reason = " ".join(str(error).split())  # Numba's has many lines
        _LOG.info("elimination without vectors, which takes longer: %s", reason)
        return plain
    if not np.allclose(tiles, expected, rtol=1e-12, atol=1e-12):
        _LOG.info("elimination without vectors, which takes longer: they give other numbers")
        return plain
    return subtract_row_in_vectors
