"""What runs per observation, compiled: one module, so that the cache on disk is never half old.

Everything else of the package works on whole arrays or once per image, frame or stop.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray

__all__ = [
    "BEHIND_COST",
    "SURPRISE",
    "SURPRISE_COST",
    "WEAK_PRIOR",
    "Bearings",
    "Reduced",
    "Seen",
    "Sights",
    "arrange",
    "cofactors",
    "compiled",
    "costs",
    "eigen",
    "eliminate_calibrations",
    "eliminate_poses",
    "evaluate",
    "follow",
    "free_derivatives",
    "gather",
    "loss_cost",
    "loss_costs",
    "loss_weight",
    "loss_weights",
    "must_compile",
    "rays",
    "refine",
    "reject",
    "residuals",
    "smallest_information",
    "spread",
    "tests",
    "triangulate",
]

_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """Compile for the machine, without the interpreter's lock, and keep the result on disk.

    Sums of products may be fused, and so are the more exact; nothing else is reordered.
    """
    dispatcher: Any = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})(function)
    return cast(_F, dispatcher)


def must_compile() -> bool:
    """Whether the elimination is not on disk yet, as compiled from this file: the first run takes longer."""
    stats: Any = getattr(eliminate_poses, "stats", None)
    if stats is None:  # compilation is switched off (NUMBA_DISABLE_JIT)
        return False
    source = Path(__file__).stat().st_mtime
    stored = Path(stats.cache_path).glob("_kernel._eliminating*.nbi")
    return not any(index.stat().st_mtime >= source for index in stored)


# In the loops below small vectors are numbers and tuples, never views of arrays: to make and drop a view
# costs as much as the arithmetic on it.

Tangents: TypeAlias = tuple[float, ...]
"""Basis (4, 3) of the tangent space of S^3 at a landmark, by rows."""

NONE, HUBER, CAUCHY = 0, 1, 2
"""Kinds of losses."""


@compiled
def loss_cost(kind: int, width: float, squared: float) -> float:
    """Loss rho of a whitened residual's squared length; rho is half of it near zero."""
    if kind == HUBER and squared > width * width:
        return width * (math.sqrt(squared) - 0.5 * width)
    if kind == CAUCHY:
        return 0.5 * width * width * math.log1p(squared / (width * width))
    return 0.5 * squared


@compiled
def loss_weight(kind: int, width: float, squared: float) -> float:
    """The weight that makes the square's gradient that of the loss."""
    if kind == HUBER and squared > width * width:
        return width / math.sqrt(squared)
    if kind == CAUCHY:
        return 1.0 / (1.0 + squared / (width * width))
    return 1.0


@compiled
def tangents(a0: float, a1: float, a2: float, a3: float) -> Tangents:
    """Orthonormal basis (4, 3) of the tangent space of S^3 at a unit vector, by a Householder reflection.

    The reflection takes the vector to the first axis (or its opposite); the images of the other three
    axes span the tangent space.
    """
    a0 += 1.0 if a0 >= 0 else -1.0
    s = 2.0 / (a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3)
    s1, s2, s3 = s * a1, s * a2, s * a3
    return (
        *(-s1 * a0, -s2 * a0, -s3 * a0),
        *(1.0 - s1 * a1, -s1 * a2, -s1 * a3),
        *(-s1 * a2, 1.0 - s2 * a2, -s2 * a3),
        *(-s1 * a3, -s2 * a3, 1.0 - s3 * a3),
    )


@compiled
def along(t: Tangents, d0: float, d1: float, d2: float, d3: float) -> tuple[float, float, float]:
    """A derivative by (X, w), taken to one by the tangents."""
    return (
        d0 * t[0] + d1 * t[3] + d2 * t[6] + d3 * t[9],
        d0 * t[1] + d1 * t[4] + d2 * t[7] + d3 * t[10],
        d0 * t[2] + d1 * t[5] + d2 * t[8] + d3 * t[11],
    )


@compiled
def retracted(
    t: Tangents, a0: float, a1: float, a2: float, a3: float, s0: float, s1: float, s2: float
) -> tuple[float, float, float, float]:
    """A unit vector moved by a step along its tangents, and brought back to the sphere."""
    x0 = a0 + t[0] * s0 + t[1] * s1 + t[2] * s2
    x1 = a1 + t[3] * s0 + t[4] * s1 + t[5] * s2
    x2 = a2 + t[6] * s0 + t[7] * s1 + t[8] * s2
    x3 = a3 + t[9] * s0 + t[10] * s1 + t[11] * s2
    per_length = 1.0 / np.sqrt(x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3)
    return x0 * per_length, x1 * per_length, x2 * per_length, x3 * per_length


@compiled
def sight(
    to_pixel: FloatArray,
    image: int,
    y0: float,
    y1: float,
    y2: float,
    uv_px: FloatArray,
    whitening: FloatArray,
    i: int,
) -> tuple[bool, float, float, float, float, float]:
    """Observation i of an image along a world ray y: in front, whitened residual, u, v and 1 / depth.

    The ray is X - w offset, the camera's centre being at `offset` from the landmark's origin. What is behind
    the camera gives the residual of the mirrored point, which means nothing.
    """
    p2 = to_pixel[image, 2, 0] * y0 + to_pixel[image, 2, 1] * y1 + to_pixel[image, 2, 2] * y2
    per_depth = 1.0 / (p2 if abs(p2) > 1e-12 else 1e-12)
    u = (to_pixel[image, 0, 0] * y0 + to_pixel[image, 0, 1] * y1 + to_pixel[image, 0, 2] * y2) * per_depth
    v = (to_pixel[image, 1, 0] * y0 + to_pixel[image, 1, 1] * y1 + to_pixel[image, 1, 2] * y2) * per_depth
    du, dv = u - uv_px[i, 0], v - uv_px[i, 1]
    r0 = whitening[i, 0, 0] * du + whitening[i, 0, 1] * dv
    r1 = whitening[i, 1, 0] * du + whitening[i, 1, 1] * dv
    return p2 > 1e-12, r0, r1, u, v, per_depth


@compiled
def by_ray(
    to_pixel: FloatArray, image: int, u: float, v: float, scale: float, whitening: FloatArray, i: int
) -> tuple[float, float, float, float, float, float]:
    """Derivative (2, 3), by rows, of a whitened residual by the world ray, times scale over 1 / depth."""
    a00, a01 = scale * whitening[i, 0, 0], scale * whitening[i, 0, 1]
    a10, a11 = scale * whitening[i, 1, 0], scale * whitening[i, 1, 1]
    gu0 = to_pixel[image, 0, 0] - u * to_pixel[image, 2, 0]
    gu1 = to_pixel[image, 0, 1] - u * to_pixel[image, 2, 1]
    gu2 = to_pixel[image, 0, 2] - u * to_pixel[image, 2, 2]
    gv0 = to_pixel[image, 1, 0] - v * to_pixel[image, 2, 0]
    gv1 = to_pixel[image, 1, 1] - v * to_pixel[image, 2, 1]
    gv2 = to_pixel[image, 1, 2] - v * to_pixel[image, 2, 2]
    return (
        *(a00 * gu0 + a01 * gv0, a00 * gu1 + a01 * gv1, a00 * gu2 + a01 * gv2),
        *(a10 * gu0 + a11 * gv0, a10 * gu1 + a11 * gv1, a10 * gu2 + a11 * gv2),
    )


class Sights(NamedTuple):
    """Observations of landmarks in the order of elimination; structure that no step changes.

    An *occurrence* is one unit (images moved alike by all variables) that sees a landmark. Columns of a block
    come in *pairs*, each segment beginning with one. A landmark touches some pairs, ascending; `place` says
    which of them each segment of an occurrence's chain begins with.
    """

    image: IntArray
    """(n,)"""
    uv_px: FloatArray
    """(n, 2)"""
    whitening: FloatArray
    """(n, 2, 2)"""
    occurrence_begin: IntArray
    """(occurrences + 1,) first observation of each"""
    occurrence_unit: IntArray
    """(occurrences,)"""
    occurrence_row: IntArray
    """(occurrences,) the unit's row among those of its block"""
    place_begin: IntArray
    """(occurrences + 1,) first entry in `place` of each"""
    place: IntArray
    landmark_begin: IntArray
    """(landmarks + 1,) first occurrence of each"""
    pair_begin: IntArray
    """(landmarks + 1,) first pair of each"""
    pair: IntArray
    """(pairs,) number of the pair in the block"""


class Bearings(NamedTuple):
    """Cameras at one linearisation point, and how they move with the variables."""

    to_pixel: FloatArray
    """(images, 3, 3) world directions to homogeneous pixels"""
    centre_m: FloatArray
    """(images, 3)"""
    calibration: FloatArray
    """(images, 3, 3) K"""
    unit_R: FloatArray
    """(units, 3, 3) world_R_base: the body whose twist moves the unit's images"""
    unit_t: FloatArray
    """(units, 3)"""
    segment_begin: IntArray
    """(units + 1,)"""
    segment_width: IntArray
    """(segments,) columns of each"""
    plain: BoolArray
    """(segments,) whether the chain is the unit matrix: the variable's tangent is the base's twist"""
    chain: FloatArray
    """(segments, rows, widest): takes a variable's tangent to the base's twist (6 rows, rotation first), and
    where calibrations are free to changes of fx, fy, skew, cx, cy (5 more)"""


class Reduced(NamedTuple):
    """What is left of landmarks after elimination, by landmark."""

    factor: FloatArray
    """(landmarks, 6) lower Cholesky factor of V by rows"""
    gamma: FloatArray
    """(landmarks, 3) L^-1 g"""
    arms: FloatArray
    """(6 pairs,) L^-1 E' of each landmark: three rows of two columns for each pair"""
    cost: FloatArray
    """(landmarks,) true robust cost"""
    undetermined: BoolArray
    """(landmarks,) whether the weak prior alone holds a direction"""


WEAK_PRIOR = 1e-12
"""Weak prior of a landmark: its information, over the trace of what the landmark's observations know."""
_UNDETERMINED = 1e-9
"""A direction with a pivot below this share of the trace is called undetermined, and gets the weak prior."""
BEHIND_COST = 0.5 * 1000.0**2
"""What an observation of a landmark behind its camera costs: as much as one that is 1000 sigma off. It pulls
nowhere, so that one bad match holds back nobody; the solver sets aside and counts what ends there."""
SURPRISE, SURPRISE_COST = 2.0, 10.0
"""A step is shortened for a landmark whose cost more than doubles by more than this."""


@compiled
def _chain(
    unit_H: FloatArray,
    unit_s: FloatArray,
    unit_of: IntArray,
    bearings: Bearings,
    segment_column: IntArray,
    tiles: FloatArray,
    s: FloatArray,
) -> None:
    """Add the units' own information, taken through their chains, to the upper triangle of S and to s."""
    n_pairs = len(s) // 2
    rows, widest = bearings.chain.shape[1], bearings.chain.shape[2]
    half = np.empty((rows, widest))
    for row in range(len(unit_of)):
        unit = unit_of[row]
        if unit < 0:
            continue
        for p in range(rows):
            for q in range(p):
                unit_H[row, p, q] = unit_H[row, q, p]
        for a in range(bearings.segment_begin[unit], bearings.segment_begin[unit + 1]):
            chain_a, column_a, width_a = bearings.chain[a], segment_column[a], bearings.segment_width[a]
            for p in range(rows):
                for q in range(width_a):
                    total = 0.0
                    for k in range(rows):
                        total += unit_H[row, p, k] * chain_a[k, q]
                    half[p, q] = total
            for q in range(width_a):
                total = 0.0
                for k in range(rows):
                    total += unit_s[row, k] * chain_a[k, q]
                s[column_a + q] += total
            for b in range(bearings.segment_begin[unit], bearings.segment_begin[unit + 1]):
                chain_b, column_b = bearings.chain[b], segment_column[b]
                if column_b > column_a:
                    continue
                for p in range(bearings.segment_width[b]):
                    for q in range(width_a):
                        total = 0.0
                        for k in range(rows):
                            total += chain_b[k, p] * half[k, q]
                        tiles[_tile(column_b + p, column_a + q, n_pairs)] += total


@compiled
def _tile(row: int, column: int, n_pairs: int) -> int:
    """Where an entry of a matrix of 2 x 2 tiles is: these by rows, and so each one's entries."""
    return 4 * ((row >> 1) * n_pairs + (column >> 1)) + 2 * (row & 1) + (column & 1)


def subtract_row_plainly(
    tiles: FloatArray, row: int, arms: FloatArray, first: int, last: int, pair: IntArray
) -> None:
    """Take the products of pair `first` with the pairs first to last of a landmark from a row of tiles."""
    for q in range(first, last):
        for h in range(2):
            for m in range(2):
                for k in range(0, 6, 2):
                    tiles[4 * (row + pair[q]) + 2 * h + m] -= arms[6 * first + k + h] * arms[6 * q + k + m]


def _subtract_row_in_vectors(
    typing: Any, tiles: Any, row: Any, arms: Any, first: Any, last: Any, pair: Any
) -> Any:
    """`subtract_row_plainly` in vectors of four: a tile is one, and takes three multiply-adds.

    The innermost loop of the elimination. The compiler, left to itself, takes each entry alone: three times
    as long.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        tiles, row, arms, first, last, pair = (
            context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
            for kind, value in zip(signature.args, arguments, strict=True)
        )
        word, number = row.type, ir.DoubleType()
        four = ir.VectorType(number, 4)
        contract = ("contract",)

        def spread(pair_row: Any, k: int, order: tuple[int, ...]) -> Any:
            """Row k of a pair's arms, its two numbers in the given order."""
            at = builder.add(builder.mul(pair_row, word(6)), word(2 * k))
            two = builder.load(
                builder.bitcast(builder.gep(arms, [at]), ir.VectorType(number, 2).as_pointer()), align=8
            )
            return builder.shuffle_vector(two, two, ir.Constant(ir.VectorType(ir.IntType(32), 4), order))

        own = [spread(first, k, (0, 0, 1, 1)) for k in range(3)]
        with cgutils.for_range_slice(builder, first, last, word(1), word) as (q, _):
            column = builder.load(builder.gep(pair, [q]))
            at = builder.mul(builder.add(row, column), word(4))
            tile = builder.bitcast(builder.gep(tiles, [at]), four.as_pointer())
            left = builder.load(tile, align=8)
            for k in range(3):
                product = builder.fmul(own[k], spread(q, k, (0, 1, 0, 1)), flags=contract)
                left = builder.fsub(left, product, flags=contract)
            builder.store(left, tile, align=8)
        return context.get_dummy_value()

    return types.void(tiles, types.intp, arms, types.intp, types.intp, pair), generate


_config: Any = numba.config
subtract_row: Any = subtract_row_plainly if _config.DISABLE_JIT else intrinsic(_subtract_row_in_vectors)
"""The one that is called."""


@compiled
def _by_calibration(
    calibration: FloatArray,
    image: int,
    u: float,
    v: float,
    whitening: FloatArray,
    i: int,
    root: float,
    jac: FloatArray,
) -> None:
    """An observation's Jacobian (2, 5) by fx, fy, skew, cx and cy (thesis eq. 4.2), at the pixel u, v."""
    y = (v - calibration[image, 1, 2]) / calibration[image, 1, 1]
    x = (u - calibration[image, 0, 2] - calibration[image, 0, 1] * y) / calibration[image, 0, 0]
    for m in range(2):
        wu, wv = root * whitening[i, m, 0], root * whitening[i, m, 1]
        jac[m, 0], jac[m, 1], jac[m, 2], jac[m, 3], jac[m, 4] = wu * x, wv * y, wu * y, wu, wv


@compiled
def _add_six(
    to: FloatArray, at: int, a0: float, a1: float, a2: float, a3: float, a4: float, a5: float
) -> None:
    """Add six numbers to neighbours of an array."""
    b0, b1, b2, b3, b4, b5 = to[at], to[at + 1], to[at + 2], to[at + 3], to[at + 4], to[at + 5]
    to[at], to[at + 1], to[at + 2] = b0 + a0, b1 + a1, b2 + a2
    to[at + 3], to[at + 4], to[at + 5] = b3 + a3, b4 + a4, b5 + a5


def _eliminating(rows: int) -> Callable[..., None]:
    """The elimination kernel for chains of 6 rows (poses) or 11 (poses and calibrations)."""
    more = rows - 6

    @compiled
    def eliminate(
        sights: Sights,
        bearings: Bearings,
        vector: FloatArray,
        origin_m: FloatArray,
        kind: int,
        width: float,
        begin: int,
        end: int,
        segment_column: IntArray,
        n_units: int,
        reduced: Reduced,
        tiles: FloatArray,
        s: FloatArray,
    ) -> None:
        unit_H = np.zeros((n_units, rows, rows))
        unit_s = np.zeros((n_units, rows))
        unit_of = np.full(n_units, -1)
        to_pixel, centre_m = bearings.to_pixel, bearings.centre_m
        unit_R, unit_t, chain = bearings.unit_R, bearings.unit_t, bearings.chain
        uv_px, whitening, arms = sights.uv_px, sights.whitening, reduced.arms
        pair_begin, pair, n_pairs = sights.pair_begin, sights.pair, len(s) // 2
        # Beyond the pose: an observation's Jacobian, and an occurrence's products with landmark, base.
        jac, cross, with_base = np.empty((2, more)), np.empty((more, 3)), np.empty((3, more))
        for j in range(begin, end):
            X0, X1, X2, w = vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3]
            O0, O1, O2 = origin_m[j, 0], origin_m[j, 1], origin_m[j, 2]
            t = tangents(X0, X1, X2, w)
            v00 = v10 = v11 = v20 = v21 = v22 = g0 = g1 = g2 = 0.0
            cost = 0.0
            first_pair, last_pair = pair_begin[j], pair_begin[j + 1]
            for q in range(6 * first_pair, 6 * last_pair):
                arms[q] = 0.0
            for o in range(sights.landmark_begin[j], sights.landmark_begin[j + 1]):
                unit, row = sights.occurrence_unit[o], sights.occurrence_row[o]
                unit_of[row] = unit
                R00, R01, R02 = unit_R[unit, 0, 0], unit_R[unit, 0, 1], unit_R[unit, 0, 2]
                R10, R11, R12 = unit_R[unit, 1, 0], unit_R[unit, 1, 1], unit_R[unit, 1, 2]
                R20, R21, R22 = unit_R[unit, 2, 0], unit_R[unit, 2, 1], unit_R[unit, 2, 2]
                # With e the residual's derivative by the ray in the base's frame and b that by the landmark:
                # the sums over the occurrence of e'e, e'b and e'r.
                m00 = m01 = m02 = m11 = m12 = m22 = 0.0
                n00 = n01 = n02 = n10 = n11 = n12 = n20 = n21 = n22 = 0.0
                k0 = k1 = k2 = 0.0
                if more:
                    cross[:] = 0.0
                    with_base[:] = 0.0
                for i in range(sights.occurrence_begin[o], sights.occurrence_begin[o + 1]):
                    image = sights.image[i]
                    c0, c1, c2 = centre_m[image, 0] - O0, centre_m[image, 1] - O1, centre_m[image, 2] - O2
                    in_front, r0, r1, u, v, per_depth = sight(
                        to_pixel, image, X0 - w * c0, X1 - w * c1, X2 - w * c2, uv_px, whitening, i
                    )
                    if not in_front:
                        cost += BEHIND_COST
                        continue
                    squared = r0 * r0 + r1 * r1
                    cost += loss_cost(kind, width, squared)
                    root = 1.0 if kind == NONE else np.sqrt(loss_weight(kind, width, squared))
                    r0, r1 = root * r0, root * r1
                    d00, d01, d02, d10, d11, d12 = by_ray(
                        to_pixel, image, u, v, root * per_depth, whitening, i
                    )
                    b00, b01, b02 = along(t, d00, d01, d02, -(d00 * c0 + d01 * c1 + d02 * c2))
                    b10, b11, b12 = along(t, d10, d11, d12, -(d10 * c0 + d11 * c1 + d12 * c2))
                    e00 = d00 * R00 + d01 * R10 + d02 * R20
                    e01 = d00 * R01 + d01 * R11 + d02 * R21
                    e02 = d00 * R02 + d01 * R12 + d02 * R22
                    e10 = d10 * R00 + d11 * R10 + d12 * R20
                    e11 = d10 * R01 + d11 * R11 + d12 * R21
                    e12 = d10 * R02 + d11 * R12 + d12 * R22
                    v00 += b00 * b00 + b10 * b10
                    v10 += b01 * b00 + b11 * b10
                    v11 += b01 * b01 + b11 * b11
                    v20 += b02 * b00 + b12 * b10
                    v21 += b02 * b01 + b12 * b11
                    v22 += b02 * b02 + b12 * b12
                    g0 += b00 * r0 + b10 * r1
                    g1 += b01 * r0 + b11 * r1
                    g2 += b02 * r0 + b12 * r1
                    m00 += e00 * e00 + e10 * e10
                    m01 += e00 * e01 + e10 * e11
                    m02 += e00 * e02 + e10 * e12
                    m11 += e01 * e01 + e11 * e11
                    m12 += e01 * e02 + e11 * e12
                    m22 += e02 * e02 + e12 * e12
                    n00, n01, n02 = (
                        n00 + e00 * b00 + e10 * b10,
                        n01 + e00 * b01 + e10 * b11,
                        n02 + e00 * b02 + e10 * b12,
                    )
                    n10, n11, n12 = (
                        n10 + e01 * b00 + e11 * b10,
                        n11 + e01 * b01 + e11 * b11,
                        n12 + e01 * b02 + e11 * b12,
                    )
                    n20, n21, n22 = (
                        n20 + e02 * b00 + e12 * b10,
                        n21 + e02 * b01 + e12 * b11,
                        n22 + e02 * b02 + e12 * b12,
                    )
                    k0 += e00 * r0 + e10 * r1
                    k1 += e01 * r0 + e11 * r1
                    k2 += e02 * r0 + e12 * r1
                    if more:
                        _by_calibration(bearings.calibration, image, u, v, whitening, i, root, jac)
                        for p in range(more):
                            ja, jb = jac[0, p], jac[1, p]
                            cross[p, 0] += ja * b00 + jb * b10
                            cross[p, 1] += ja * b01 + jb * b11
                            cross[p, 2] += ja * b02 + jb * b12
                            with_base[0, p] += ja * e00 + jb * e10
                            with_base[1, p] += ja * e01 + jb * e11
                            with_base[2, p] += ja * e02 + jb * e12
                            unit_s[row, 6 + p] += ja * r0 + jb * r1
                            for q in range(p, more):
                                unit_H[row, 6 + p, 6 + q] += ja * jac[0, q] + jb * jac[1, q]
                # A twist of the base moves the ray by [x]_x times its rotation and -w times its translation,
                # x being the ray from the base to the landmark.
                y0 = X0 - w * (unit_t[unit, 0] - O0)
                y1 = X1 - w * (unit_t[unit, 1] - O1)
                y2 = X2 - w * (unit_t[unit, 2] - O2)
                x0 = R00 * y0 + R10 * y1 + R20 * y2
                x1 = R01 * y0 + R11 * y1 + R21 * y2
                x2 = R02 * y0 + R12 * y1 + R22 * y2
                q00, q01, q02 = m01 * x2 - m02 * x1, m02 * x0 - m00 * x2, m00 * x1 - m01 * x0
                q10, q11, q12 = m11 * x2 - m12 * x1, m12 * x0 - m01 * x2, m01 * x1 - m11 * x0
                q20, q21, q22 = m12 * x2 - m22 * x1, m22 * x0 - m02 * x2, m02 * x1 - m12 * x0
                unit_H[row, 0, 0] += x2 * q10 - x1 * q20
                unit_H[row, 0, 1] += x2 * q11 - x1 * q21
                unit_H[row, 0, 2] += x2 * q12 - x1 * q22
                unit_H[row, 1, 1] += x0 * q21 - x2 * q01
                unit_H[row, 1, 2] += x0 * q22 - x2 * q02
                unit_H[row, 2, 2] += x1 * q02 - x0 * q12
                unit_H[row, 0, 3] -= w * q00
                unit_H[row, 0, 4] -= w * q10
                unit_H[row, 0, 5] -= w * q20
                unit_H[row, 1, 3] -= w * q01
                unit_H[row, 1, 4] -= w * q11
                unit_H[row, 1, 5] -= w * q21
                unit_H[row, 2, 3] -= w * q02
                unit_H[row, 2, 4] -= w * q12
                unit_H[row, 2, 5] -= w * q22
                unit_H[row, 3, 3] += w * w * m00
                unit_H[row, 3, 4] += w * w * m01
                unit_H[row, 3, 5] += w * w * m02
                unit_H[row, 4, 4] += w * w * m11
                unit_H[row, 4, 5] += w * w * m12
                unit_H[row, 5, 5] += w * w * m22
                unit_s[row, 0] += x2 * k1 - x1 * k2
                unit_s[row, 1] += x0 * k2 - x2 * k0
                unit_s[row, 2] += x1 * k0 - x0 * k1
                unit_s[row, 3] -= w * k0
                unit_s[row, 4] -= w * k1
                unit_s[row, 5] -= w * k2
                # The twist's part of E' (6, 3), a row each.
                z00, z01, z02 = x2 * n10 - x1 * n20, x2 * n11 - x1 * n21, x2 * n12 - x1 * n22
                z10, z11, z12 = x0 * n20 - x2 * n00, x0 * n21 - x2 * n01, x0 * n22 - x2 * n02
                z20, z21, z22 = x1 * n00 - x0 * n10, x1 * n01 - x0 * n11, x1 * n02 - x0 * n12
                z30, z31, z32 = -w * n00, -w * n01, -w * n02
                z40, z41, z42 = -w * n10, -w * n11, -w * n12
                z50, z51, z52 = -w * n20, -w * n21, -w * n22
                if more:
                    for p in range(more):
                        f0, f1, f2 = with_base[0, p], with_base[1, p], with_base[2, p]
                        unit_H[row, 0, 6 + p] += x2 * f1 - x1 * f2
                        unit_H[row, 1, 6 + p] += x0 * f2 - x2 * f0
                        unit_H[row, 2, 6 + p] += x1 * f0 - x0 * f1
                        unit_H[row, 3, 6 + p] -= w * f0
                        unit_H[row, 4, 6 + p] -= w * f1
                        unit_H[row, 5, 6 + p] -= w * f2
                place = sights.place_begin[o]
                for segment in range(bearings.segment_begin[unit], bearings.segment_begin[unit + 1]):
                    q = 6 * (first_pair + sights.place[place])
                    place += 1
                    if bearings.plain[segment]:
                        _add_six(arms, q, z00, z10, z01, z11, z02, z12)
                        _add_six(arms, q + 6, z20, z30, z21, z31, z22, z32)
                        _add_six(arms, q + 12, z40, z50, z41, z51, z42, z52)
                        continue
                    for k in range(bearings.segment_width[segment]):
                        h0, h1, h2 = chain[segment, 0, k], chain[segment, 1, k], chain[segment, 2, k]
                        h3, h4, h5 = chain[segment, 3, k], chain[segment, 4, k], chain[segment, 5, k]
                        a0 = h0 * z00 + h1 * z10 + h2 * z20 + h3 * z30 + h4 * z40 + h5 * z50
                        a1 = h0 * z01 + h1 * z11 + h2 * z21 + h3 * z31 + h4 * z41 + h5 * z51
                        a2 = h0 * z02 + h1 * z12 + h2 * z22 + h3 * z32 + h4 * z42 + h5 * z52
                        if more:
                            for p in range(more):
                                a0 += chain[segment, 6 + p, k] * cross[p, 0]
                                a1 += chain[segment, 6 + p, k] * cross[p, 1]
                                a2 += chain[segment, 6 + p, k] * cross[p, 2]
                        at = q + 6 * (k >> 1) + (k & 1)
                        arms[at] += a0
                        arms[at + 2] += a1
                        arms[at + 4] += a2
            trace = v00 + v11 + v22
            # The weak prior goes to pivots that need it: on all landmarks together it would hold the world.
            floor, prior = _UNDETERMINED * trace, WEAK_PRIOR * trace + 1e-300
            l00 = np.sqrt(v00 if v00 > floor else v00 + prior)
            l10, l20 = v10 / l00, v20 / l00
            p1 = max(v11 - l10 * l10, 0.0)
            l11 = np.sqrt(p1 if p1 > floor else p1 + prior)
            l21 = (v21 - l20 * l10) / l11
            p2 = max(v22 - l20 * l20 - l21 * l21, 0.0)
            l22 = np.sqrt(p2 if p2 > floor else p2 + prior)
            reduced.undetermined[j] = min(v00, p1, p2) <= floor
            factor = reduced.factor
            factor[j, 0], factor[j, 1], factor[j, 2] = l00, l10, l11
            factor[j, 3], factor[j, 4], factor[j, 5] = l20, l21, l22
            per0, per1, per2 = 1.0 / l00, 1.0 / l11, 1.0 / l22
            g0 = g0 * per0
            g1 = (g1 - l10 * g0) * per1
            g2 = (g2 - l20 * g0 - l21 * g1) * per2
            reduced.gamma[j, 0], reduced.gamma[j, 1], reduced.gamma[j, 2] = g0, g1, g2
            reduced.cost[j] = cost
            for p in range(first_pair, last_pair):
                at, column = 6 * p, 2 * pair[p]
                for q in range(at, at + 2):
                    a0 = arms[q] * per0
                    a1 = (arms[q + 2] - l10 * a0) * per1
                    a2 = (arms[q + 4] - l20 * a0 - l21 * a1) * per2
                    arms[q], arms[q + 2], arms[q + 4] = a0, a1, a2
                    s[column] -= a0 * g0 + a1 * g1 + a2 * g2
                    column += 1
            # W'W: below the diagonal of a tile on it, this leaves numbers that mean nothing.
            for p in range(first_pair, last_pair):
                subtract_row(tiles, pair[p] * n_pairs, arms, p, last_pair, pair)
        _chain(unit_H, unit_s, unit_of, bearings, segment_column, tiles, s)

    return eliminate


eliminate_poses = _eliminating(6)
"""Linearise and eliminate landmarks begin to end; adds to S (upper triangle, in tiles) and s of their block.

Exact Schur complement of the whitened, robustly weighted system: S = A'A - sum E V^-1 E' and
s = A'r - sum E V^-1 g with E = A'B, V = B'B, g = B'r for the cameras' Jacobian A and each landmark's B.
V gets the weak prior where it needs one, and no damping."""
eliminate_calibrations = _eliminating(11)
"""The same for chains with calibrations."""


@compiled
def follow(
    sights: Sights,
    bearings: Bearings,
    vector: FloatArray,
    origin_m: FloatArray,
    kind: int,
    width: float,
    begin: int,
    end: int,
    reduced: Reduced,
    dx: FloatArray,
    moved: FloatArray,
    cost: FloatArray,
) -> None:
    """Landmarks begin to end follow the step dx (columns of their block,) of the cameras; their true costs.

    `bearings` are the cameras after the step. The step dp = -V^-1 (g + E' dx) is the landmark's part of the
    joint step. Where it ends behind a camera or costs far more than before, a shorter one that costs least is
    taken, or none: a landmark that its linear prediction leads astray does not hold back all others.
    """
    arms, factor, gamma = reduced.arms, reduced.factor, reduced.gamma
    for j in range(begin, end):
        y0, y1, y2 = gamma[j, 0], gamma[j, 1], gamma[j, 2]
        for p in range(sights.pair_begin[j], sights.pair_begin[j + 1]):
            d0, d1, q = dx[2 * sights.pair[p]], dx[2 * sights.pair[p] + 1], 6 * p
            y0 += arms[q] * d0 + arms[q + 1] * d1
            y1 += arms[q + 2] * d0 + arms[q + 3] * d1
            y2 += arms[q + 4] * d0 + arms[q + 5] * d1
        s2 = -y2 / factor[j, 5]
        s1 = (-y1 - factor[j, 4] * s2) / factor[j, 2]
        s0 = (-y0 - factor[j, 1] * s1 - factor[j, 3] * s2) / factor[j, 0]
        limit = SURPRISE * reduced.cost[j] + SURPRISE_COST
        a0, a1, a2, a3 = vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3]
        t = tangents(a0, a1, a2, a3)
        cost[j] = np.inf
        moved[j, 0], moved[j, 1], moved[j, 2], moved[j, 3] = a0, a1, a2, a3
        for share in (1.0, 0.5, 0.25, 0.0625, 0.0):
            x0, x1, x2, w = retracted(t, a0, a1, a2, a3, share * s0, share * s1, share * s2)
            found = _landmark_cost(sights, bearings, x0, x1, x2, w, origin_m, kind, width, j)
            if found < cost[j]:
                cost[j] = found
                moved[j, 0], moved[j, 1], moved[j, 2], moved[j, 3] = x0, x1, x2, w
            if found <= limit:
                break


@compiled
def _landmark_cost(
    sights: Sights,
    bearings: Bearings,
    x0: float,
    x1: float,
    x2: float,
    w: float,
    origin_m: FloatArray,
    kind: int,
    width: float,
    j: int,
) -> float:
    """True cost of landmark j if it were at (x, w)."""
    to_pixel, centre_m = bearings.to_pixel, bearings.centre_m
    O0, O1, O2 = origin_m[j, 0], origin_m[j, 1], origin_m[j, 2]
    cost = 0.0
    first, last = sights.landmark_begin[j], sights.landmark_begin[j + 1]
    for i in range(sights.occurrence_begin[first], sights.occurrence_begin[last]):
        image = sights.image[i]
        y0 = x0 - w * (centre_m[image, 0] - O0)
        y1 = x1 - w * (centre_m[image, 1] - O1)
        y2 = x2 - w * (centre_m[image, 2] - O2)
        in_front, r0, r1, _, _, _ = sight(to_pixel, image, y0, y1, y2, sights.uv_px, sights.whitening, i)
        cost += loss_cost(kind, width, r0 * r0 + r1 * r1) if in_front else BEHIND_COST
    return cost


@compiled
def costs(
    sights: Sights,
    bearings: Bearings,
    which: IntArray,
    vector: FloatArray,
    origin_m: FloatArray,
    kind: int,
    width: float,
    cost: FloatArray,
) -> None:
    """True costs (m,) of the landmarks `which` (m,) if these were at `vector` (m, 4)."""
    for i in range(len(which)):
        j = which[i]
        x0, x1, x2, w = vector[i, 0], vector[i, 1], vector[i, 2], vector[i, 3]
        cost[i] = _landmark_cost(sights, bearings, x0, x1, x2, w, origin_m, kind, width, j)


@compiled
def arrange(
    landmarks: IntArray,
    begin: IntArray,
    image: IntArray,
    image_unit: IntArray,
    segment_begin: IntArray,
    segment_pairs: IntArray,
    segment_pair: IntArray,
    n_pairs: int,
    first_landmark: int,
    rows: IntArray,
    sights: Sights,
    cursor: IntArray,
) -> int:
    """Put a block's landmarks into the order of elimination; returns how many units see them.

    `landmarks` (m,) are rows in measurements whose observations of landmark j are begin[j] to begin[j + 1].
    Fills `rows` (n,), the measurement of each observation, and the structure of `sights` from where `cursor`
    (observations, occurrences, places, pairs) stands, and moves the cursor on.
    """
    unit_row = np.full(len(segment_begin) - 1, -1)
    place_of = np.full(n_pairs, -1)
    starts = np.empty(n_pairs, dtype=np.int64)
    n_units = 0
    n_obs, n_occurrences, n_places, n_touched = cursor[0], cursor[1], cursor[2], cursor[3]
    for m in range(len(landmarks)):
        j, first_occurrence = landmarks[m], n_occurrences
        first_obs, last_obs = n_obs, n_obs + begin[j + 1] - begin[j]
        for i in range(begin[j], begin[j + 1]):  # sorted by unit as they come
            unit, k = image_unit[image[i]], n_obs
            while k > first_obs and image_unit[sights.image[k - 1]] > unit:
                sights.image[k], rows[k] = sights.image[k - 1], rows[k - 1]
                k -= 1
            sights.image[k], rows[k] = image[i], i
            n_obs += 1
        n_starts, before = 0, -1
        for i in range(first_obs, last_obs):
            unit = image_unit[sights.image[i]]
            if unit == before:
                continue
            before = unit
            if unit_row[unit] < 0:
                unit_row[unit] = n_units
                n_units += 1
            sights.occurrence_begin[n_occurrences] = i
            sights.occurrence_unit[n_occurrences] = unit
            sights.occurrence_row[n_occurrences] = unit_row[unit]
            n_occurrences += 1
            for segment in range(segment_begin[unit], segment_begin[unit + 1]):
                first = segment_pair[segment]
                if place_of[first] < 0:
                    place_of[first] = segment_pairs[segment]
                    k = n_starts
                    while k > 0 and starts[k - 1] > first:
                        starts[k] = starts[k - 1]
                        k -= 1
                    starts[k] = first
                    n_starts += 1
        sights.landmark_begin[first_landmark + m] = first_occurrence
        sights.pair_begin[first_landmark + m] = n_touched
        place = 0
        for k in range(n_starts):
            many = place_of[starts[k]]
            place_of[starts[k]] = place
            for q in range(many):
                sights.pair[n_touched] = starts[k] + q
                n_touched += 1
            place += many
        for o in range(first_occurrence, n_occurrences):
            sights.place_begin[o] = n_places
            unit = sights.occurrence_unit[o]
            for segment in range(segment_begin[unit], segment_begin[unit + 1]):
                sights.place[n_places] = place_of[segment_pair[segment]]
                n_places += 1
        for k in range(n_starts):
            place_of[starts[k]] = -1
    cursor[0], cursor[1], cursor[2], cursor[3] = n_obs, n_occurrences, n_places, n_touched
    return n_units


@compiled
def gather(
    tiles: FloatArray,
    s: FloatArray,
    first: int,
    last: int,
    row: IntArray,
    column: IntArray,
    panel: FloatArray,
) -> None:
    """Add rows first to last of a block's system to a group's panel, its last column being s.

    `row` and `column` say where each of the block's columns is in the panel; -1: nowhere.
    """
    n_pairs = len(s) // 2
    for p in range(first, last):
        r = row[p]
        if r < 0:
            continue
        panel[r, panel.shape[1] - 1] += s[p]
        for q in range(p, len(s)):
            if column[q] >= 0:
                panel[r, column[q]] += tiles[_tile(p, q, n_pairs)]


@compiled
def spread(
    sights: Sights,
    reduced: Reduced,
    vector: FloatArray,
    joint: FloatArray,
    begin: int,
    end: int,
    covariance_m2: FloatArray,
) -> None:
    """Covariances (landmarks, 3, 3) of points X / w, begin to end, given that of their block's variables.

    L^-T (I + W C W') L^-1 in the tangent space, with W the `arms`, taken through the derivative of X / w.
    """
    arms, pair = reduced.arms, sights.pair
    tangent, half, point = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for j in range(begin, end):
        first, last = sights.pair_begin[j], sights.pair_begin[j + 1]
        for a in range(3):
            for b in range(3):
                tangent[a, b] = 1.0 if a == b else 0.0
        for p in range(2 * first, 2 * last):
            row, i = 2 * pair[p >> 1] + (p & 1), 6 * (p >> 1) + (p & 1)
            for q in range(2 * first, 2 * last):
                c, k = joint[row, 2 * pair[q >> 1] + (q & 1)], 6 * (q >> 1) + (q & 1)
                for a in range(3):
                    for b in range(3):
                        tangent[a, b] += arms[i + 2 * a] * c * arms[k + 2 * b]
        w = vector[j, 3]
        t = tangents(vector[j, 0], vector[j, 1], vector[j, 2], w)
        for k in range(3):
            far = vector[j, k] / (w * w)
            for a in range(3):
                point[k, a] = t[3 * k + a] / w - far * t[9 + a]
        f = reduced.factor[j]
        for k in range(3):  # rows of point L^-T
            half[k, 0] = point[k, 0] / f[0]
            half[k, 1] = (point[k, 1] - f[1] * half[k, 0]) / f[2]
            half[k, 2] = (point[k, 2] - f[3] * half[k, 0] - f[4] * half[k, 1]) / f[5]
        for k in range(3):
            for m in range(3):
                total = 0.0
                for a in range(3):
                    for b in range(3):
                        total += half[k, a] * tangent[a, b] * half[m, b]
                covariance_m2[j, k, m] = total


# --- landmarks with all cameras held: each on its own, so that parts of them may run in any order ---

_REFINE_BEHIND_COST = 1e12
"""Of an observation behind its camera: more than any residual, and differences of residuals still show."""
_REFINE_STEPS = 15
_NO_BASELINE_M = 1e-9
_MIN_REDUNDANCY = 0.02
"""Directions of a residual that keep less than this of the noise's variance cannot show an error."""


class Seen(NamedTuple):
    """Observations sorted by landmark, and the cameras that made them."""

    begin: IntArray
    """(landmarks + 1,) first observation of each landmark; the last entry is n"""
    image: IntArray
    """(n,)"""
    uv_px: FloatArray
    """(n, 2)"""
    whitening: FloatArray
    """(n, 2, 2)"""
    to_pixel: FloatArray
    """(images, 3, 3) world directions to homogeneous pixels"""
    centre_m: FloatArray
    """(images, 3)"""


# --- small pieces ---


@compiled
def eigen(a: FloatArray, turn: FloatArray) -> None:
    """Eigenvalues of a symmetric matrix (m, m) to its diagonal, eigenvectors to the columns of `turn`.

    Cyclic Jacobi rotations, in no order of size. Of a positive semidefinite matrix small eigenvalues come out
    at least as accurate as LAPACK's (Demmel and Veselić, Jacobi's method is more accurate than QR, 1992).
    Destroys `a`; ends whatever its entries are.
    """
    m = len(a)
    for p in range(m):
        for q in range(m):
            turn[p, q] = 1.0 if p == q else 0.0
    for _ in range(20):
        turned = False
        for p in range(m - 1):
            for q in range(p + 1, m):
                if not a[p, q] * a[p, q] > 1e-32 * abs(a[p, p] * a[q, q]):
                    continue
                turned = True
                ratio = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = 1.0 / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
                if ratio < 0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                a[p, p] -= t * a[p, q]
                a[q, q] += t * a[p, q]
                a[p, q] = a[q, p] = 0.0
                for k in range(m):
                    if k not in (p, q):
                        x, y = a[k, p], a[k, q]
                        a[k, p] = a[p, k] = c * x - s * y
                        a[k, q] = a[q, k] = s * x + c * y
                    x, y = turn[k, p], turn[k, q]
                    turn[k, p] = c * x - s * y
                    turn[k, q] = s * x + c * y
        if not turned:
            break


@compiled
def _observe(
    seen: Seen,
    i: int,
    t: Tangents,
    x0: float,
    x1: float,
    x2: float,
    w: float,
    O0: float,
    O1: float,
    O2: float,
) -> tuple[bool, float, float, float, float, float, float, float, float]:
    """Observation i of a landmark (x, w) about O: in front, residual, derivative (2, 3) by the tangents."""
    image = seen.image[i]
    c0, c1, c2 = seen.centre_m[image, 0] - O0, seen.centre_m[image, 1] - O1, seen.centre_m[image, 2] - O2
    in_front, r0, r1, u, v, per_depth = sight(
        seen.to_pixel, image, x0 - w * c0, x1 - w * c1, x2 - w * c2, seen.uv_px, seen.whitening, i
    )
    d00, d01, d02, d10, d11, d12 = by_ray(seen.to_pixel, image, u, v, per_depth, seen.whitening, i)
    b00, b01, b02 = along(t, d00, d01, d02, -(d00 * c0 + d01 * c1 + d02 * c2))
    b10, b11, b12 = along(t, d10, d11, d12, -(d10 * c0 + d11 * c1 + d12 * c2))
    return in_front, r0, r1, b00, b01, b02, b10, b11, b12


@compiled
def _hold_w(t: Tangents, b0: float, b1: float, b2: float) -> tuple[float, float, float]:
    """A derivative by the tangents at w = 0, less its part along w, which is one of them."""
    part = b0 * t[9] + b1 * t[10] + b2 * t[11]
    return b0 - part * t[9], b1 - part * t[10], b2 - part * t[11]


@compiled
def _add_normal(v: FloatArray, weight: float, b0: float, b1: float, b2: float) -> None:
    """Add one row of a Jacobian to a normal matrix (3, 3)."""
    v[0, 0] += weight * b0 * b0
    v[1, 1] += weight * b1 * b1
    v[2, 2] += weight * b2 * b2
    v[0, 1] += weight * b0 * b1
    v[0, 2] += weight * b0 * b2
    v[1, 2] += weight * b1 * b2
    v[1, 0], v[2, 0], v[2, 1] = v[0, 1], v[0, 2], v[1, 2]


# --- per observation ---


@compiled
def loss_costs(kind: int, width: float, squared: FloatArray, first: int, last: int, out: FloatArray) -> None:
    """Costs (n,) of squared lengths (n,)."""
    for i in range(first, last):
        out[i] = loss_cost(kind, width, squared[i])


@compiled
def loss_weights(
    kind: int, width: float, squared: FloatArray, first: int, last: int, out: FloatArray
) -> None:
    """Weights (n,) of squared lengths (n,)."""
    for i in range(first, last):
        out[i] = loss_weight(kind, width, squared[i])


@compiled
def rays(
    image: IntArray,
    uv_px: FloatArray,
    calibration: FloatArray,
    world_R_camera: FloatArray,
    first: int,
    last: int,
    direction: FloatArray,
) -> None:
    """Unit directions (n, 3) in the world of pixels (n, 2); calibrations (images, 3, 3) upper-triangular."""
    for i in range(first, last):
        K, R = calibration[image[i]], world_R_camera[image[i]]
        z = 1.0 / K[2, 2]
        y = (uv_px[i, 1] - K[1, 2] * z) / K[1, 1]
        x = (uv_px[i, 0] - K[0, 1] * y - K[0, 2] * z) / K[0, 0]
        length = np.sqrt(x * x + y * y + z * z)
        for k in range(3):
            direction[i, k] = (R[k, 0] * x + R[k, 1] * y + R[k, 2] * z) / length


# --- triangulation ---


@compiled
def _triangulate(
    centre_m: FloatArray,
    direction: FloatArray,
    weight: FloatArray,
    form: FloatArray,
    turn: FloatArray,
    arm: FloatArray,
    vector: FloatArray,
    origin_m: FloatArray,
) -> None:
    """One landmark (4,) and its origin (3,) from its rays (m, 3); see `landmarks.triangulate`."""
    n = len(weight)
    total = 0.0
    for i in range(n):
        total += weight[i]
    alike = not total > 0
    if alike:
        total = float(n)
    for k in range(3):
        origin_m[k] = 0.0
        for i in range(n):
            origin_m[k] += (1.0 if alike else weight[i]) * centre_m[i, k]
        origin_m[k] /= total
    squares = 0.0
    for i in range(n):
        squares += (1.0 if alike else weight[i]) * _arm(centre_m[i], direction[i], origin_m, arm)
    baseline = np.sqrt(squares / total)
    parallax = baseline > _NO_BASELINE_M
    if not parallax:
        baseline = 1.0
    for again in range(2):
        form[:] = 0.0
        for i in range(n):
            square = _arm(centre_m[i], direction[i], origin_m, arm)
            d = direction[i]
            own = 1.0 if alike else weight[i]
            if again:
                range_squared = 0.0
                for k in range(3):
                    towards = vector[k] - vector[3] * (centre_m[i, k] - origin_m[k])
                    range_squared += towards * towards
                own /= max(range_squared, 1e-12)
            for p in range(3):
                form[p, p] += own
                for q in range(p + 1):
                    form[p, q] -= own * d[p] * d[q]
                if parallax:
                    form[3, p] -= own * arm[p] / baseline
            form[3, 3] += own * (square / (baseline * baseline) if parallax else 1.0)
        for p in range(3):
            for q in range(p + 1, 4):
                form[p, q] = form[q, p]
        eigen(form, turn)
        least = 0
        for k in range(1, 4):
            if form[k, k] < form[least, least]:
                least = k
        norm = 0.0
        for k in range(4):
            vector[k] = turn[k, least] / (baseline if k == 3 else 1.0)
            norm += vector[k] * vector[k]
        for k in range(4):
            vector[k] /= np.sqrt(norm)
    ahead = 0.0
    for i in range(n):
        along = 0.0
        for k in range(3):
            along += direction[i, k] * (vector[k] - vector[3] * (centre_m[i, k] - origin_m[k]))
        ahead += (1.0 if alike else weight[i]) * np.sign(along)
    if ahead < 0:
        for k in range(4):
            vector[k] = -vector[k]


@compiled
def _arm(centre_m: FloatArray, direction: FloatArray, origin_m: FloatArray, arm: FloatArray) -> float:
    """What of the way from the origin to a ray's centre is across the ray, to `arm` (3,); its square."""
    along, square = 0.0, 0.0
    for k in range(3):
        arm[k] = centre_m[k] - origin_m[k]
        along += arm[k] * direction[k]
    for k in range(3):
        arm[k] -= along * direction[k]
        square += arm[k] * arm[k]
    return square


@compiled
def triangulate(
    which: IntArray,
    begin: IntArray,
    centre_m: FloatArray,
    direction: FloatArray,
    weight: FloatArray,
    vector: FloatArray,
    origin_m: FloatArray,
) -> None:
    """Landmarks (landmarks, 4) and their origins (landmarks, 3) from rays (n, 3)."""
    form, turn, arm = np.empty((4, 4)), np.empty((4, 4)), np.empty(3)
    for j in which:
        own = slice(begin[j], begin[j + 1])
        _triangulate(centre_m[own], direction[own], weight[own], form, turn, arm, vector[j], origin_m[j])


# --- values, derivatives, statistics ---


@compiled
def evaluate(
    which: IntArray,
    seen: Seen,
    vector: FloatArray,
    origin_m: FloatArray,
    residual: FloatArray,
    b: FloatArray,
    in_front: BoolArray,
) -> None:
    """Whitened residuals (n, 2), their derivatives (n, 2, 3) by the tangents, and what is in front (n,)."""
    for j in which:
        x0, x1, x2, w = vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3]
        t, O0, O1, O2 = tangents(x0, x1, x2, w), origin_m[j, 0], origin_m[j, 1], origin_m[j, 2]
        for i in range(seen.begin[j], seen.begin[j + 1]):
            in_front[i], residual[i, 0], residual[i, 1], b00, b01, b02, b10, b11, b12 = _observe(
                seen, i, t, x0, x1, x2, w, O0, O1, O2
            )
            b[i, 0, 0], b[i, 0, 1], b[i, 0, 2] = b00, b01, b02
            b[i, 1, 0], b[i, 1, 1], b[i, 1, 2] = b10, b11, b12


@compiled
def residuals(
    which: IntArray,
    seen: Seen,
    vector: FloatArray,
    origin_m: FloatArray,
    residual: FloatArray,
    in_front: BoolArray,
) -> None:
    """`evaluate` without derivatives."""
    for j in which:
        x0, x1, x2, w = vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3]
        for i in range(seen.begin[j], seen.begin[j + 1]):
            image = seen.image[i]
            y0 = x0 - w * (seen.centre_m[image, 0] - origin_m[j, 0])
            y1 = x1 - w * (seen.centre_m[image, 1] - origin_m[j, 1])
            y2 = x2 - w * (seen.centre_m[image, 2] - origin_m[j, 2])
            in_front[i], residual[i, 0], residual[i, 1], _, _, _ = sight(
                seen.to_pixel, image, y0, y1, y2, seen.uv_px, seen.whitening, i
            )


@compiled
def free_derivatives(which: IntArray, begin: IntArray, vector: FloatArray, b: FloatArray) -> None:
    """Take from derivatives (n, 2, 3) their part along w where a landmark is held at infinity."""
    for j in which:
        if vector[j, 3] == 0:
            t = tangents(vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3])
            for i in range(begin[j], begin[j + 1]):
                for m in range(2):
                    b[i, m, 0], b[i, m, 1], b[i, m, 2] = _hold_w(t, b[i, m, 0], b[i, m, 1], b[i, m, 2])


@compiled
def cofactors(which: IntArray, begin: IntArray, b: FloatArray, weight: FloatArray, out: FloatArray) -> None:
    """Covariances (n, 2, 2) of whitened residuals with derivatives (n, 2, 3) and weights (n,)."""
    v, turn = np.empty((3, 3)), np.empty((3, 3))
    for j in which:
        v[:] = 0.0
        for i in range(begin[j], begin[j + 1]):
            for m in range(2):
                _add_normal(v, weight[i], b[i, m, 0], b[i, m, 1], b[i, m, 2])
        eigen(v, turn)
        # Directions that the accepted rays leave free: their observations determine them, whatever they say.
        least = 1e-14 * max(v[0, 0], v[1, 1], v[2, 2]) + 1e-100
        for i in range(begin[j], begin[j + 1]):
            sign = -weight[i] if weight[i] > 0 else 1.0
            c00, c01, c11 = 1.0, 0.0, 1.0
            for k in range(3):
                share = sign / max(v[k, k], least)
                h0 = b[i, 0, 0] * turn[0, k] + b[i, 0, 1] * turn[1, k] + b[i, 0, 2] * turn[2, k]
                h1 = b[i, 1, 0] * turn[0, k] + b[i, 1, 1] * turn[1, k] + b[i, 1, 2] * turn[2, k]
                c00 += share * h0 * h0
                c01 += share * h0 * h1
                c11 += share * h1 * h1
            out[i, 0, 0], out[i, 0, 1], out[i, 1, 0], out[i, 1, 1] = c00, c01, c01, c11


@compiled
def smallest_information(
    which: IntArray, seen: Seen, points_m: FloatArray, weight: FloatArray, out: FloatArray
) -> None:
    """Smallest eigenvalue (landmarks,) of the information about world points, in 1 / m^2."""
    v, turn = np.empty((3, 3)), np.empty((3, 3))
    for j in which:
        v[:] = 0.0
        for i in range(seen.begin[j], seen.begin[j + 1]):
            if weight[i] > 0:
                image = seen.image[i]
                y0 = points_m[j, 0] - seen.centre_m[image, 0]
                y1 = points_m[j, 1] - seen.centre_m[image, 1]
                y2 = points_m[j, 2] - seen.centre_m[image, 2]
                _, _, _, u, v_px, per_depth = sight(
                    seen.to_pixel, image, y0, y1, y2, seen.uv_px, seen.whitening, i
                )
                d00, d01, d02, d10, d11, d12 = by_ray(
                    seen.to_pixel, image, u, v_px, per_depth, seen.whitening, i
                )
                _add_normal(v, weight[i], d00, d01, d02)
                _add_normal(v, weight[i], d10, d11, d12)
        eigen(v, turn)
        out[j] = min(v[0, 0], v[1, 1], v[2, 2])


# --- refinement ---


@compiled
def _normal(
    seen: Seen,
    j: int,
    t: Tangents,
    x0: float,
    x1: float,
    x2: float,
    w: float,
    origin_m: FloatArray,
    weight: FloatArray,
    kind: int,
    width: float,
    held: bool,
    v: FloatArray,
    g: FloatArray,
) -> float:
    """Cost of landmark j at (x, w) with its tangents, its normal matrix (3, 3) and its gradient (3,)."""
    O0, O1, O2 = origin_m[j, 0], origin_m[j, 1], origin_m[j, 2]
    v[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    for i in range(seen.begin[j], seen.begin[j + 1]):
        if weight[i] == 0:
            continue
        in_front, r0, r1, b00, b01, b02, b10, b11, b12 = _observe(seen, i, t, x0, x1, x2, w, O0, O1, O2)
        if held:
            b00, b01, b02 = _hold_w(t, b00, b01, b02)
            b10, b11, b12 = _hold_w(t, b10, b11, b12)
        squared = r0 * r0 + r1 * r1
        cost += weight[i] * (loss_cost(kind, width, squared) + (0.0 if in_front else _REFINE_BEHIND_COST))
        own = weight[i] * loss_weight(kind, width, squared)
        _add_normal(v, own, b00, b01, b02)
        _add_normal(v, own, b10, b11, b12)
        g[0] += own * (b00 * r0 + b10 * r1)
        g[1] += own * (b01 * r0 + b11 * r1)
        g[2] += own * (b02 * r0 + b12 * r1)
    return cost


@compiled
def _newton(v: FloatArray, g: FloatArray, turn: FloatArray, step: FloatArray) -> float:
    """Step (3,) -V^-1 g along those directions that the rays determine; its product with g. Destroys V."""
    floor = _UNDETERMINED * (v[0, 0] + v[1, 1] + v[2, 2])
    if v[0, 0] > floor:
        l10, l20 = v[1, 0] / v[0, 0], v[2, 0] / v[0, 0]
        p1 = v[1, 1] - l10 * v[1, 0]
        if p1 > floor:
            l21 = (v[2, 1] - l20 * v[1, 0]) / p1
            p2 = v[2, 2] - l20 * v[2, 0] - l21 * l21 * p1
            if p2 > floor:  # all three are determined
                y1 = g[1] - l10 * g[0]
                y2 = g[2] - l20 * g[0] - l21 * y1
                step[2] = -y2 / p2
                step[1] = -y1 / p1 - l21 * step[2]
                step[0] = -g[0] / v[0, 0] - l10 * step[1] - l20 * step[2]
                return float(step[0] * g[0] + step[1] * g[1] + step[2] * g[2])
    eigen(v, turn)
    floor = 1e-13 * max(v[0, 0], v[1, 1], v[2, 2]) + 1e-300
    step[:] = 0.0
    slope = 0.0
    for k in range(3):
        if v[k, k] > floor:
            part = turn[0, k] * g[0] + turn[1, k] * g[1] + turn[2, k] * g[2]
            slope -= part * part / v[k, k]
            for p in range(3):
                step[p] -= turn[p, k] * part / v[k, k]
    return slope


@compiled
def refine(
    which: IntArray,
    seen: Seen,
    origin_m: FloatArray,
    weight: FloatArray,
    kind: int,
    width: float,
    beyond_infinity: bool,
    tolerance: float,
    vector: FloatArray,
) -> None:
    """Best landmarks, from `vector` (landmarks, 4) and back to it; see `landmarks.refine`."""
    v, g, turn, step = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    for j in which:
        a0, a1, a2, a3 = vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3]
        held = False
        while True:
            t = tangents(a0, a1, a2, a3)
            cost = _normal(seen, j, t, a0, a1, a2, a3, origin_m, weight, kind, width, held, v, g)
            slope = _newton(v, g, turn, step)
            damping = 1e-6
            for _ in range(_REFINE_STEPS):
                length = np.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
                share = min(1.0 / (1.0 + damping), 0.5 / max(length, 1e-300))
                x0, x1, x2, x3 = retracted(
                    t, a0, a1, a2, a3, share * step[0], share * step[1], share * step[2]
                )
                if held:  # a step along the horizon leaves w at 0, but for rounding
                    x3 = 0.0
                tried = tangents(x0, x1, x2, x3)
                trial_cost = _normal(
                    seen, j, tried, x0, x1, x2, x3, origin_m, weight, kind, width, held, v, g
                )
                better = trial_cost < cost
                damping = min(max(damping * (0.1 if better else 100.0), 1e-12), 1e9)
                # A landmark stays where a step promises next to nothing, or where no damping makes one gain.
                settled = -0.5 * share * slope <= tolerance * cost + 1e-12 or (not better and damping > 1e6)
                if better:
                    a0, a1, a2, a3, t, cost = x0, x1, x2, x3, tried, trial_cost
                if settled:
                    break
                if better:
                    slope = _newton(v, g, turn, step)
            norm = np.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
            # One whose vector is its origin alone has no direction in which infinity could be.
            if held or beyond_infinity or not (a3 < 0 and norm > 1e-9):
                break
            # Beyond infinity: brought to it, and refined there.
            a0, a1, a2, a3 = a0 / norm, a1 / norm, a2 / norm, 0.0
            held = True
        vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3] = a0, a1, a2, a3


# --- rejection ---


@compiled
def tests(
    which: IntArray,
    begin: IntArray,
    residual: FloatArray,
    cofactor: FloatArray,
    test: FloatArray,
    freedom: IntArray,
) -> None:
    """Squared residuals (n,) in units of their own covariance, and over how many directions (0, 1 or 2)."""
    values, turn = np.empty((2, 2)), np.empty((2, 2))
    for j in which:
        for i in range(begin[j], begin[j + 1]):
            for p in range(2):
                for q in range(2):
                    values[p, q] = cofactor[i, p, q]
            eigen(values, turn)
            test[i], freedom[i] = 0.0, 0
            for k in range(2):
                if values[k, k] > _MIN_REDUNDANCY:
                    along = turn[0, k] * residual[i, 0] + turn[1, k] * residual[i, 1]
                    test[i] += along * along / values[k, k]
                    freedom[i] += 1


@compiled
def reject(
    which: IntArray,
    begin: IntArray,
    residual: FloatArray,
    test: FloatArray,
    freedom: IntArray,
    in_front: BoolArray,
    scale: float,
    limit: FloatArray,
    readmit: bool,
    weight: FloatArray,
    lost: BoolArray,
    changed: BoolArray,
) -> None:
    """Set the weight (n,) of each landmark's worst observation to 0 if it exceeds its limit.

    `limit` (3,) of the tests by their directions, in units of the squared `scale`; `test` is overwritten. Of
    two accepted observations both may go. Where wished, rejected ones that fit come back. Says which
    landmarks (landmarks,) lost one, and which changed at all.
    """
    excess = test
    for j in which:
        n_accepted, worst = 0, 0.0
        for i in range(begin[j], begin[j + 1]):
            excess[i] = test[i] / scale**2 - limit[freedom[i]]
            if weight[i] > 0:
                # What takes part may not exceed the noise itself, even where its cofactor shows no direction
                # of it.
                squared = residual[i, 0] * residual[i, 0] + residual[i, 1] * residual[i, 1]
                excess[i] = max(excess[i], squared / scale**2 - limit[2])
                n_accepted += 1
            if not in_front[i]:
                excess[i] = np.inf
            if weight[i] > 0:
                worst = max(worst, excess[i])
        n_left = n_accepted
        for i in range(begin[j], begin[j + 1]):
            if weight[i] > 0 and excess[i] > 0 and (excess[i] >= worst or n_accepted <= 2):
                weight[i] = 0.0
                n_left -= 1
        n_back = 0
        if readmit and n_left >= 2:
            for i in range(begin[j], begin[j + 1]):
                # What has just gone exceeds its limit, so it does not come back.
                if weight[i] == 0 and excess[i] < 0 and freedom[i] > 0:
                    weight[i] = 1.0
                    n_back += 1
        lost[j] = n_left < n_accepted
        changed[j] = lost[j] or n_back > 0
