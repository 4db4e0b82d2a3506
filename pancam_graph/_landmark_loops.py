"""Compiled loops over landmarks with all cameras held; every landmark is on its own.

Each loop works on the landmarks `which` (or on items of an array) and writes to their places alone, so that
parts of them may run at once and in any order.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pancam_graph.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.kernel import compiled, loss_cost, loss_weight, sight, tangent_basis
from pancam_graph.threads import in_parallel

__all__ = [
    "Seen",
    "cofactors",
    "eigen",
    "evaluate",
    "free_derivatives",
    "loss_costs",
    "loss_weights",
    "over",
    "rays",
    "refine",
    "reject",
    "smallest_information",
    "tests",
    "triangulate",
]

_GRAIN = 1024
_BEHIND_COST = 1e12
"""Of an observation behind its camera: more than any residual, and differences of residuals still show."""
_REFINE_STEPS = 15
_NO_BASELINE_M = 1e-9
_MIN_REDUNDANCY = 0.02
"""Directions of a residual that keep less than this of the noise's variance cannot show an error."""


def over(loop: Callable[..., None], which: IntArray, *arguments: object) -> None:
    """Call loop(part, *arguments) for parts of the landmarks `which`, over all threads."""
    in_parallel(lambda first, last: loop(which[first:last], *arguments), len(which), grain=_GRAIN)


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
        cost += weight[i] * (loss_cost(kind, width, squared) + (0.0 if in_front else _BEHIND_COST))
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
