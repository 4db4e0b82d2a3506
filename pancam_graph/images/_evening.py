"""Equal brightness: a gain of each image and the vignetting that all of them share, from their overlaps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray

__all__ = ["Evening", "Small", "even_out"]

_POWERS = np.array([1, 2, 3])
"""Powers of the squared radius in the logarithm of the vignetting."""
_PRIOR_PX = 1.0
"""Weight of the prior for a gain of 1, as a number of pixels of an overlap."""
_PRIOR_VIGNETTING = 1.0
"""Standard deviation of the prior for each coefficient of the vignetting about 0."""
_LEAST_COMMON = 50
"""Least number of pixels, in shrunken layers, of an overlap that is used."""
_LEAST_PAIRS = 4
"""Least number of overlaps from whose scatter the uncertainty of the vignetting is estimated."""
_RADII = np.linspace(0.25, 1.0, 7)
"""Radii, as shares of the half diagonal, at which a vignetting is compared with its uncertainty."""
_KNOWN = 0.03
"""Uncertainty of the vignetting, as a share of the brightness, from which it is not used."""
_SIGNIFICANT = 4.0
"""By how many of its sigmas a vignetting must differ from none at one of the radii."""
_LEAST = 0.01
"""Share of the brightness that it must take there at least. Blending hides less than that, and things that
move between two images produce as much by themselves."""
_ROUNDS = 5
_DARK = 0.02
"""Share of the brightest sample below which logarithms are mostly noise."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Evening:
    """What makes images of one camera equally bright."""

    gain: dict[int, float]
    """By image, the factor that its brightness is multiplied with."""
    vignetting: FloatArray
    """(3,) coefficients of r^2, r^4 and r^6 in the logarithm of the brightness that is left at r half
    diagonals from the middle of an image; zeros where overlaps do not determine it."""
    sigma: float | None
    """Standard deviation of that logarithm in the corners; None where it is not estimated."""

    def factor(self, number: int, radius_squared: NDArray[np.floating]) -> NDArray[np.float32]:
        """The factor of an image's brightness at squared radii, an array of any shape."""
        gain = np.float32(self.gain[number])
        if not self.vignetting.any():
            return np.full(radius_squared.shape, gain, dtype=np.float32)
        r = radius_squared.astype(np.float32)
        a, b, c = self.vignetting.astype(np.float32)
        return np.asarray(gain * np.exp(-r * (a + r * (b + r * c))), dtype=np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Small:
    """An image on a common grid of pixels, in the box that it covers; most often shrunk."""

    number: int
    """Number of its image."""
    left_px: int
    top_px: int
    grey: NDArray[np.float32]
    chosen: BoolArray
    """Where the whole pixel has data that no mask covers."""
    radius_squared: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Overlap:
    """Pixels that two images share."""

    rows: tuple[int, int]
    """Indices of the two images among the unknown gains."""
    ratio: FloatArray
    """(n,) logarithm of the second's brightness over the first's"""
    powers: FloatArray
    """(n, 3) powers of the squared radius in the second less those in the first"""


def even_out(layers: Sequence[Small]) -> Evening:
    """Gains, and the vignetting where overlaps determine it, by robust least squares on logarithms.

    Brightness is exposure times vignetting times scene: in the ratio of two images that overlap the scene
    cancels. A prior keeps gains near 1, which fixes their common factor, and that of each group of images
    without overlap with others. Vignetting is used if overlaps agree on it: its uncertainty is the scatter of
    solutions that leave out one overlap each (jackknife). Else it is taken to be none.
    """
    numbers = sorted({layer.number for layer in layers})
    n = len(numbers)
    overlaps = list(_overlaps(layers, {number: k for k, number in enumerate(numbers)}))
    solution, _ = _robust(overlaps, n, free=n)
    vignetting, sigma = solution[n:], None
    if len(overlaps) >= _LEAST_PAIRS:
        full, parts = _robust(overlaps, n, free=n + len(_POWERS))
        without = np.array([_solved(parts[:k] + parts[k + 1 :], n, len(full))[n:] for k in range(len(parts))])
        shape = np.power(_RADII[:, None] ** 2, _POWERS)
        change = (without - without.mean(axis=0)) @ shape.T
        spread = np.sqrt((len(parts) - 1) / len(parts) * np.sum(change**2, axis=0))
        darkening = shape @ full[n:]
        if spread.max() < _KNOWN:
            sigma = float(spread[-1])
            if np.any(np.abs(darkening) > np.maximum(_SIGNIFICANT * spread, _LEAST)):
                solution, vignetting = full, full[n:]
    gains = np.exp(solution[:n]).tolist()
    return Evening(gain=dict(zip(numbers, gains, strict=True)), vignetting=vignetting, sigma=sigma)


def _robust(
    overlaps: Sequence[_Overlap], n: int, *, free: int
) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """Gains and vignetting (n + 3,), and the equations of each overlap with the final weights."""
    solution = np.zeros(n + len(_POWERS))
    parts: list[tuple[FloatArray, FloatArray]] = []
    for _ in range(_ROUNDS):
        parts = [_equations(o, solution[n:], solution[:n], n) for o in overlaps]
        solution = _solved(parts, n, free)
    return solution, parts


def _overlaps(layers: Sequence[Small], row: dict[int, int]) -> Iterator[_Overlap]:
    brightest = max((float(layer.grey.max(initial=0)) for layer in layers), default=0.0)
    for k, a in enumerate(layers):
        for b in layers[k + 1 :]:
            cut = _common(a, b)
            if a.number == b.number or cut is None:
                continue
            both = a.chosen[cut[0]] & b.chosen[cut[1]]
            first, second = a.grey[cut[0]], b.grey[cut[1]]
            both &= np.minimum(first, second) > _DARK * brightest
            if np.count_nonzero(both) < _LEAST_COMMON:
                continue
            radii = [s.radius_squared[c][both].astype(float) for s, c in ((a, cut[0]), (b, cut[1]))]
            powers = [np.power(r[:, None], _POWERS) for r in radii]
            yield _Overlap(
                rows=(row[a.number], row[b.number]),
                ratio=np.log(second[both].astype(float)) - np.log(first[both].astype(float)),
                powers=powers[1] - powers[0],
            )


def _common(a: Small, b: Small) -> tuple[tuple[slice, slice], tuple[slice, slice]] | None:
    """The overlap of two layers, as slices of each; None if they do not overlap."""
    corners = [(layer.left_px, layer.top_px) for layer in (a, b)]
    low = np.max(corners, axis=0)
    high = np.min([np.add(c, s.grey.shape[::-1]) for c, s in zip(corners, (a, b), strict=True)], axis=0)
    if np.any(high <= low):
        return None
    parts = []
    for corner in corners:
        (u0, v0), (u1, v1) = (low - corner).tolist(), (high - corner).tolist()
        parts.append((slice(v0, v1), slice(u0, u1)))
    return parts[0], parts[1]


def _equations(
    overlap: _Overlap, vignetting: FloatArray, gains: FloatArray, n: int
) -> tuple[FloatArray, FloatArray]:
    """Normal matrix and right-hand side of an overlap, over gains (n) and vignetting (3).

    Cauchy weights about the solution so far give little weight to glints, and to things that moved and that
    no mask covers.
    """
    i, j = overlap.rows
    miss = overlap.ratio - overlap.powers @ vignetting - (gains[i] - gains[j])
    scale = 1.4826 * float(np.median(np.abs(miss - np.median(miss)))) + 1e-3
    weight = 1 / (1 + ((miss - np.median(miss)) / (2 * scale)) ** 2)
    ones = np.ones(len(miss))
    column = np.column_stack([ones, -ones, overlap.powers])
    at = np.concatenate([[i, j], n + np.arange(len(_POWERS))])
    normal, right = np.zeros((n + len(_POWERS),) * 2), np.zeros(n + len(_POWERS))
    normal[np.ix_(at, at)] = column.T @ (weight[:, None] * column)
    right[at] = column.T @ (weight * overlap.ratio)
    return normal, right


def _solved(parts: Sequence[tuple[FloatArray, FloatArray]], n: int, free: int) -> FloatArray:
    """Gains and vignetting (n + 3,), as logarithms: the first `free` are estimated, the others are 0."""
    size = n + len(_POWERS)
    prior = np.concatenate([np.full(n, _PRIOR_PX), np.full(len(_POWERS), 1 / _PRIOR_VIGNETTING**2)])
    normal, right = np.diag(prior), np.zeros(size)
    for matrix, vector in parts:
        normal += matrix
        right += vector
    out = np.zeros(size)
    out[:free] = np.linalg.solve(normal[:free, :free], right[:free])
    return out
