"""The innermost loop of the elimination, in all its forms, against NumPy's products."""

import os
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest
from numba.extending import intrinsic

from pancam_graph.base.compiled import entry
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks.kernel import _vectors
from pancam_graph.landmarks.kernel._tiles import subtract_row
from pancam_graph.landmarks.kernel._vectors import row_subtraction, subtract_row_in_vectors

PAIRS = pytest.mark.parametrize("pairs", [(0, 1, 2), (1, 4), (3,)])
N_PAIRS = 5
PLAIN: Any = getattr(subtract_row, "plain", subtract_row)  # itself where nothing is compiled


def subtracted(
    subtract: Callable[..., None], pairs: tuple[int, ...], tiles: FloatArray, arms: FloatArray
) -> FloatArray:
    """The upper triangle of S - W'W in tiles, by one of the forms of `subtract_row`."""
    tiles, pair = tiles.copy(), np.array(pairs)
    for p in range(len(pair)):
        subtract(tiles, pair[p] * N_PAIRS, arms, p, len(pair), pair)
    return tiles


@PAIRS
def test_all_forms_of_the_innermost_loop_subtract_products(pairs: tuple[int, ...]) -> None:
    """Plain Python, the plain form compiled, and what the elimination calls, which is in vectors."""

    @entry
    def as_called(
        tiles: FloatArray, row: int, arms: FloatArray, first: int, last: int, pair: IntArray
    ) -> None:
        subtract_row(tiles, row, arms, first, last, pair)

    rng = np.random.default_rng(3)
    arms, tiles = rng.normal(size=6 * len(pairs)), rng.normal(size=4 * N_PAIRS**2)
    S, arms_of = tiles.reshape(N_PAIRS, N_PAIRS, 2, 2).copy(), arms.reshape(-1, 3, 2)
    for p in range(len(pairs)):
        for q in range(p, len(pairs)):
            S[pairs[p], pairs[q]] -= arms_of[p].T @ arms_of[q]
    compiled: Any = numba.njit  # its types know only functions of nothing
    for form in (PLAIN, compiled(PLAIN), as_called):
        assert subtracted(form, pairs, tiles, arms) == pytest.approx(S.ravel(), abs=1e-14)


@pytest.mark.skipif(bool(os.environ.get("NUMBA_DISABLE_JIT")), reason="nothing is compiled")
def test_vectors_are_used_unless_they_do_not_compile_or_are_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    choose: Any = row_subtraction.__wrapped__  # not the choice that was made before
    assert choose(PLAIN) is subtract_row_in_vectors

    def raises(typing: Any, *types: Any) -> Any:
        raise AttributeError("no VectorType")

    def does_nothing(typing: Any, *types: Any) -> Any:
        return numba.types.void(*types), lambda context, *_: context.get_dummy_value()

    for other in (raises, does_nothing):
        monkeypatch.setattr(_vectors, "subtract_in_vectors", intrinsic(other))
        assert choose(PLAIN) is PLAIN
