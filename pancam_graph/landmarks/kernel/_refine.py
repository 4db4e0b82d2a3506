"""Landmarks refined with all cameras held, each on its own."""

import numpy as np

from pancam_graph.base.compiled import part
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks.kernel._compiling import entry
from pancam_graph.landmarks.kernel._loss import loss_cost, loss_weight
from pancam_graph.landmarks.kernel._observe import Seen, observe
from pancam_graph.landmarks.kernel._sphere import Tangents, retracted, tangents, without_w
from pancam_graph.landmarks.kernel._symmetric import UNDETERMINED, add_row, diagonalise

__all__ = ["refine"]

_REFINE_BEHIND_COST = 1e12
"""Cost of an observation whose landmark is behind its camera: above that of any residual, and small enough
that differences of other costs are not lost in rounding."""
_REFINE_STEPS = 15


@part
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
    """Cost of landmark j at (x, w), whose tangents are t; normal matrix (3, 3) to v, gradient (3,) to g.

    `held`: the landmark is held at infinity, w at 0.
    """
    O0, O1, O2 = origin_m[j, 0], origin_m[j, 1], origin_m[j, 2]
    v[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    for i in range(seen.begin[j], seen.begin[j + 1]):
        if weight[i] == 0:
            continue
        in_front, r0, r1, b00, b01, b02, b10, b11, b12 = observe(seen, i, t, x0, x1, x2, w, O0, O1, O2)
        if held:
            b00, b01, b02 = without_w(t, b00, b01, b02)
            b10, b11, b12 = without_w(t, b10, b11, b12)
        squared = r0 * r0 + r1 * r1
        cost += weight[i] * (loss_cost(kind, width, squared) + (0.0 if in_front else _REFINE_BEHIND_COST))
        robust = weight[i] * loss_weight(kind, width, squared)
        add_row(v, robust, b00, b01, b02)
        add_row(v, robust, b10, b11, b12)
        g[0] += robust * (b00 * r0 + b10 * r1)
        g[1] += robust * (b01 * r0 + b11 * r1)
        g[2] += robust * (b02 * r0 + b12 * r1)
    return cost


@part
def _newton(v: FloatArray, g: FloatArray, turn: FloatArray, step: FloatArray) -> float:
    """Step -V^-1 g along the directions that the rays determine, to `step` (3,). Returns its product with g.

    Overwrites V.
    """
    floor = UNDETERMINED * (v[0, 0] + v[1, 1] + v[2, 2])
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
    diagonalise(v, turn)
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


@entry
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
    """Refine the landmarks `which` of `vector` (landmarks, 4) in place; see `landmarks.refine`."""
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
                if held:  # rounding moves w off 0
                    x3 = 0.0
                tried = tangents(x0, x1, x2, x3)
                trial_cost = _normal(
                    seen, j, tried, x0, x1, x2, x3, origin_m, weight, kind, width, held, v, g
                )
                better = trial_cost < cost
                damping = min(max(damping * (0.1 if better else 100.0), 1e-12), 1e9)
                # The end: a step promises next to no gain, or with any damping it gains nothing.
                settled = -0.5 * share * slope <= tolerance * cost + 1e-12 or (not better and damping > 1e6)
                if better:
                    a0, a1, a2, a3, t, cost = x0, x1, x2, x3, tried, trial_cost
                if settled:
                    break
                if better:
                    slope = _newton(v, g, turn, step)
            norm = np.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
            # A landmark at its own origin has no direction in which it could be brought to infinity.
            if held or beyond_infinity or not (a3 < 0 and norm > 1e-9):
                break
            # A landmark beyond infinity is brought to infinity, and refined there.
            a0, a1, a2, a3 = a0 / norm, a1 / norm, a2 / norm, 0.0
            held = True
        vector[j, 0], vector[j, 1], vector[j, 2], vector[j, 3] = a0, a1, a2, a3
