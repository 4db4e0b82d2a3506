"""Landmarks that follow a step of the cameras, their costs, and their covariances."""

import numpy as np

from pancam_graph.base.compiled import part
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks.kernel._compiling import entry
from pancam_graph.landmarks.kernel._loss import BEHIND_COST, loss_cost
from pancam_graph.landmarks.kernel._observe import observe_ray
from pancam_graph.landmarks.kernel._order import Bearings, Reduced, Sights
from pancam_graph.landmarks.kernel._sphere import retracted, tangents

__all__ = ["SURPRISE", "SURPRISE_COST", "follow", "landmark_costs", "point_covariances"]

SURPRISE, SURPRISE_COST = 2.0, 10.0
"""A landmark takes a shorter step if its cost would rise above SURPRISE times the old + SURPRISE_COST."""


@entry
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
    """Move landmarks begin to end along with a step dx (columns of their block,) of the cameras.

    Writes the landmarks to `moved` (landmarks, 4) and their true costs to `cost` (landmarks,). `bearings` are
    the cameras after the step. A landmark's part of the joint step is dp = -V^-1 (g + E' dx). Where that ends
    behind a camera or costs far more than before, the cheapest of a few shorter steps is taken, or none: a
    landmark whose linear prediction fails does not hold back all others.
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
            trial_cost = _cost_at(sights, bearings, x0, x1, x2, w, origin_m, kind, width, j)
            if trial_cost < cost[j]:
                cost[j] = trial_cost
                moved[j, 0], moved[j, 1], moved[j, 2], moved[j, 3] = x0, x1, x2, w
            if trial_cost <= limit:
                break


@part
def _cost_at(
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
    cameras, centre_m = bearings.cameras, bearings.cameras.centre_m
    O0, O1, O2 = origin_m[j, 0], origin_m[j, 1], origin_m[j, 2]
    cost = 0.0
    first, last = sights.landmark_begin[j], sights.landmark_begin[j + 1]
    for i in range(sights.occurrence_begin[first], sights.occurrence_begin[last]):
        image = sights.image[i]
        y0 = x0 - w * (centre_m[image, 0] - O0)
        y1 = x1 - w * (centre_m[image, 1] - O1)
        y2 = x2 - w * (centre_m[image, 2] - O2)
        in_front, r0, r1, _, _, _ = observe_ray(
            cameras, image, y0, y1, y2, w, sights.uv_px, sights.whitening, i
        )
        cost += loss_cost(kind, width, r0 * r0 + r1 * r1) if in_front else BEHIND_COST
    return cost


@entry
def landmark_costs(
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
        cost[i] = _cost_at(sights, bearings, x0, x1, x2, w, origin_m, kind, width, j)


@entry
def point_covariances(
    sights: Sights,
    reduced: Reduced,
    vector: FloatArray,
    joint: FloatArray,
    more: FloatArray,
    begin: int,
    end: int,
    covariance_m2: FloatArray,
) -> None:
    """Covariances (landmarks, 3, 3) of the points X / w of landmarks begin to end.

    `joint` is the covariance C of the variables of their block. In the tangent space a landmark's covariance
    is L^-T (I + W C W' + more) L^-1, W being its `arms`; the derivative of X / w takes it to the point.
    `more` (end - begin, 3, 3) is what variables outside the block add.
    """
    arms, pair = reduced.arms, sights.pair
    tangent, half, point = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for j in range(begin, end):
        first, last = sights.pair_begin[j], sights.pair_begin[j + 1]
        for a in range(3):
            for b in range(3):
                tangent[a, b] = more[j - begin, a, b] + (1.0 if a == b else 0.0)
        # C is symmetric: its lower triangle with half of the diagonal, then the sum with the transpose.
        half[:] = 0.0
        for p in range(2 * first, 2 * last):
            row, i = 2 * pair[p >> 1] + (p & 1), 6 * (p >> 1) + (p & 1)
            y0 = y1 = y2 = 0.0
            for q in range(2 * first, p + 1):
                c, k = joint[row, 2 * pair[q >> 1] + (q & 1)], 6 * (q >> 1) + (q & 1)
                c *= 0.5 if q == p else 1.0
                y0 += c * arms[k]
                y1 += c * arms[k + 2]
                y2 += c * arms[k + 4]
            for a in range(3):
                half[a, 0] += arms[i + 2 * a] * y0
                half[a, 1] += arms[i + 2 * a] * y1
                half[a, 2] += arms[i + 2 * a] * y2
        for a in range(3):
            for b in range(3):
                tangent[a, b] += half[a, b] + half[b, a]
        w = vector[j, 3]
        t = tangents(vector[j, 0], vector[j, 1], vector[j, 2], w)
        for k in range(3):
            far = vector[j, k] / (w * w)
            for a in range(3):
                point[k, a] = t[3 * k + a] / w - far * t[9 + a]
        f = reduced.factor[j]
        for k in range(3):  # rows of the point's derivative times L^-T
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
