"""Linearisation of observations and elimination of landmarks."""

from collections.abc import Callable

import numpy as np

from pancam_graph.base.compiled import entry, is_on_disk, part
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks.kernel._loss import BEHIND_COST, NONE, loss_cost, loss_weight
from pancam_graph.landmarks.kernel._observe import observe_ray, residual_by_ray
from pancam_graph.landmarks.kernel._order import Bearings, Reduced, Sights
from pancam_graph.landmarks.kernel._sphere import by_tangents, tangents
from pancam_graph.landmarks.kernel._symmetric import UNDETERMINED
from pancam_graph.landmarks.kernel._tiles import subtract_row, tile_entry

__all__ = ["WEAK_PRIOR", "eliminate_calibrations", "eliminate_poses", "must_compile"]

WEAK_PRIOR = 1e-12
"""Weak prior of a landmark: its information, over the trace of what the landmark's observations know."""


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
                        tiles[tile_entry(column_b + p, column_a + q, n_pairs)] += total


@part
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


@part
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
                    in_front, r0, r1, u, v, per_depth = observe_ray(
                        to_pixel, image, X0 - w * c0, X1 - w * c1, X2 - w * c2, uv_px, whitening, i
                    )
                    if not in_front:
                        cost += BEHIND_COST
                        continue
                    squared = r0 * r0 + r1 * r1
                    cost += loss_cost(kind, width, squared)
                    root = 1.0 if kind == NONE else np.sqrt(loss_weight(kind, width, squared))
                    r0, r1 = root * r0, root * r1
                    d00, d01, d02, d10, d11, d12 = residual_by_ray(
                        to_pixel, image, u, v, root * per_depth, whitening, i
                    )
                    b00, b01, b02 = by_tangents(t, d00, d01, d02, -(d00 * c0 + d01 * c1 + d02 * c2))
                    b10, b11, b12 = by_tangents(t, d10, d11, d12, -(d10 * c0 + d11 * c1 + d12 * c2))
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
            floor, prior = UNDETERMINED * trace, WEAK_PRIOR * trace + 1e-300
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
        _add_units(unit_H, unit_s, unit_of, bearings, segment_column, tiles, s)

    return eliminate


eliminate_poses = _eliminating(6)
"""Linearise and eliminate landmarks begin to end; adds to S (upper triangle, in tiles) and s of their block.

Exact Schur complement of the whitened, robustly weighted system: S = A'A - sum E V^-1 E' and
s = A'r - sum E V^-1 g with E = A'B, V = B'B, g = B'r for the cameras' Jacobian A and each landmark's B.
V gets the weak prior where it needs one, and no damping."""
eliminate_calibrations = _eliminating(11)
"""The same for chains with calibrations."""


def must_compile() -> bool:
    """Whether the elimination must be compiled before a solve, which then takes longer."""
    return not is_on_disk(eliminate_poses)
