"""Linearisation of observations, and elimination of landmarks from the normal equations.

Small vectors are tuples of numbers, never views of arrays: to make and drop a view costs as much as the
arithmetic on it. Functions on tuples are copied into the loop that calls them.

Letters are those of the formulas at `eliminate_poses`: b is the derivative of an observation's whitened
residual r by the tangents of its landmark, e that by the ray from the base of its unit, in the base's frame.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from pancam_graph.base.compiled import inlined, is_on_disk, part
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks.kernel._compiling import entry
from pancam_graph.landmarks.kernel._loss import BEHIND_COST, NONE, loss_cost, loss_weight
from pancam_graph.landmarks.kernel._observe import Three, observe_ray, residual_by_ray
from pancam_graph.landmarks.kernel._order import Bearings, Reduced, Sights
from pancam_graph.landmarks.kernel._sphere import by_tangents, tangents
from pancam_graph.landmarks.kernel._symmetric import UNDETERMINED
from pancam_graph.landmarks.kernel._tiles import subtract_row, tile_entry

__all__ = [
    "WEAK_PRIOR",
    "by_calibration",
    "cross",
    "eliminate_calibrations",
    "eliminate_poses",
    "in_base",
    "must_compile",
]

WEAK_PRIOR = 1e-12
"""Information of a landmark's weak prior, as a share of the trace of its information V ..."""
_SAYS_NOTHING = 1e-2
"""... and at most: a sigma of 10 rad says nothing of where a unit vector points ..."""
_ROUNDING = 1e-15
"""... but at least, as a share of the trace: it is to exceed the rounding errors of a pivot."""


@part
def _add_units(
    unit_H: FloatArray,
    unit_s: FloatArray,
    unit_of: IntArray,
    bearings: Bearings,
    segment_column: IntArray,
    tiles: FloatArray,
    s: FloatArray,
) -> None:
    """Add the information about each unit's base, through its chain, to the upper triangle of S and to s.

    `unit_H` and `unit_s` are the information and the gradient by the base's twist and calibration, row by row
    of `unit_of`, which gives the unit of each row; -1: none.
    """
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
                        tiles[tile_entry(column_b + p, column_a + q, n_pairs)] += total


@part
def by_calibration(
    calibration: FloatArray,
    image: int,
    u: float,
    v: float,
    whitening: FloatArray,
    i: int,
    root: float,
    jac: FloatArray,
) -> None:
    """Derivative (2, 5) of a whitened residual by fx, fy, skew, cx and cy (thesis eq. 4.2), at pixel (u, v).

    `root` is the square root of the robust weight.
    """
    y = (v - calibration[image, 1, 2]) / calibration[image, 1, 1]
    x = (u - calibration[image, 0, 2] - calibration[image, 0, 1] * y) / calibration[image, 0, 0]
    for m in range(2):
        wu, wv = root * whitening[i, m, 0], root * whitening[i, m, 1]
        jac[m, 0], jac[m, 1], jac[m, 2], jac[m, 3], jac[m, 4] = wu * x, wv * y, wu * y, wu, wv


@part
def _add_six(
    to: FloatArray, at: int, a0: float, a1: float, a2: float, a3: float, a4: float, a5: float
) -> None:
    """Add six numbers to six entries of an array, from `at` on."""
    b0, b1, b2, b3, b4, b5 = to[at], to[at + 1], to[at + 2], to[at + 3], to[at + 4], to[at + 5]
    to[at], to[at + 1], to[at + 2] = b0 + a0, b1 + a1, b2 + a2
    to[at + 3], to[at + 4], to[at + 5] = b3 + a3, b4 + a4, b5 + a5


_Symmetric: TypeAlias = tuple[float, float, float, float, float, float]
"""A symmetric matrix (3, 3): its entries 00, 01, 02, 11, 12, 22."""


@inlined
def _plus_gram(total: _Symmetric, a: Three, b: Three) -> _Symmetric:
    """A symmetric matrix plus J'J, J having the rows a and b."""
    return (
        total[0] + (a[0] * a[0] + b[0] * b[0]),
        total[1] + (a[0] * a[1] + b[0] * b[1]),
        total[2] + (a[0] * a[2] + b[0] * b[2]),
        total[3] + (a[1] * a[1] + b[1] * b[1]),
        total[4] + (a[1] * a[2] + b[1] * b[2]),
        total[5] + (a[2] * a[2] + b[2] * b[2]),
    )


@inlined
def _plus_product(total: Three, a: Three, b: Three, r0: float, r1: float) -> Three:
    """A vector plus J'r, J having the rows a and b."""
    return (
        total[0] + (a[0] * r0 + b[0] * r1),
        total[1] + (a[1] * r0 + b[1] * r1),
        total[2] + (a[2] * r0 + b[2] * r1),
    )


@inlined
def _plus_outer(row: Three, p: float, a: Three, q: float, b: Three) -> Three:
    """A vector plus p a + q b."""
    return (
        row[0] + p * a[0] + q * b[0],
        row[1] + p * a[1] + q * b[1],
        row[2] + p * a[2] + q * b[2],
    )


@inlined
def in_base(unit_R: FloatArray, unit: int, d: Three) -> Three:
    """A direction (3,) in the world, or a derivative by one, taken to the frame of a unit's base."""
    return (
        d[0] * unit_R[unit, 0, 0] + d[1] * unit_R[unit, 1, 0] + d[2] * unit_R[unit, 2, 0],
        d[0] * unit_R[unit, 0, 1] + d[1] * unit_R[unit, 1, 1] + d[2] * unit_R[unit, 2, 1],
        d[0] * unit_R[unit, 0, 2] + d[1] * unit_R[unit, 1, 2] + d[2] * unit_R[unit, 2, 2],
    )


@inlined
def cross(a: Three, x: Three) -> Three:
    """Cross product of a and x."""
    return a[1] * x[2] - a[2] * x[1], a[2] * x[0] - a[0] * x[2], a[0] * x[1] - a[1] * x[0]


class _Calibrations(NamedTuple):
    """Sums over one occurrence where calibrations are free; arrays without entries where poses alone are."""

    jacobian: FloatArray
    """(2, 5) of one observation, by fx, fy, skew, cx and cy"""
    by_landmark: FloatArray
    """(5, 3) products with the derivative by the landmark"""
    by_base: FloatArray
    """(3, 5) products with the derivative by the ray in the base's frame"""


@inlined
def _add_calibration(
    bearings: Bearings,
    sights: Sights,
    i: int,
    u: float,
    v: float,
    root: float,
    derivatives: tuple[Three, Three, Three, Three],
    r0: float,
    r1: float,
    row: int,
    sums: _Calibrations,
    unit_H: FloatArray,
    unit_s: FloatArray,
) -> None:
    """Add what observation i tells about its calibration to the sums of its occurrence and of its unit.

    `derivatives` are b and e, two rows each.
    """
    b0, b1, e0, e1 = derivatives
    jac, by_landmark, by_base = sums.jacobian, sums.by_landmark, sums.by_base
    by_calibration(bearings.cameras.calibration, sights.image[i], u, v, sights.whitening, i, root, jac)
    for p in range(5):
        ja, jb = jac[0, p], jac[1, p]
        by_landmark[p, 0] += ja * b0[0] + jb * b1[0]
        by_landmark[p, 1] += ja * b0[1] + jb * b1[1]
        by_landmark[p, 2] += ja * b0[2] + jb * b1[2]
        by_base[0, p] += ja * e0[0] + jb * e1[0]
        by_base[1, p] += ja * e0[1] + jb * e1[1]
        by_base[2, p] += ja * e0[2] + jb * e1[2]
        unit_s[row, 6 + p] += ja * r0 + jb * r1
        for q in range(p, 5):
            unit_H[row, 6 + p, 6 + q] += ja * jac[0, q] + jb * jac[1, q]


@inlined
def _add_twist(
    unit_H: FloatArray, unit_s: FloatArray, row: int, w: float, x: Three, m: _Symmetric, k: Three
) -> None:
    """Add what one occurrence tells about the twist of its base to the information about that base.

    x is the ray from the base to the landmark, in the base's frame; m and k are the occurrence's sums of e'e
    and e'r. A twist moves the ray by [x]_x times its rotation and by -w times its translation.
    """
    m00, m01, m02, m11, m12, m22 = m
    q0, q1, q2 = cross((m00, m01, m02), x), cross((m01, m11, m12), x), cross((m02, m12, m22), x)
    h0 = cross((q0[0], q1[0], q2[0]), x)
    h1 = cross((q0[1], q1[1], q2[1]), x)
    h2 = cross((q0[2], q1[2], q2[2]), x)
    unit_H[row, 0, 0] += h0[0]
    unit_H[row, 0, 1] += h1[0]
    unit_H[row, 0, 2] += h2[0]
    unit_H[row, 1, 1] += h1[1]
    unit_H[row, 1, 2] += h2[1]
    unit_H[row, 2, 2] += h2[2]
    for p in range(3):
        unit_H[row, p, 3] -= w * q0[p]
        unit_H[row, p, 4] -= w * q1[p]
        unit_H[row, p, 5] -= w * q2[p]
    unit_H[row, 3, 3] += w * w * m00
    unit_H[row, 3, 4] += w * w * m01
    unit_H[row, 3, 5] += w * w * m02
    unit_H[row, 4, 4] += w * w * m11
    unit_H[row, 4, 5] += w * w * m12
    unit_H[row, 5, 5] += w * w * m22
    turning = cross(k, x)
    for p in range(3):
        unit_s[row, p] += turning[p]
        unit_s[row, 3 + p] -= w * k[p]


@inlined
def _add_twist_by_calibration(unit_H: FloatArray, row: int, w: float, x: Three, by_base: FloatArray) -> None:
    """Add the products of twist and calibration of one occurrence to the information about its base."""
    for p in range(5):
        f = by_base[0, p], by_base[1, p], by_base[2, p]
        turning = cross(f, x)
        for q in range(3):
            unit_H[row, q, 6 + p] += turning[q]
            unit_H[row, 3 + q, 6 + p] -= w * f[q]


@inlined
def _add_to_arms(
    sights: Sights,
    bearings: Bearings,
    o: int,
    unit: int,
    first_pair: int,
    twist_by_landmark: tuple[Three, Three, Three, Three, Three, Three],
    more: int,
    by_landmark: FloatArray,
    arms: FloatArray,
) -> None:
    """Add E' of an occurrence to the arms of its landmark, through the chains of its unit's variables.

    `twist_by_landmark` (6, 3) are the products of the base's twist with the landmark, `by_landmark` (more, 3)
    those of the calibration.
    """
    z0, z1, z2, z3, z4, z5 = twist_by_landmark
    chain, place = bearings.chain, sights.place_begin[o]
    for segment in range(bearings.segment_begin[unit], bearings.segment_begin[unit + 1]):
        q = 6 * (first_pair + sights.place[place])
        place += 1
        if bearings.plain[segment]:
            _add_six(arms, q, z0[0], z1[0], z0[1], z1[1], z0[2], z1[2])
            _add_six(arms, q + 6, z2[0], z3[0], z2[1], z3[1], z2[2], z3[2])
            _add_six(arms, q + 12, z4[0], z5[0], z4[1], z5[1], z4[2], z5[2])
            continue
        for k in range(bearings.segment_width[segment]):
            h0, h1, h2 = chain[segment, 0, k], chain[segment, 1, k], chain[segment, 2, k]
            h3, h4, h5 = chain[segment, 3, k], chain[segment, 4, k], chain[segment, 5, k]
            a0 = h0 * z0[0] + h1 * z1[0] + h2 * z2[0] + h3 * z3[0] + h4 * z4[0] + h5 * z5[0]
            a1 = h0 * z0[1] + h1 * z1[1] + h2 * z2[1] + h3 * z3[1] + h4 * z4[1] + h5 * z5[1]
            a2 = h0 * z0[2] + h1 * z1[2] + h2 * z2[2] + h3 * z3[2] + h4 * z4[2] + h5 * z5[2]
            if more:
                for p in range(more):
                    a0 += chain[segment, 6 + p, k] * by_landmark[p, 0]
                    a1 += chain[segment, 6 + p, k] * by_landmark[p, 1]
                    a2 += chain[segment, 6 + p, k] * by_landmark[p, 2]
            at = q + 6 * (k >> 1) + (k & 1)
            arms[at] += a0
            arms[at + 2] += a1
            arms[at + 4] += a2


@inlined
def _cholesky(v: _Symmetric) -> tuple[_Symmetric, bool]:
    """Lower Cholesky factor of V (its entries 00, 10, 11, 20, 21, 22), and whether V needed the weak prior.

    Only pivots that are next to zero get the weak prior: on all pivots of all landmarks it would add up to a
    prior that holds the world in place.
    """
    v00, v10, v20, v11, v21, v22 = v
    trace = v00 + v11 + v22
    prior = max(min(WEAK_PRIOR * trace, _SAYS_NOTHING), _ROUNDING * trace) + 1e-300
    floor = prior * (UNDETERMINED / WEAK_PRIOR)
    l00 = np.sqrt(v00 if v00 > floor else v00 + prior)
    l10, l20 = v10 / l00, v20 / l00
    p1 = max(v11 - l10 * l10, 0.0)
    l11 = np.sqrt(p1 if p1 > floor else p1 + prior)
    l21 = (v21 - l20 * l10) / l11
    p2 = max(v22 - l20 * l20 - l21 * l21, 0.0)
    l22 = np.sqrt(p2 if p2 > floor else p2 + prior)
    return (l00, l10, l11, l20, l21, l22), min(v00, p1, p2) <= floor


@inlined
def _eliminate(
    sights: Sights, reduced: Reduced, j: int, v: _Symmetric, g: Three, tiles: FloatArray, s: FloatArray
) -> None:
    """Eliminate landmark j, whose information is V and whose gradient is g.

    With V = L L', its arms E' become W = L^-1 E' and g becomes L^-1 g; W'W and W' L^-1 g are subtracted from
    S and s. Entries of S below the diagonal have no meaning.
    """
    (l00, l10, l11, l20, l21, l22), reduced.undetermined[j] = _cholesky(v)
    arms, pair, n_pairs, factor = reduced.arms, sights.pair, len(s) // 2, reduced.factor
    first_pair, last_pair = sights.pair_begin[j], sights.pair_begin[j + 1]
    factor[j, 0], factor[j, 1], factor[j, 2] = l00, l10, l11
    factor[j, 3], factor[j, 4], factor[j, 5] = l20, l21, l22
    per0, per1, per2 = 1.0 / l00, 1.0 / l11, 1.0 / l22
    g0 = g[0] * per0
    g1 = (g[1] - l10 * g0) * per1
    g2 = (g[2] - l20 * g0 - l21 * g1) * per2
    reduced.gamma[j, 0], reduced.gamma[j, 1], reduced.gamma[j, 2] = g0, g1, g2
    for p in range(first_pair, last_pair):
        at, column = 6 * p, 2 * pair[p]
        for q in range(at, at + 2):
            a0 = arms[q] * per0
            a1 = (arms[q + 2] - l10 * a0) * per1
            a2 = (arms[q + 4] - l20 * a0 - l21 * a1) * per2
            arms[q], arms[q + 2], arms[q + 4] = a0, a1, a2
            s[column] -= a0 * g0 + a1 * g1 + a2 * g2
            column += 1
    for p in range(first_pair, last_pair):
        subtract_row(tiles, pair[p] * n_pairs, arms, p, last_pair, pair)


def _eliminating(rows: int) -> Callable[..., None]:
    """The elimination for chains of 6 rows (poses) or of 11 (poses and calibrations)."""
    more = rows - 6

    @entry
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
        unit_H, unit_s = np.zeros((n_units, rows, rows)), np.zeros((n_units, rows))
        unit_of = np.full(n_units, -1)
        cameras, arms = bearings.cameras, reduced.arms
        centre_m = cameras.centre_m
        sums = _Calibrations(np.empty((2, more)), np.empty((more, 3)), np.empty((3, more)))
        for j in range(begin, end):
            X0, X1, X2, w = vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3]
            O0, O1, O2 = origin_m[j, 0], origin_m[j, 1], origin_m[j, 2]
            t = tangents(X0, X1, X2, w)
            v, g, cost = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
            first_pair, last_pair = sights.pair_begin[j], sights.pair_begin[j + 1]
            for q in range(6 * first_pair, 6 * last_pair):
                arms[q] = 0.0
            for o in range(sights.landmark_begin[j], sights.landmark_begin[j + 1]):
                unit, row = sights.occurrence_unit[o], sights.occurrence_row[o]
                unit_of[row] = unit
                # With e the residual's derivative by the ray in the base's frame and b that by the landmark:
                # the sums over the occurrence of e'e, e'b (by rows) and e'r.
                m, k = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
                n0, n1, n2 = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
                if more:
                    sums.by_landmark[:] = 0.0
                    sums.by_base[:] = 0.0
                for i in range(sights.occurrence_begin[o], sights.occurrence_begin[o + 1]):
                    image = sights.image[i]
                    c0, c1, c2 = centre_m[image, 0] - O0, centre_m[image, 1] - O1, centre_m[image, 2] - O2
                    y0, y1, y2 = X0 - w * c0, X1 - w * c1, X2 - w * c2
                    in_front, r0, r1, u_px, v_px, per_depth = observe_ray(
                        cameras, image, y0, y1, y2, w, sights.uv_px, sights.whitening, i
                    )
                    if not in_front:
                        cost += BEHIND_COST
                        continue
                    squared = r0 * r0 + r1 * r1
                    cost += loss_cost(kind, width, squared)
                    root = 1.0 if kind == NONE else np.sqrt(loss_weight(kind, width, squared))
                    r0, r1 = root * r0, root * r1
                    scale = root * per_depth
                    d00, d01, d02, d10, d11, d12, w0, w1 = residual_by_ray(
                        cameras, image, y0, y1, y2, w, u_px, v_px, scale, sights.whitening, i
                    )
                    b0 = by_tangents(t, d00, d01, d02, w0 - (d00 * c0 + d01 * c1 + d02 * c2))
                    b1 = by_tangents(t, d10, d11, d12, w1 - (d10 * c0 + d11 * c1 + d12 * c2))
                    e0 = in_base(bearings.unit_R, unit, (d00, d01, d02))
                    e1 = in_base(bearings.unit_R, unit, (d10, d11, d12))
                    v, g = _plus_gram(v, b0, b1), _plus_product(g, b0, b1, r0, r1)
                    m, k = _plus_gram(m, e0, e1), _plus_product(k, e0, e1, r0, r1)
                    n0 = _plus_outer(n0, e0[0], b0, e1[0], b1)
                    n1 = _plus_outer(n1, e0[1], b0, e1[1], b1)
                    n2 = _plus_outer(n2, e0[2], b0, e1[2], b1)
                    if more:
                        _add_calibration(
                            bearings,
                            sights,
                            i,
                            u_px,
                            v_px,
                            root,
                            (b0, b1, e0, e1),
                            r0,
                            r1,
                            row,
                            sums,
                            unit_H,
                            unit_s,
                        )
                # The ray from the base to the landmark, in the world and in the base's frame.
                y0 = X0 - w * (bearings.unit_t[unit, 0] - O0)
                y1 = X1 - w * (bearings.unit_t[unit, 1] - O1)
                y2 = X2 - w * (bearings.unit_t[unit, 2] - O2)
                x = in_base(bearings.unit_R, unit, (y0, y1, y2))
                _add_twist(unit_H, unit_s, row, w, x, m, k)
                if more:
                    _add_twist_by_calibration(unit_H, row, w, x, sums.by_base)
                z0 = cross((n0[0], n1[0], n2[0]), x)
                z1 = cross((n0[1], n1[1], n2[1]), x)
                z2 = cross((n0[2], n1[2], n2[2]), x)
                twist_by_landmark = (
                    (z0[0], z1[0], z2[0]),
                    (z0[1], z1[1], z2[1]),
                    (z0[2], z1[2], z2[2]),
                    (-w * n0[0], -w * n0[1], -w * n0[2]),
                    (-w * n1[0], -w * n1[1], -w * n1[2]),
                    (-w * n2[0], -w * n2[1], -w * n2[2]),
                )
                _add_to_arms(
                    sights, bearings, o, unit, first_pair, twist_by_landmark, more, sums.by_landmark, arms
                )
            reduced.cost[j] = cost
            _eliminate(sights, reduced, j, v, g, tiles, s)
        _add_units(unit_H, unit_s, unit_of, bearings, segment_column, tiles, s)

    return eliminate


eliminate_poses = _eliminating(6)
"""Linearise the observations of landmarks begin to end, eliminate these, and add what is left to S and s.

S (upper triangle, in tiles) and s are those of the block of the landmarks.

Exact Schur complement of the whitened, robustly weighted system: S = A'A - sum E V^-1 E' and
s = A'r - sum E V^-1 g with E = A'B, V = B'B, g = B'r for the cameras' Jacobian A and each landmark's B.
V gets the weak prior where it needs one, and no damping."""
eliminate_calibrations = _eliminating(11)
"""`eliminate_poses` for chains with calibrations."""


def must_compile() -> bool:
    """Whether the elimination must be compiled before a solve, which then takes longer."""
    return not is_on_disk(eliminate_poses)
