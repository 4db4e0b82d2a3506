"""Sizes that random numbers exceed with a small chance.

SciPy has them too, but takes longer to import than a small solve takes.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from pancam_graph.base.compiled import entry, part
from pancam_graph.base.geometry import FloatArray

__all__ = ["chi_square_limit", "normal_limit"]

_ROUNDS = 200
_SETTLED = 1e-15


def normal_limit(chance: float) -> float:
    """What a standard normal number exceeds with a chance above 0, of 0.5 at most.

    By Newton's method on the logarithm of the chance, which is concave. Raises ValueError for other chances.
    """
    if not 0 < chance <= 0.5:
        raise ValueError(f"chance: expected a number above 0 and of 0.5 at most, found {chance}")
    x = math.sqrt(-2 * math.log(2 * chance))  # beyond the limit
    for _ in range(_ROUNDS):
        tail = 0.5 * math.erfc(x / math.sqrt(2))
        density = math.exp(-x * x / 2) / math.sqrt(2 * math.pi)
        step = math.log(tail / chance) * tail / density
        x += step
        if abs(step) <= _SETTLED * max(x, 1.0):
            break
    return max(x, 0.0)


def chi_square_limit(freedom: ArrayLike, chance: float) -> FloatArray:
    """Sizes (n,) that chi-square of degrees of freedom (n,), above 0, exceeds with a chance below 1.

    Raises ValueError for other chances and freedoms.
    """
    of = np.asarray(freedom, dtype=float)
    if not 0 < chance < 1:
        raise ValueError(f"chance: expected a number between 0 and 1, found {chance}")
    if not np.all(of > 0):
        raise ValueError(f"freedom: expected numbers above 0, found {of.min()}")
    out = np.empty(of.size)
    _chi_square_limits(of.flatten(), float(chance), out)
    return out.reshape(of.shape)


@part
def _tail(a: float, x: float, logarithm: float) -> float:
    """Upper regularised incomplete gamma function Q(a, x); `logarithm` is that of its density times x.

    By the series of the lower one below a + 1, and by the continued fraction above (Abramowitz and Stegun,
    Handbook of Mathematical Functions, 1964, 6.5.29 and 6.5.31; evaluated as Lentz did, 1976).
    """
    if x < a + 1:
        term = total = 1.0 / a
        k = a
        while term > 1e-17 * total:
            k += 1.0
            term *= x / k
            total += term
        return float(max(1.0 - total * np.exp(logarithm), 0.0))
    b = x + 1.0 - a
    c, d = 1e300, 1.0 / b
    product = d
    for i in range(1, 1_000_000):
        numerator = -i * (i - a)
        b += 2.0
        d = 1.0 / (numerator * d + b)
        c = b + numerator / c
        product *= c * d
        if abs(c * d - 1.0) < 1e-16:
            break
    return float(product * np.exp(logarithm))


@entry
def _chi_square_limits(freedom: FloatArray, chance: float, limit: FloatArray) -> None:
    """`chi_square_limit`, to `limit` (n,): Newton's method on the logarithm of the chance, between bounds."""
    for i in range(len(freedom)):
        a = 0.5 * freedom[i]
        low, high, x = 0.0, np.inf, max(a, 0.5)
        of_gamma = math.lgamma(a)
        for _ in range(_ROUNDS):
            logarithm = a * np.log(x) - x - of_gamma
            tail = _tail(a, x, logarithm)
            if tail > chance:
                low = x
            else:
                high = x
            density = np.exp(logarithm) / x
            tried = x + np.log(tail / chance) * tail / density if tail > 0 and density > 0 else high
            if not low < tried < high:
                tried = 2.0 * x if high == np.inf else 0.5 * (low + high)
            step, x = tried - x, tried
            if abs(step) <= _SETTLED * x:
                break
        limit[i] = 2.0 * x
