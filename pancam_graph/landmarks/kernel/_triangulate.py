"""Linear triangulation of landmarks from their rays."""

import numpy as np

from pancam_graph.base.compiled import part
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks.kernel._compiling import entry
from pancam_graph.landmarks.kernel._symmetric import diagonalise

__all__ = ["triangulate"]

_NO_BASELINE_M = 1e-9


@part
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
    """Triangulate one landmark from its m rays, to `vector` (4,) and `origin_m` (3,).

    See `landmarks.triangulate`. `form` (4, 4), `turn` (4, 4) and `arm` (3,) are overwritten.
    """
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
            share = 1.0 if alike else weight[i]
            if again:
                range_squared = 0.0
                for k in range(3):
                    towards = vector[k] - vector[3] * (centre_m[i, k] - origin_m[k])
                    range_squared += towards * towards
                share /= max(range_squared, 1e-12)
            for p in range(3):
                form[p, p] += share
                for q in range(p + 1):
                    form[p, q] -= share * d[p] * d[q]
                if parallax:
                    form[3, p] -= share * arm[p] / baseline
            form[3, 3] += share * (square / (baseline * baseline) if parallax else 1.0)
        for p in range(3):
            for q in range(p + 1, 4):
                form[p, q] = form[q, p]
        diagonalise(form, turn)
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


@part
def _arm(centre_m: FloatArray, direction: FloatArray, origin_m: FloatArray, arm: FloatArray) -> float:
    """Vector from the origin to a ray's centre, without its part along the ray, to `arm` (3,).

    Returns its squared length.
    """
    along, square = 0.0, 0.0
    for k in range(3):
        arm[k] = centre_m[k] - origin_m[k]
        along += arm[k] * direction[k]
    for k in range(3):
        arm[k] -= along * direction[k]
        square += arm[k] * arm[k]
    return square


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
    form, turn, arm = np.empty((4, 4)), np.empty((4, 4)), np.empty(3)
    for j in which:
        rows = slice(begin[j], begin[j + 1])
        _triangulate(centre_m[rows], direction[rows], weight[rows], form, turn, arm, vector[j], origin_m[j])
