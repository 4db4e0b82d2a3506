"""Small symmetric matrices: their eigenvalues, and normal matrices summed row by row."""

import numpy as np

from pancam_graph.base.compiled import part
from pancam_graph.base.geometry import FloatArray

__all__ = ["UNDETERMINED", "add_row", "diagonalise"]

UNDETERMINED = 1e-9
"""A direction of a landmark is undetermined if its pivot is below this share of the trace of V."""


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
def add_row(v: FloatArray, weight: float, b0: float, b1: float, b2: float) -> None:
    """Add weight b'b, b being a row (3,) of a Jacobian, to a normal matrix (3, 3)."""
    v[0, 0] += weight * b0 * b0
    v[1, 1] += weight * b1 * b1
    v[2, 2] += weight * b2 * b2
    v[0, 1] += weight * b0 * b1
    v[0, 2] += weight * b0 * b2
    v[1, 2] += weight * b1 * b2
    v[1, 0], v[2, 0], v[2, 1] = v[0, 1], v[0, 2], v[1, 2]
