"""What runs per observation, compiled: one module, so that the cache on disk is never half old.

Everything else of the package works on whole arrays or once per image, frame or stop.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np

from pancam_graph.geometry import BoolArray, FloatArray, IntArray

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
    "loss_cost",
    "loss_costs",
    "loss_weight",
    "loss_weights",
    "must_compile",
    "rays",
    "refine",
    "reject",
    "sight",
    "smallest_information",
    "spread",
    "tangent_basis",
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
    stored = Path(stats.cache_path).glob("kernel._eliminating*.nbi")
    return not any(index.stat().st_mtime >= source for index in stored)


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
def tangent_basis(vector: FloatArray, basis: FloatArray) -> None:
    """Orthonormal basis (4, 3) of the tangent space of S^3 at a unit vector, by a Householder reflection.

    The reflection takes the vector to the first axis (or its opposite); the images of the other three
    axes span the tangent space.
    """
    a0, a1, a2, a3 = vector[0], vector[1], vector[2], vector[3]
    a0 += 1.0 if a0 >= 0 else -1.0
    scale = 2.0 / (a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3)
    basis[0, 0], basis[0, 1], basis[0, 2] = -scale * a0 * a1, -scale * a0 * a2, -scale * a0 * a3
    basis[1, 0], basis[1, 1], basis[1, 2] = 1 - scale * a1 * a1, -scale * a1 * a2, -scale * a1 * a3
    basis[2, 0], basis[2, 1], basis[2, 2] = -scale * a2 * a1, 1 - scale * a2 * a2, -scale * a2 * a3
    basis[3, 0], basis[3, 1], basis[3, 2] = -scale * a3 * a1, -scale * a3 * a2, 1 - scale * a3 * a3


@compiled
def sight(
    to_pixel: FloatArray,
    offset: FloatArray,
    vector: FloatArray,
    uv_px: FloatArray,
    whitening: FloatArray,
    residual: FloatArray,
    d_ray: FloatArray,
) -> bool:
    """Whitened residual (2,) of one observation and its derivative (2, 3) by the world ray; whether in front.

    The ray is X - w offset, the camera's centre being at `offset` from the landmark's origin. What is behind
    the camera gives the residual of the mirrored point, which means nothing.
    """
    y0 = vector[0] - vector[3] * offset[0]
    y1 = vector[1] - vector[3] * offset[1]
    y2 = vector[2] - vector[3] * offset[2]
    p2 = to_pixel[2, 0] * y0 + to_pixel[2, 1] * y1 + to_pixel[2, 2] * y2
    in_front = bool(p2 > 1e-12)
    per_depth = 1.0 / (p2 if abs(p2) > 1e-12 else 1e-12)
    u = (to_pixel[0, 0] * y0 + to_pixel[0, 1] * y1 + to_pixel[0, 2] * y2) * per_depth
    v = (to_pixel[1, 0] * y0 + to_pixel[1, 1] * y1 + to_pixel[1, 2] * y2) * per_depth
    du, dv = u - uv_px[0], v - uv_px[1]
    w00, w01, w10, w11 = whitening[0, 0], whitening[0, 1], whitening[1, 0], whitening[1, 1]
    residual[0] = w00 * du + w01 * dv
    residual[1] = w10 * du + w11 * dv
    for k in range(3):
        gu = (to_pixel[0, k] - u * to_pixel[2, k]) * per_depth
        gv = (to_pixel[1, k] - v * to_pixel[2, k]) * per_depth
        d_ray[0, k] = w00 * gu + w01 * gv
        d_ray[1, k] = w10 * gu + w11 * gv
    return in_front


class Sights(NamedTuple):
    """Observations of landmarks in the order of elimination; structure that no step changes.

    An *occurrence* is one unit (images moved alike by all variables) that sees a landmark. A landmark touches
    columns of its block's variables: its `column`s, ascending; `place` says where among them each segment of
    an occurrence's chain begins.
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
    column_begin: IntArray
    """(landmarks + 1,) first entry in `column` of each"""
    column: IntArray


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
    """(3 len(column),) L^-1 E' of each landmark, three rows of its columns"""
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
    S: FloatArray,
    s: FloatArray,
) -> None:
    """Add the units' own information, taken through their chains, to the upper triangle of S and to s."""
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
                        S[column_b + p, column_a + q] += total


@compiled
def _subtract(
    arms: FloatArray, column: IntArray, gamma: FloatArray, paired: bool, S: FloatArray, s: FloatArray
) -> None:
    """Take W'W and W'gamma of one landmark from the upper triangle of S and from s.

    Where columns come in pairs of neighbours, 2 x 2 entries are done at once, which halves the time; below
    the diagonal this leaves numbers that mean nothing.
    """
    n = len(column)
    for p in range(n):
        s[column[p]] -= arms[0, p] * gamma[0] + arms[1, p] * gamma[1] + arms[2, p] * gamma[2]
    if not paired:
        for p in range(n):
            for q in range(p, n):
                product = arms[0, p] * arms[0, q] + arms[1, p] * arms[1, q] + arms[2, p] * arms[2, q]
                S[column[p], column[q]] -= product
        return
    for p in range(0, n, 2):
        row = column[p]
        a0, a1, a2 = arms[0, p], arms[1, p], arms[2, p]
        b0, b1, b2 = arms[0, p + 1], arms[1, p + 1], arms[2, p + 1]
        for q in range(p, n, 2):
            c = column[q]
            x0, x1, x2 = arms[0, q], arms[1, q], arms[2, q]
            y0, y1, y2 = arms[0, q + 1], arms[1, q + 1], arms[2, q + 1]
            S[row, c] -= a0 * x0 + a1 * x1 + a2 * x2
            S[row, c + 1] -= a0 * y0 + a1 * y1 + a2 * y2
            S[row + 1, c] -= b0 * x0 + b1 * x1 + b2 * x2
            S[row + 1, c + 1] -= b0 * y0 + b1 * y1 + b2 * y2


@compiled
def _by_calibration(
    bearings: Bearings, image: int, uv_px: FloatArray, whitening: FloatArray, root: float, jac: FloatArray
) -> None:
    """Columns 6 to 10 of an observation's Jacobian: by fx, fy, skew, cx and cy (thesis eq. 4.2)."""
    K = bearings.calibration[image]
    y = (uv_px[1] - K[1, 2]) / K[1, 1]
    x = (uv_px[0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    for m in range(2):
        wu, wv = root * whitening[m, 0], root * whitening[m, 1]
        jac[m, 6], jac[m, 7], jac[m, 8], jac[m, 9], jac[m, 10] = wu * x, wv * y, wu * y, wu, wv


def _eliminating(rows: int) -> Callable[..., None]:
    """The elimination kernel for chains of 6 rows (poses) or 11 (poses and calibrations)."""

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
        paired: bool,
        reduced: Reduced,
        S: FloatArray,
        s: FloatArray,
    ) -> None:
        unit_H = np.zeros((n_units, rows, rows))
        unit_s = np.zeros((n_units, rows))
        unit_of = np.full(n_units, -1)
        basis, residual, d_ray = np.empty((4, 3)), np.empty(2), np.empty((2, 3))
        b, jac = np.empty((2, 3)), np.empty((2, rows))
        x, offset, uv = np.empty(3), np.empty(3), np.empty(2)
        cross = np.empty((rows, 3))
        for j in range(begin, end):
            tangent_basis(vector[j], basis)
            w = vector[j, 3]
            v00 = v10 = v11 = v20 = v21 = v22 = g0 = g1 = g2 = 0.0
            cost = 0.0
            c0 = sights.column_begin[j]
            n = sights.column_begin[j + 1] - c0
            arms = reduced.arms[3 * c0 : 3 * (c0 + n)].reshape(3, n)
            arms[:] = 0.0
            column = sights.column[c0 : c0 + n]
            for o in range(sights.landmark_begin[j], sights.landmark_begin[j + 1]):
                unit = sights.occurrence_unit[o]
                R = bearings.unit_R[unit]
                for k in range(3):
                    offset[k] = vector[j, k] - w * (bearings.unit_t[unit, k] - origin_m[j, k])
                for k in range(3):
                    x[k] = R[0, k] * offset[0] + R[1, k] * offset[1] + R[2, k] * offset[2]
                cross[:] = 0.0
                row = sights.occurrence_row[o]
                unit_of[row] = unit
                H, h = unit_H[row], unit_s[row]
                for i in range(sights.occurrence_begin[o], sights.occurrence_begin[o + 1]):
                    image = sights.image[i]
                    for k in range(3):
                        offset[k] = bearings.centre_m[image, k] - origin_m[j, k]
                    in_front = sight(
                        bearings.to_pixel[image],
                        offset,
                        vector[j],
                        sights.uv_px[i],
                        sights.whitening[i],
                        residual,
                        d_ray,
                    )
                    if not in_front:
                        cost += BEHIND_COST
                        continue
                    squared = residual[0] * residual[0] + residual[1] * residual[1]
                    cost += loss_cost(kind, width, squared)
                    root = np.sqrt(loss_weight(kind, width, squared))
                    for m in range(2):
                        residual[m] *= root
                        d0, d1, d2 = root * d_ray[m, 0], root * d_ray[m, 1], root * d_ray[m, 2]
                        d3 = -(d0 * offset[0] + d1 * offset[1] + d2 * offset[2])
                        for k in range(3):
                            b[m, k] = (
                                d0 * basis[0, k] + d1 * basis[1, k] + d2 * basis[2, k] + d3 * basis[3, k]
                            )
                        e0 = d0 * R[0, 0] + d1 * R[1, 0] + d2 * R[2, 0]
                        e1 = d0 * R[0, 1] + d1 * R[1, 1] + d2 * R[2, 1]
                        e2 = d0 * R[0, 2] + d1 * R[1, 2] + d2 * R[2, 2]
                        jac[m, 0] = e1 * x[2] - e2 * x[1]
                        jac[m, 1] = e2 * x[0] - e0 * x[2]
                        jac[m, 2] = e0 * x[1] - e1 * x[0]
                        jac[m, 3], jac[m, 4], jac[m, 5] = -w * e0, -w * e1, -w * e2
                    if rows > 6:
                        # The projection, from the whitened residual before the loss.
                        wh = sights.whitening[i]
                        det = (wh[0, 0] * wh[1, 1] - wh[0, 1] * wh[1, 0]) * root
                        uv[0] = sights.uv_px[i, 0] + (wh[1, 1] * residual[0] - wh[0, 1] * residual[1]) / det
                        uv[1] = sights.uv_px[i, 1] + (wh[0, 0] * residual[1] - wh[1, 0] * residual[0]) / det
                        _by_calibration(bearings, image, uv, wh, root, jac)
                    r0, r1 = residual[0], residual[1]
                    v00 += b[0, 0] * b[0, 0] + b[1, 0] * b[1, 0]
                    v10 += b[0, 1] * b[0, 0] + b[1, 1] * b[1, 0]
                    v11 += b[0, 1] * b[0, 1] + b[1, 1] * b[1, 1]
                    v20 += b[0, 2] * b[0, 0] + b[1, 2] * b[1, 0]
                    v21 += b[0, 2] * b[0, 1] + b[1, 2] * b[1, 1]
                    v22 += b[0, 2] * b[0, 2] + b[1, 2] * b[1, 2]
                    g0 += b[0, 0] * r0 + b[1, 0] * r1
                    g1 += b[0, 1] * r0 + b[1, 1] * r1
                    g2 += b[0, 2] * r0 + b[1, 2] * r1
                    for p in range(rows):
                        ja, jb = jac[0, p], jac[1, p]
                        h[p] += ja * r0 + jb * r1
                        for k in range(3):
                            cross[p, k] += ja * b[0, k] + jb * b[1, k]
                        for q in range(p, rows):
                            H[p, q] += ja * jac[0, q] + jb * jac[1, q]
                place = sights.place_begin[o]
                for segment in range(bearings.segment_begin[unit], bearings.segment_begin[unit + 1]):
                    chain, first = bearings.chain[segment], sights.place[place]
                    place += 1
                    for q in range(bearings.segment_width[segment]):
                        a0 = a1 = a2 = 0.0
                        for p in range(rows):
                            t = chain[p, q]
                            a0 += t * cross[p, 0]
                            a1 += t * cross[p, 1]
                            a2 += t * cross[p, 2]
                        arms[0, first + q] += a0
                        arms[1, first + q] += a1
                        arms[2, first + q] += a2
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
            factor = reduced.factor[j]
            factor[0], factor[1], factor[2], factor[3], factor[4], factor[5] = l00, l10, l11, l20, l21, l22
            y0 = g0 / l00
            y1 = (g1 - l10 * y0) / l11
            y2 = (g2 - l20 * y0 - l21 * y1) / l22
            reduced.gamma[j, 0], reduced.gamma[j, 1], reduced.gamma[j, 2] = y0, y1, y2
            reduced.cost[j] = cost
            for q in range(n):
                a0 = arms[0, q] / l00
                a1 = (arms[1, q] - l10 * a0) / l11
                a2 = (arms[2, q] - l20 * a0 - l21 * a1) / l22
                arms[0, q], arms[1, q], arms[2, q] = a0, a1, a2
            _subtract(arms, column, reduced.gamma[j], paired, S, s)
        _chain(unit_H, unit_s, unit_of, bearings, segment_column, S, s)

    return eliminate


eliminate_poses = _eliminating(6)
"""Linearise and eliminate landmarks begin to end; adds to S (upper triangle) and s of their block.

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
    basis, step, trial = np.empty((4, 3)), np.empty(3), np.empty(4)
    for j in range(begin, end):
        c0, c1 = sights.column_begin[j], sights.column_begin[j + 1]
        n = c1 - c0
        arms = reduced.arms[3 * c0 : 3 * c1].reshape(3, n)
        y0, y1, y2 = reduced.gamma[j, 0], reduced.gamma[j, 1], reduced.gamma[j, 2]
        for q in range(n):
            d = dx[sights.column[c0 + q]]
            y0 += arms[0, q] * d
            y1 += arms[1, q] * d
            y2 += arms[2, q] * d
        f = reduced.factor[j]
        step[2] = -y2 / f[5]
        step[1] = (-y1 - f[4] * step[2]) / f[2]
        step[0] = (-y0 - f[1] * step[1] - f[3] * step[2]) / f[0]
        tangent_basis(vector[j], basis)
        limit = SURPRISE * reduced.cost[j] + SURPRISE_COST
        cost[j] = np.inf
        for k in range(4):
            moved[j, k] = vector[j, k]
        for share in (1.0, 0.5, 0.25, 0.0625, 0.0):
            norm = 0.0
            for k in range(4):
                trial[k] = vector[j, k] + share * (
                    basis[k, 0] * step[0] + basis[k, 1] * step[1] + basis[k, 2] * step[2]
                )
                norm += trial[k] * trial[k]
            for k in range(4):
                trial[k] /= np.sqrt(norm)
            found = _landmark_cost(sights, bearings, trial, origin_m[j], kind, width, j)
            if found < cost[j]:
                cost[j] = found
                for k in range(4):  # whole rows take seconds to compile
                    moved[j, k] = trial[k]
            if found <= limit:
                break


@compiled
def _landmark_cost(
    sights: Sights,
    bearings: Bearings,
    vector: FloatArray,
    origin_m: FloatArray,
    kind: int,
    width: float,
    j: int,
) -> float:
    residual, d_ray, offset = np.empty(2), np.empty((2, 3)), np.empty(3)
    cost = 0.0
    first, last = sights.landmark_begin[j], sights.landmark_begin[j + 1]
    for i in range(sights.occurrence_begin[first], sights.occurrence_begin[last]):
        image = sights.image[i]
        for k in range(3):
            offset[k] = bearings.centre_m[image, k] - origin_m[k]
        in_front = sight(
            bearings.to_pixel[image], offset, vector, sights.uv_px[i], sights.whitening[i], residual, d_ray
        )
        if in_front:
            squared = residual[0] * residual[0] + residual[1] * residual[1]
            cost += loss_cost(kind, width, squared)
        else:
            cost += BEHIND_COST
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
        cost[i] = _landmark_cost(sights, bearings, vector[i], origin_m[j], kind, width, j)


@compiled
def arrange(
    landmarks: IntArray,
    begin: IntArray,
    image: IntArray,
    image_unit: IntArray,
    segment_begin: IntArray,
    segment_width: IntArray,
    segment_column: IntArray,
    n_columns: int,
    first_landmark: int,
    rows: IntArray,
    sights: Sights,
    cursor: IntArray,
) -> int:
    """Put a block's landmarks into the order of elimination; returns how many units see them.

    `landmarks` (m,) are rows in measurements whose observations of landmark j are begin[j] to begin[j + 1].
    Fills `rows` (n,), the measurement of each observation, and the structure of `sights` from where `cursor`
    (observations, occurrences, places, columns) stands, and moves the cursor on.
    """
    unit_row = np.full(len(segment_begin) - 1, -1)
    place_of = np.full(n_columns, -1)
    starts = np.empty(n_columns, dtype=np.int64)
    n_units = 0
    n_obs, n_occurrences, n_places, n_column = cursor[0], cursor[1], cursor[2], cursor[3]
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
                column = segment_column[segment]
                if place_of[column] < 0:
                    place_of[column] = segment_width[segment]
                    k = n_starts
                    while k > 0 and starts[k - 1] > column:
                        starts[k] = starts[k - 1]
                        k -= 1
                    starts[k] = column
                    n_starts += 1
        sights.landmark_begin[first_landmark + m] = first_occurrence
        sights.column_begin[first_landmark + m] = n_column
        place = 0
        for k in range(n_starts):
            wide = place_of[starts[k]]
            place_of[starts[k]] = place
            for q in range(wide):
                sights.column[n_column] = starts[k] + q
                n_column += 1
            place += wide
        for o in range(first_occurrence, n_occurrences):
            sights.place_begin[o] = n_places
            unit = sights.occurrence_unit[o]
            for segment in range(segment_begin[unit], segment_begin[unit + 1]):
                sights.place[n_places] = place_of[segment_column[segment]]
                n_places += 1
        for k in range(n_starts):
            place_of[starts[k]] = -1
    cursor[0], cursor[1], cursor[2], cursor[3] = n_obs, n_occurrences, n_places, n_column
    return n_units


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
    basis, tangent, half, point = np.empty((4, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for j in range(begin, end):
        c0, c1 = sights.column_begin[j], sights.column_begin[j + 1]
        n = c1 - c0
        arms, column = reduced.arms[3 * c0 : 3 * c1].reshape(3, n), sights.column[c0:c1]
        for a in range(3):
            for b in range(3):
                tangent[a, b] = 1.0 if a == b else 0.0
        for p in range(n):
            for q in range(n):
                c = joint[column[p], column[q]]
                for a in range(3):
                    for b in range(3):
                        tangent[a, b] += arms[a, p] * c * arms[b, q]
        tangent_basis(vector[j], basis)
        w = vector[j, 3]
        for k in range(3):
            for a in range(3):
                point[k, a] = basis[k, a] / w - vector[j, k] * basis[3, a] / (w * w)
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


class _Sighting(NamedTuple):
    """One observation of one landmark: what a loop writes to in passing, allocated once."""

    basis: FloatArray
    """(4, 3) tangents of S^3 at the landmark"""
    residual: FloatArray
    """(2,) whitened"""
    b: FloatArray
    """(2, 3) its derivative by the tangents"""
    d_ray: FloatArray
    """(2, 3) its derivative by the world ray"""
    offset: FloatArray
    """(3,) from the landmark's origin to the camera"""


@compiled
def _sighting() -> _Sighting:
    return _Sighting(np.empty((4, 3)), np.empty(2), np.empty((2, 3)), np.empty((2, 3)), np.empty(3))


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
def _observe(seen: Seen, i: int, vector: FloatArray, origin_m: FloatArray, at: _Sighting) -> bool:
    """Residual and derivative of one observation to `at`, by the tangents there; whether in front."""
    image = seen.image[i]
    offset, d_ray, basis, b = at.offset, at.d_ray, at.basis, at.b
    for k in range(3):
        offset[k] = seen.centre_m[image, k] - origin_m[k]
    in_front = sight(
        seen.to_pixel[image], offset, vector, seen.uv_px[i], seen.whitening[i], at.residual, d_ray
    )
    for m in range(2):
        d0, d1, d2 = d_ray[m, 0], d_ray[m, 1], d_ray[m, 2]
        d3 = -(d0 * offset[0] + d1 * offset[1] + d2 * offset[2])
        for k in range(3):
            b[m, k] = d0 * basis[0, k] + d1 * basis[1, k] + d2 * basis[2, k] + d3 * basis[3, k]
    return in_front


@compiled
def _hold_w(b: FloatArray, basis: FloatArray) -> None:
    """Take from a derivative (2, 3) at w = 0 its part along w, where that is one of the tangents."""
    for m in range(2):
        along = b[m, 0] * basis[3, 0] + b[m, 1] * basis[3, 1] + b[m, 2] * basis[3, 2]
        for k in range(3):
            b[m, k] -= along * basis[3, k]


@compiled
def _add_normal(b: FloatArray, weight: float, v: FloatArray) -> None:
    """Add one observation's part to a normal matrix (3, 3)."""
    for p in range(3):
        for q in range(3):
            v[p, q] += weight * (b[0, p] * b[0, q] + b[1, p] * b[1, q])


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
    at = _sighting()
    for j in which:
        tangent_basis(vector[j], at.basis)
        for i in range(seen.begin[j], seen.begin[j + 1]):
            in_front[i] = _observe(seen, i, vector[j], origin_m[j], at)
            # Entry by entry: numba compiles an assignment of whole arrays for seconds.
            for m in range(2):
                residual[i, m] = at.residual[m]
                for k in range(3):
                    b[i, m, k] = at.b[m, k]


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
    at = _sighting()
    for j in which:
        for i in range(seen.begin[j], seen.begin[j + 1]):
            in_front[i] = _observe(seen, i, vector[j], origin_m[j], at)
            residual[i, 0], residual[i, 1] = at.residual[0], at.residual[1]


@compiled
def free_derivatives(which: IntArray, begin: IntArray, vector: FloatArray, b: FloatArray) -> None:
    """Take from derivatives (n, 2, 3) their part along w where a landmark is held at infinity."""
    basis = np.empty((4, 3))
    for j in which:
        if vector[j, 3] == 0:
            tangent_basis(vector[j], basis)
            for i in range(begin[j], begin[j + 1]):
                _hold_w(b[i], basis)


@compiled
def cofactors(which: IntArray, begin: IntArray, b: FloatArray, weight: FloatArray, out: FloatArray) -> None:
    """Covariances (n, 2, 2) of whitened residuals with derivatives (n, 2, 3) and weights (n,)."""
    v, turn = np.empty((3, 3)), np.empty((3, 3))
    for j in which:
        v[:] = 0.0
        for i in range(begin[j], begin[j + 1]):
            _add_normal(b[i], weight[i], v)
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
    v, turn, vector = np.empty((3, 3)), np.empty((3, 3)), np.ones(4)
    residual, d_ray = np.empty(2), np.empty((2, 3))
    for j in which:
        for k in range(3):
            vector[k] = points_m[j, k]
        v[:] = 0.0
        for i in range(seen.begin[j], seen.begin[j + 1]):
            if weight[i] > 0:
                image = seen.image[i]
                centre = seen.centre_m[image]
                sight(seen.to_pixel[image], centre, vector, seen.uv_px[i], seen.whitening[i], residual, d_ray)
                _add_normal(d_ray, weight[i], v)
        eigen(v, turn)
        out[j] = min(v[0, 0], v[1, 1], v[2, 2])


# --- refinement ---


@compiled
def _normal(
    seen: Seen,
    j: int,
    vector: FloatArray,
    origin_m: FloatArray,
    weight: FloatArray,
    kind: int,
    width: float,
    held: bool,
    at: _Sighting,
    v: FloatArray,
    g: FloatArray,
) -> float:
    """Cost of landmark j at a vector (4,), its normal matrix (3, 3) and its gradient (3,)."""
    tangent_basis(vector, at.basis)
    b, residual = at.b, at.residual
    v[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    for i in range(seen.begin[j], seen.begin[j + 1]):
        if weight[i] == 0:
            continue
        in_front = _observe(seen, i, vector, origin_m, at)
        if held:
            _hold_w(b, at.basis)
        squared = residual[0] * residual[0] + residual[1] * residual[1]
        cost += weight[i] * (loss_cost(kind, width, squared) + (0.0 if in_front else _REFINE_BEHIND_COST))
        own = weight[i] * loss_weight(kind, width, squared)
        _add_normal(b, own, v)
        for k in range(3):
            g[k] += own * (b[0, k] * residual[0] + b[1, k] * residual[1])
    return cost


@compiled
def _newton(v: FloatArray, g: FloatArray, turn: FloatArray, step: FloatArray) -> float:
    """Step (3,) -V^-1 g along those directions that the rays determine; its product with g. Destroys V."""
    eigen(v, turn)
    floor = 1e-13 * max(v[0, 0], v[1, 1], v[2, 2]) + 1e-300
    step[:] = 0.0
    slope = 0.0
    for k in range(3):
        if v[k, k] > floor:
            along = turn[0, k] * g[0] + turn[1, k] * g[1] + turn[2, k] * g[2]
            slope -= along * along / v[k, k]
            for p in range(3):
                step[p] -= turn[p, k] * along / v[k, k]
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
    vector: FloatArray,
) -> None:
    """Best landmarks, from `vector` (landmarks, 4) and back to it; see `landmarks.refine`."""
    at, v, g, turn = _sighting(), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    step, trial = np.empty(3), np.empty(4)
    for j in which:
        here, origin = vector[j], origin_m[j]
        held = False
        while True:
            cost = _normal(seen, j, here, origin, weight, kind, width, held, at, v, g)
            slope = _newton(v, g, turn, step)
            damping = 1e-6
            for _ in range(_REFINE_STEPS):
                length = np.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
                share = min(1.0 / (1.0 + damping), 0.5 / max(length, 1e-300))
                tangent_basis(here, at.basis)
                norm = 0.0
                for p in range(4):
                    along = at.basis[p, 0] * step[0] + at.basis[p, 1] * step[1] + at.basis[p, 2] * step[2]
                    trial[p] = here[p] + share * along
                    if held and p == 3:
                        trial[p] = 0.0
                    norm += trial[p] * trial[p]
                for p in range(4):
                    trial[p] /= np.sqrt(norm)
                trial_cost = _normal(seen, j, trial, origin, weight, kind, width, held, at, v, g)
                better = trial_cost < cost
                damping = min(max(damping * (0.1 if better else 100.0), 1e-12), 1e9)
                # A landmark stays where a step promises next to nothing, or where no damping makes one gain.
                settled = -0.5 * share * slope <= 1e-9 * cost + 1e-12 or (not better and damping > 1e6)
                if better:
                    for p in range(4):
                        here[p] = trial[p]
                    cost = trial_cost
                if settled:
                    break
                if better:
                    slope = _newton(v, g, turn, step)
            norm = np.sqrt(here[0] * here[0] + here[1] * here[1] + here[2] * here[2])
            # One whose vector is its origin alone has no direction in which infinity could be.
            if held or beyond_infinity or not (here[3] < 0 and norm > 1e-9):
                break
            # Beyond infinity: brought to it, and refined there.
            for k in range(3):
                here[k] /= norm
            here[3] = 0.0
            held = True


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
