"""Random detail that is a function of the place alone."""

import math

import numpy as np

from pancam_graph.base.compiled import entry, uncounted
from pancam_graph.base.geometry import FloatArray
from pancam_graph.simulate._rays._world import Grids

__all__ = ["hashed", "make_lattice", "noise", "noise_in_space", "noises"]

_SIDE = 256  # the number of wavelengths after which noise repeats
_LAST = _SIDE - 1


def make_lattice(rng: np.random.Generator) -> Grids:
    """Slopes (side, side, 2) at the nodes of noise."""
    return rng.uniform(-1, 1, (_SIDE, _SIDE, 2)).astype(np.float32)


@uncounted.part
def hashed(i: int, j: int, key: int) -> int:
    """32 random bits that depend on the cell (i, j) and the key alone."""
    h = (i * 374761393 + j * 668265263 + key * 974711) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1103515245) & 0xFFFFFFFF
    return h ^ (h >> 16)


@uncounted.part
def noise(lattice: Grids, x: float, y: float, key: int) -> tuple[float, float, float]:
    """Gradient noise of unit wavelength (Perlin 2002), RMS about 0.25, and its derivatives by x and y."""
    i, j = math.floor(x), math.floor(y)
    u, v = x - i, y - j
    p, q = (int(i) + 57 * key) & _LAST, (int(j) + 131 * key) & _LAST
    m, n = (p + 1) & _LAST, (q + 1) & _LAST
    ax, ay, bx, by = lattice[q, p, 0], lattice[q, p, 1], lattice[q, m, 0], lattice[q, m, 1]
    cx, cy, dx, dy = lattice[n, p, 0], lattice[n, p, 1], lattice[n, m, 0], lattice[n, m, 1]
    at_a, at_b = ax * u + ay * v, bx * (u - 1) + by * v
    at_c, at_d = cx * u + cy * (v - 1), dx * (u - 1) + dy * (v - 1)
    s, r = u * u * u * (u * (u * 6 - 15) + 10), v * v * v * (v * (v * 6 - 15) + 10)
    ds, dr = 30 * u * u * (u - 1) * (u - 1), 30 * v * v * (v - 1) * (v - 1)
    low, high = at_a + s * (at_b - at_a), at_c + s * (at_d - at_c)
    low_x = ax + s * (bx - ax) + ds * (at_b - at_a)
    high_x = cx + s * (dx - cx) + ds * (at_d - at_c)
    low_y, high_y = ay + s * (by - ay), cy + s * (dy - cy)
    return (
        low + r * (high - low),
        low_x + r * (high_x - low_x),
        low_y + r * (high_y - low_y) + dr * (high - low),
    )


@uncounted.part
def noise_in_space(x: float, y: float, z: float, key: int) -> tuple[float, float, float, float]:
    """Value noise of unit wavelength in [-1, 1], and its gradient."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - i, y - j, z - k
    s, du = u * u * (3 - 2 * u), 6 * u * (1 - u)
    r, dv = v * v * (3 - 2 * v), 6 * v * (1 - v)
    q, dw = w * w * (3 - 2 * w), 6 * w * (1 - w)
    value = gx = gy = gz = 0.0
    for c in range(8):
        p, m, n = c & 1, (c >> 1) & 1, c >> 2
        corner = (hashed(int(i) + p, int(j) + m, key + 7919 * (int(k) + n)) & 0xFFFF) / 32768.0 - 1
        a, b, e = (s if p else 1 - s), (r if m else 1 - r), (q if n else 1 - q)
        value += corner * a * b * e
        gx += corner * (du if p else -du) * b * e
        gy += corner * a * (dv if m else -dv) * e
        gz += corner * a * b * (dw if n else -dw)
    return value, gx, gy, gz


@entry
def _noises(
    lattice: Grids,
    x: FloatArray,
    y: FloatArray,
    longest_m: float,
    shortest_m: float,
    gain: float,
    key: int,
    out: FloatArray,
) -> None:
    for n in range(len(x)):
        length, size, px, py, k = longest_m, 1.0, x[n], y[n], key
        while length >= shortest_m:
            out[n] += size * noise(lattice, px / length, py / length, k)[0]
            px, py = 0.8 * px - 0.6 * py + 17.3, 0.6 * px + 0.8 * py - 9.1
            length, size, k = 0.5 * length, gain * size, k + 1


def noises(
    lattice: Grids,
    x: FloatArray,
    y: FloatArray,
    longest_m: float,
    shortest_m: float,
    gain: float,
    key: int,
) -> FloatArray:
    """Fractal noise at n places: octaves from the longest wavelength down, each `gain` of the one before.

    Each octave is rotated against the one before, so that the lattice of the noise does not show.
    """
    out = np.zeros(len(x))
    _noises(lattice, x, y, longest_m, shortest_m, gain, key, out)
    return out
