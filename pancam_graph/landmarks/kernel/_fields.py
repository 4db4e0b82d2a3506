"""Smooth distortion fields in the elimination: what it adds to their columns and to those of the cameras.

An observation touches 16 coefficients of u and 16 of v, no two alike. So the columns of fields are not among
the pairs that `eliminate_poses` goes through. They get passes of their own, which use what that has left of
each landmark: V = L L', gamma = L^-1 g and the arms W = L^-1 E'.
"""

from typing import NamedTuple

import numpy as np

from pancam_graph.base.compiled import part
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks.kernel._compiling import entry
from pancam_graph.landmarks.kernel._eliminate import by_calibration, cross, in_base
from pancam_graph.landmarks.kernel._loss import NONE, loss_weight
from pancam_graph.landmarks.kernel._observe import observe_ray, residual_by_ray
from pancam_graph.landmarks.kernel._order import Bearings, Reduced, Sights
from pancam_graph.landmarks.kernel._sphere import by_tangents, tangents

__all__ = ["FieldSights", "eliminate_fields"]


class FieldSights(NamedTuple):
    """Where the observations lie in their fields, and what elimination keeps of them there.

    The coefficients that an observation touches are those of rows 0 to 3 and columns 0 to 3 after `first`;
    those of v follow the ones of u by `per_axis`.
    """

    first: IntArray
    """(n,) column of the first coefficient of u that each observation touches"""
    weight: FloatArray
    """(n, 4, 4) derivative of the field at the observation by these"""
    per_row: int
    """Columns from one row of coefficients to the next."""
    per_axis: int
    """Columns from the coefficients of u to those of v."""
    arms: FloatArray
    """(n, 2, 3) L^-1 B' W of the landmark of each observation: its part of the arms by the field at it"""


@part
def _add_outer(to: FloatArray, row: int, factor: float, fields: FieldSights, i: int, column: int) -> None:
    """Add to a row, from a column on, `factor` times the weights of observation i."""
    for a in range(4):
        at = column + a * fields.per_row
        for b in range(4):
            to[row, at + b] += factor * fields.weight[i, a, b]


@part
def _add_own(fields: FieldSights, i: int, k: int, c: int, d: int, q: float, own: FloatArray) -> None:
    """Add q times the product of the weights of two observations, of axes c and d, to `own`."""
    for a in range(4):
        for b in range(4):
            row = fields.first[i] + c * fields.per_axis + a * fields.per_row + b
            column = fields.first[k] + d * fields.per_axis
            _add_outer(own, row, q * fields.weight[i, a, b], fields, k, column)


@entry
def eliminate_fields(
    sights: Sights,
    bearings: Bearings,
    fields: FieldSights,
    vector: FloatArray,
    origin_m: FloatArray,
    kind: int,
    width: float,
    begin: int,
    end: int,
    segment_column: IntArray,
    n_units: int,
    reduced: Reduced,
    across: FloatArray,
    own: FloatArray,
    right: FloatArray,
) -> None:
    """Add what landmarks begin to end tell about fields to the Schur complement (S, s).

    The landmarks are linearised and eliminated already, at the same place. `across` (columns of the block,
    columns of fields) is the part of S between other variables and fields, `own` half of the part among
    fields: that is own + own'. `right` is the part of s. Writes `fields.arms`.

    With F the Jacobian by the field at each observation (its whitening) times the weights, and Y = L^-1 B'F:
    across = A'F - W'Y, own + own' = F'F - Y'Y, right = F'r - Y' gamma.
    """
    rows = bearings.chain.shape[1]
    unit_F, unit_of = np.zeros((n_units, rows, own.shape[0])), np.full(n_units, -1)
    cameras, centre_m, arms = bearings.cameras, bearings.cameras.centre_m, reduced.arms
    jac, by_base, q = np.zeros((2, 5)), np.zeros((2, rows)), np.zeros((2, 2))
    white = np.zeros((2, 2))
    for j in range(begin, end):
        X0, X1, X2, w = vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3]
        O0, O1, O2 = origin_m[j, 0], origin_m[j, 1], origin_m[j, 2]
        t, f, gamma = tangents(X0, X1, X2, w), reduced.factor[j], reduced.gamma[j]
        first_pair, last_pair = sights.pair_begin[j], sights.pair_begin[j + 1]
        first_seen = sights.occurrence_begin[sights.landmark_begin[j]]
        for o in range(sights.landmark_begin[j], sights.landmark_begin[j + 1]):
            unit, row = sights.occurrence_unit[o], sights.occurrence_row[o]
            unit_of[row] = unit
            y0 = X0 - w * (bearings.unit_t[unit, 0] - O0)
            y1 = X1 - w * (bearings.unit_t[unit, 1] - O1)
            y2 = X2 - w * (bearings.unit_t[unit, 2] - O2)
            x = in_base(bearings.unit_R, unit, (y0, y1, y2))
            for i in range(sights.occurrence_begin[o], sights.occurrence_begin[o + 1]):
                image, column = sights.image[i], fields.first[i]
                c0, c1, c2 = centre_m[image, 0] - O0, centre_m[image, 1] - O1, centre_m[image, 2] - O2
                y0, y1, y2 = X0 - w * c0, X1 - w * c1, X2 - w * c2
                in_front, r0, r1, u_px, v_px, per_depth = observe_ray(
                    cameras, image, y0, y1, y2, w, sights.uv_px, sights.whitening, i
                )
                if not in_front:
                    fields.arms[i] = 0.0
                    continue
                root = 1.0 if kind == NONE else np.sqrt(loss_weight(kind, width, r0 * r0 + r1 * r1))
                d00, d01, d02, d10, d11, d12, w0, w1 = residual_by_ray(
                    cameras, image, y0, y1, y2, w, u_px, v_px, root * per_depth, sights.whitening, i
                )
                b0 = by_tangents(t, d00, d01, d02, w0 - (d00 * c0 + d01 * c1 + d02 * c2))
                b1 = by_tangents(t, d10, d11, d12, w1 - (d10 * c0 + d11 * c1 + d12 * c2))
                e0 = in_base(bearings.unit_R, unit, (d00, d01, d02))
                e1 = in_base(bearings.unit_R, unit, (d10, d11, d12))
                t0, t1 = cross(e0, x), cross(e1, x)
                for k in range(3):
                    by_base[0, k], by_base[1, k] = t0[k], t1[k]
                    by_base[0, 3 + k], by_base[1, 3 + k] = -w * e0[k], -w * e1[k]
                if rows > 6:
                    by_calibration(cameras.calibration, image, u_px, v_px, sights.whitening, i, root, jac)
                    for k in range(rows - 6):
                        by_base[0, 6 + k], by_base[1, 6 + k] = jac[0, k], jac[1, k]
                for m in range(2):
                    for c in range(2):
                        white[m, c] = root * sights.whitening[i, m, c]
                for c in range(2):
                    a, b = white[0, c], white[1, c]
                    n0 = (a * b0[0] + b * b1[0]) / f[0]
                    n1 = (a * b0[1] + b * b1[1] - f[1] * n0) / f[2]
                    n2 = (a * b0[2] + b * b1[2] - f[3] * n0 - f[4] * n1) / f[5]
                    fields.arms[i, c, 0], fields.arms[i, c, 1], fields.arms[i, c, 2] = n0, n1, n2
                    at = column + c * fields.per_axis
                    told = root * (a * r0 + b * r1) - (n0 * gamma[0] + n1 * gamma[1] + n2 * gamma[2])
                    for p in range(4):
                        for s in range(4):
                            right[at + p * fields.per_row + s] += told * fields.weight[i, p, s]
                    for k in range(rows):
                        _add_outer(unit_F[row], k, a * by_base[0, k] + b * by_base[1, k], fields, i, at)
                    for p in range(first_pair, last_pair):
                        for half in range(2):
                            z = 6 * p + half
                            told = -(arms[z] * n0 + arms[z + 2] * n1 + arms[z + 4] * n2)
                            _add_outer(across, 2 * sights.pair[p] + half, told, fields, i, at)
                    for d in range(2):
                        own_part = 0.5 * (white[0, c] * white[0, d] + white[1, c] * white[1, d])
                        _add_own(fields, i, i, c, d, own_part, own)
                # Products with the landmark's observations up to this one.
                for k in range(first_seen, i + 1):
                    share = 0.5 if k == i else 1.0
                    for c in range(2):
                        for d in range(2):
                            q[c, d] = 0.0
                            for m in range(3):
                                q[c, d] -= share * fields.arms[i, c, m] * fields.arms[k, d, m]
                            _add_own(fields, i, k, c, d, q[c, d], own)
    for row in range(n_units):
        unit = unit_of[row]
        if unit < 0:
            continue
        for segment in range(bearings.segment_begin[unit], bearings.segment_begin[unit + 1]):
            for column in range(bearings.segment_width[segment]):
                at = segment_column[segment] + column
                for k in range(rows):
                    along = bearings.chain[segment, k, column]
                    if along != 0.0:
                        for m in range(own.shape[0]):
                            across[at, m] += along * unit_F[row, k, m]
