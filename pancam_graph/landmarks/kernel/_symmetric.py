"""Small symmetric matrices: their eigenvalues, and normal matrices summed row by row."""

import numpy as np

from pancam_graph.base.compiled import part
from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = ["UNDETERMINED", "add_row", "diagonalise", "least_direction"]

UNDETERMINED = 1e-9
"""A direction of a landmark is undetermined if its pivot is below this share of the trace of V."""

_FAR_MORE = 1e-7
"""Least share of the trace of all pivots but the last, for the least eigenvalue to be by far the least."""
_ROUNDING = 1e-17
"""The last pivot, at least: one that is less is rounding."""
_ROUNDS = 8


@part
def diagonalise(a: FloatArray, turn: FloatArray) -> None:
    """Replace a symmetric matrix (m, m) by the diagonal matrix of its eigenvalues, in no order of size.

    The columns of `turn` (m, m) become the eigenvectors. By cyclic Jacobi rotations: small eigenvalues of a
    positive semidefinite matrix come out at least as accurate as LAPACK's (Demmel and Veselić, Jacobi's
    method is more accurate than QR, 1992). Ends also for entries that are not finite.
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


@part
def least_direction(a: FloatArray, order: IntArray, half: FloatArray, settled: float, x: FloatArray) -> bool:
    """Turn x (m,) into the eigenvector of the least eigenvalue of a positive semidefinite matrix (m, m).

    By inverse iteration from x, with a pivoted factorisation a = L D L', which replaces the matrix: a third
    of the time of all eigenvectors. It ends when a round changes x by a squared length below `settled`; the
    next would change it by far less. Returns False where the least eigenvalue is not by far the least, or x
    is as good as orthogonal to what is looked for: x then means nothing. `order` (m,) and `half` (m,) are
    overwritten.
    """
    m, trace = len(a), 0.0
    for p in range(m):
        order[p] = p
        trace += a[p, p]
    for p in range(m):
        best = p
        for q in range(p + 1, m):
            if a[order[q], order[q]] > a[order[best], order[best]]:
                best = q
        order[p], order[best] = order[best], order[p]
        i = order[p]
        if p == m - 1:
            a[i, i] = max(a[i, i], _ROUNDING * trace)
        elif not a[i, i] > _FAR_MORE * trace:
            return False
        for q in range(p + 1, m):
            k = order[q]
            share = a[k, i] / a[i, i]
            for r in range(p + 1, q + 1):
                h = order[r]
                a[k, h] -= share * a[h, i]
                a[h, k] = a[k, h]
            half[q] = share
        for q in range(p + 1, m):
            a[order[q], i] = half[q]
    for _ in range(_ROUNDS):
        for p in range(m):
            total = x[order[p]]
            for q in range(p):
                total -= a[order[p], order[q]] * half[q]
            half[p] = total
        norm = 0.0
        for p in range(m - 1, -1, -1):
            total = half[p] / a[order[p], order[p]]
            for q in range(p + 1, m):
                total -= a[order[q], order[p]] * half[q]
            half[p] = total
            norm += total * total
        norm = np.sqrt(norm) if half[m - 1] * x[order[m - 1]] > 0 else -np.sqrt(norm)
        change = 0.0
        for p in range(m):
            moved = half[p] / norm
            change += (moved - x[order[p]]) * (moved - x[order[p]])
            x[order[p]] = moved
        if change < settled:
            return True
    return False


@part
def add_row(v: FloatArray, weight: float, b0: float, b1: float, b2: float) -> None:
    """Add weight b'b, b being a row (3,) of a Jacobian, to a normal matrix (3, 3)."""
    v[0, 0] += weight * b0 * b0
    v[1, 1] += weight * b1 * b1
    v[2, 2] += weight * b2 * b2
    v[0, 1] += weight * b0 * b1
    v[0, 2] += weight * b0 * b2
    v[1, 2] += weight * b1 * b2
    v[1, 0], v[2, 0], v[2, 1] = v[0, 1], v[0, 2], v[1, 2]
