"""Linear triangulation of landmarks from their rays."""

from typing import NamedTuple, TypeAlias

import numpy as np

from pancam_graph.base.compiled import inlined, part
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks.kernel._compiling import entry
from pancam_graph.landmarks.kernel._symmetric import diagonalise, least_direction

__all__ = ["triangulate"]

_NO_BASELINE_M = 1e-9
_ANY = 0.48, -0.56, 0.62, 0.27
"""Where inverse iteration begins: no axis, and no sum or difference of axes, is orthogonal to it."""
_FOR_WEIGHTS = 1e-16
"""Squared change that ends the inverse iteration of the first time: nothing but weights hangs on it."""


@inlined
def _arm(
    centre_m: FloatArray, direction: FloatArray, i: int, o0: float, o1: float, o2: float
) -> tuple[float, float, float, float]:
    """Vector from an origin to the centre of ray i, without its part along it, and its squared length."""
    a0, a1, a2 = centre_m[i, 0] - o0, centre_m[i, 1] - o1, centre_m[i, 2] - o2
    d0, d1, d2 = direction[i, 0], direction[i, 1], direction[i, 2]
    along = a0 * d0 + a1 * d1 + a2 * d2
    a0, a1, a2 = a0 - along * d0, a1 - along * d1, a2 - along * d2
    return a0, a1, a2, a0 * a0 + a1 * a1 + a2 * a2


class _Room(NamedTuple):
    """Memory of a triangulation, written anew for each landmark."""

    form: FloatArray
    """(4, 4)"""
    turn: FloatArray
    """(4, 4)"""
    x: FloatArray
    """(4,)"""
    half: FloatArray
    """(4,)"""
    order: IntArray
    """(4,)"""


_Lower: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float]
"""The lower triangle of a symmetric matrix (4, 4), row by row."""


@inlined
def _fill(form: FloatArray, lower: _Lower) -> None:
    """Write a symmetric matrix (4, 4)."""
    form[0, 0], form[1, 1], form[2, 2], form[3, 3] = lower[0], lower[2], lower[5], lower[9]
    form[1, 0] = form[0, 1] = lower[1]
    form[2, 0] = form[0, 2] = lower[3]
    form[2, 1] = form[1, 2] = lower[4]
    form[3, 0] = form[0, 3] = lower[6]
    form[3, 1] = form[1, 3] = lower[7]
    form[3, 2] = form[2, 3] = lower[8]


@part
def _triangulate(
    j: int,
    first: int,
    last: int,
    centre_m: FloatArray,
    direction: FloatArray,
    weight: FloatArray,
    room: _Room,
    vector: FloatArray,
    origin_m: FloatArray,
) -> None:
    """Triangulate landmark j from its rays first to last, to its rows of `vector` and `origin_m`.

    See `landmarks.triangulate`. `room` is overwritten.
    """
    form, turn, x = room.form, room.turn, room.x
    total = 0.0
    for i in range(first, last):
        total += weight[i]
    alike = not total > 0
    if alike:
        total = float(last - first)
    o0, o1, o2 = 0.0, 0.0, 0.0
    for i in range(first, last):
        share = 1.0 if alike else weight[i]
        o0 += share * centre_m[i, 0]
        o1 += share * centre_m[i, 1]
        o2 += share * centre_m[i, 2]
    o0, o1, o2 = o0 / total, o1 / total, o2 / total
    squares = 0.0
    for i in range(first, last):
        square = _arm(centre_m, direction, i, o0, o1, o2)[3]
        squares += (1.0 if alike else weight[i]) * square
    baseline = np.sqrt(squares / total)
    parallax = baseline > _NO_BASELINE_M
    if not parallax:
        baseline = 1.0
    x0, x1, x2, w = 0.0, 0.0, 0.0, 0.0
    for again in range(2):
        f00, f10, f11, f20, f21, f22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        f30, f31, f32, f33 = 0.0, 0.0, 0.0, 0.0
        for i in range(first, last):
            a0, a1, a2, square = _arm(centre_m, direction, i, o0, o1, o2)
            d0, d1, d2 = direction[i, 0], direction[i, 1], direction[i, 2]
            share = 1.0 if alike else weight[i]
            if again:
                t0 = x0 - w * (centre_m[i, 0] - o0)
                t1 = x1 - w * (centre_m[i, 1] - o1)
                t2 = x2 - w * (centre_m[i, 2] - o2)
                share /= max(t0 * t0 + t1 * t1 + t2 * t2, 1e-12)
            f00 += share - share * d0 * d0
            f10 -= share * d1 * d0
            f11 += share - share * d1 * d1
            f20 -= share * d2 * d0
            f21 -= share * d2 * d1
            f22 += share - share * d2 * d2
            if parallax:
                f30 -= share * a0 / baseline
                f31 -= share * a1 / baseline
                f32 -= share * a2 / baseline
                f33 += share * (square / (baseline * baseline))
            else:
                f33 += share
        if again:
            x[0], x[1], x[2], x[3] = x0, x1, x2, w * baseline
        else:
            x[0], x[1], x[2], x[3] = _ANY
        lower = f00, f10, f11, f20, f21, f22, f30, f31, f32, f33
        _fill(form, lower)
        # Without parallax w is 0, and only rotations keep it exactly so.
        settled = 1e-30 if again else _FOR_WEIGHTS
        if not (parallax and least_direction(form, room.order, room.half, settled, x)):
            _fill(form, lower)
            diagonalise(form, turn)
            least = 0
            for k in range(1, 4):
                if form[k, k] < form[least, least]:
                    least = k
            x[0], x[1], x[2], x[3] = turn[0, least], turn[1, least], turn[2, least], turn[3, least]
        x0, x1, x2, w = x[0], x[1], x[2], x[3] / baseline
        norm = np.sqrt(x0 * x0 + x1 * x1 + x2 * x2 + w * w)
        x0, x1, x2, w = x0 / norm, x1 / norm, x2 / norm, w / norm
    ahead = 0.0
    for i in range(first, last):
        along = direction[i, 0] * (x0 - w * (centre_m[i, 0] - o0))
        along += direction[i, 1] * (x1 - w * (centre_m[i, 1] - o1))
        along += direction[i, 2] * (x2 - w * (centre_m[i, 2] - o2))
        ahead += (1.0 if alike else weight[i]) * np.sign(along)
    if ahead < 0:
        x0, x1, x2, w = -x0, -x1, -x2, -w
    vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3] = x0, x1, x2, w
    origin_m[j, 0], origin_m[j, 1], origin_m[j, 2] = o0, o1, o2


@entry
def triangulate(
    which: IntArray,
    begin: IntArray,
    centre_m: FloatArray,
    direction: FloatArray,
    weight: FloatArray,
    vector: FloatArray,
    origin_m: FloatArray,
) -> None:
    """Triangulate the landmarks `which` from rays (n, 3) sorted by landmark.

    Writes `vector` (landmarks, 4) and `origin_m` (landmarks, 3).
    """
    room = _Room(
        form=np.empty((4, 4)),
        turn=np.empty((4, 4)),
        x=np.empty(4),
        half=np.empty(4),
        order=np.empty(4, dtype=np.int64),
    )
    for j in which:
        first, last = begin[j], begin[j + 1]
        _triangulate(j, first, last, centre_m, direction, weight, room, vector, origin_m)
