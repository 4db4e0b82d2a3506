"""Numbers for a page: rounded for JSON, formatted for readers, round factors of enlargement."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = [
    "Json",
    "decimals_for",
    "fixed",
    "lengths",
    "polyline",
    "round_factor",
    "rounded",
    "short",
    "thinned",
]

Json = dict[str, Any]
"""An object of Plotly's JSON."""

_ABSENT = "\N{EN DASH}"


def rounded(values: ArrayLike, decimals: int) -> list[float | None]:
    """Numbers (n,) as JSON holds them: rounded, and None where not finite."""
    array = np.round(np.asarray(values, dtype=float), decimals) + 0.0  # + 0.0: no negative zeros
    numbers: list[float | None] = array.tolist()
    if np.isfinite(array).all():
        return numbers
    return [n if ok else None for n, ok in zip(numbers, np.isfinite(array).tolist(), strict=True)]


def decimals_for(extent: float) -> int:
    """Decimals that resolve a ten-thousandth of an extent, at least 0."""
    if not (np.isfinite(extent) and extent > 0):
        return 4
    return max(0, 4 - int(np.floor(np.log10(extent))))


def polyline(strips: FloatArray, decimals: int) -> list[list[float | None]]:
    """Coordinates of k strips of m points (k, m, d) as d columns, a gap (None) after each strip."""
    k, _, d = strips.shape
    gapped = np.concatenate([strips, np.full((k, 1, d), np.nan)], axis=1).reshape(-1, d)
    return [rounded(gapped[:, axis], decimals) for axis in range(d)]


def thinned(n: int, limit: int) -> IntArray:
    """Rows of n, evenly spaced and at most `limit` of them; the same ones in every call."""
    if n <= limit:
        return np.arange(n)
    return np.linspace(0, n - 1, limit).astype(np.int64)


def round_factor(wanted: float) -> float:
    """Largest of ..., 1, 2, 5, 10, 20, 50, ... up to `wanted`; at least 1, and 1 where not finite."""
    if not np.isfinite(wanted) or wanted < 1:
        return 1.0
    power = 10.0 ** np.floor(np.log10(wanted) + 1e-12)
    return float(power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9)))


def lengths(residuals_px: FloatArray) -> FloatArray:
    """Lengths (m,) of the finite ones among residual vectors (n, 2)."""
    norms = np.linalg.norm(residuals_px, axis=1)
    return np.asarray(norms[np.isfinite(norms)])


def fixed(value: float, decimals: int) -> str:
    """A number with a fixed count of decimals, for columns; a dash where not finite."""
    if not np.isfinite(value):
        return _ABSENT
    text = f"{value:.{decimals}f}"
    return text.lstrip("-") if not text.strip("-0.") else text  # no negative zeros


def short(value: float) -> str:
    """A number with three significant digits, thousands separated; a dash where not finite."""
    if not np.isfinite(value):
        return _ABSENT
    size = abs(value)
    if size == 0:
        return "0"
    if size < 1e-3 or size >= 1e6:
        mantissa, exponent = f"{value:.2e}".split("e")
        return f"{mantissa}·10{str(int(exponent)).translate(_SUPERSCRIPT)}"
    if size >= 999.5:
        return f"{value:,.0f}"
    return f"{value:#.3g}".rstrip(".")


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
