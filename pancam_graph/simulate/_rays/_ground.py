"""The ground: nested grids of heights, bilinear between nodes, with slopes, reflectance, rock and shade."""

import math

import numpy as np

from pancam_graph.base.compiled import entry, uncounted
from pancam_graph.base.geometry import FloatArray
from pancam_graph.simulate._rays._world import (
    ALBEDO,
    ALONG_X,
    ALONG_Y,
    CHANNELS,
    FIRST,
    OUTCROP,
    SHADE,
    SLOPE_X,
    SLOPE_Y,
    STEP,
    Scene,
    X,
    Y,
)

__all__ = ["NEAREST_M", "height_at", "heights", "level_at", "march", "march_start", "sample"]

NEAREST_M = 0.05
_RIM = 1  # meshes along the border of a grid for which the next coarser grid is used
_COARSEST = 5  # size of squares, 2^k meshes, with which a ray from the camera begins


@uncounted.inlined
def level_at(scene: Scene, x: float, y: float) -> int:
    """The finest grid that covers a place; the coarsest where none does."""
    out = len(scene.height_shape) - 1
    for level in range(len(scene.height_shape) - 1):
        a = (x - scene.frame_m[level, 0, X]) / scene.frame_m[level, 0, STEP]
        b = (y - scene.frame_m[level, 0, Y]) / scene.frame_m[level, 0, STEP]
        wide, deep = scene.height_shape[level, ALONG_X], scene.height_shape[level, ALONG_Y]
        if a >= _RIM and b >= _RIM and a < wide - 1 - _RIM and b < deep - 1 - _RIM:
            out = level
            break
    return out


@uncounted.inlined
def height_at(scene: Scene, level: int, x: float, y: float) -> float:
    """Height of a grid at a place; without meaning outside the grid."""
    a = (x - scene.frame_m[level, 0, X]) / scene.frame_m[level, 0, STEP]
    b = (y - scene.frame_m[level, 0, Y]) / scene.frame_m[level, 0, STEP]
    wide, deep = scene.height_shape[level, ALONG_X], scene.height_shape[level, ALONG_Y]
    i, j = min(max(int(a), 0), wide - 2), min(max(int(b), 0), deep - 2)
    u, v = a - i, b - j
    at = scene.height_shape[level, FIRST] + j * wide + i
    low = scene.height_m[at] + u * (scene.height_m[at + 1] - scene.height_m[at])
    high = scene.height_m[at + wide] + u * (scene.height_m[at + wide + 1] - scene.height_m[at + wide])
    over: float = low + v * (high - low)
    return over


@entry
def _heights(scene: Scene, xy_m: FloatArray, out: FloatArray) -> None:
    for i in range(len(xy_m)):
        x, y = xy_m[i, 0], xy_m[i, 1]
        out[i] = height_at(scene, level_at(scene, x, y), x, y)


def heights(scene: Scene, xy_m: FloatArray) -> FloatArray:
    """Height of the ground (n,) at x and y (n, 2), without rocks and stones."""
    out = np.empty(len(xy_m))
    _heights(scene, np.ascontiguousarray(xy_m, dtype=float), out)
    return out


@uncounted.inlined
def sample(
    scene: Scene, level: int, x: float, y: float, foot: float
) -> tuple[float, float, float, float, float]:
    """Means of the ground's channels, in their order, over a round footprint of diameter `foot`."""
    last = scene.surface_shape.shape[1] - 1
    wider = foot / scene.frame_m[level, 0, STEP]
    mip = math.log2(wider) if wider > 1 else 0.0
    first = min(int(mip), last)
    part = mip - first
    c0 = c1 = c2 = c3 = c4 = 0.0
    for m in range(first, min(first + 2, last + 1)):
        share = 1 - part if m == first else part
        if m == last:
            share = 1.0
        elif share < 1e-3:
            continue
        wide, deep = scene.surface_shape[level, m, ALONG_X], scene.surface_shape[level, m, ALONG_Y]
        a = (x - scene.frame_m[level, m, X]) / scene.frame_m[level, m, STEP]
        b = (y - scene.frame_m[level, m, Y]) / scene.frame_m[level, m, STEP]
        a, b = min(max(a, 0.0), wide - 1.001), min(max(b, 0.0), deep - 1.001)
        i, j = int(a), int(b)
        u, v = a - i, b - j
        at = CHANNELS * (scene.surface_shape[level, m, FIRST] + j * wide + i)
        up = at + CHANNELS * wide
        beside, up_beside = at + CHANNELS, up + CHANNELS
        s = scene.surface
        w, e = (1 - u) * (1 - v) * share, u * (1 - v) * share
        f, g = (1 - u) * v * share, u * v * share
        c0 += w * s[at + SLOPE_X] + e * s[beside + SLOPE_X] + f * s[up + SLOPE_X] + g * s[up_beside + SLOPE_X]
        c1 += w * s[at + SLOPE_Y] + e * s[beside + SLOPE_Y] + f * s[up + SLOPE_Y] + g * s[up_beside + SLOPE_Y]
        c2 += w * s[at + ALBEDO] + e * s[beside + ALBEDO] + f * s[up + ALBEDO] + g * s[up_beside + ALBEDO]
        c3 += w * s[at + OUTCROP] + e * s[beside + OUTCROP] + f * s[up + OUTCROP] + g * s[up_beside + OUTCROP]
        c4 += w * s[at + SHADE] + e * s[beside + SHADE] + f * s[up + SHADE] + g * s[up_beside + SHADE]
        if m == last:
            break
    return c0, c1, c2, c3, c4


@uncounted.inlined
def march_start(
    scene: Scene, dx: float, dy: float, dz: float, ex: float, ey: float, ez: float, reached: float
) -> float:
    """Distance before which a ray d cannot meet the ground: a ray e from the same place met it at `reached`.

    If d rises over e by more than the ground may rise sideways between them, d is free as far as e was.
    """
    across, other = math.sqrt(dx * dx + dy * dy), math.sqrt(ex * ex + ey * ey)
    rise, aside = dz * other - ez * across, abs(dx * ey - dy * ex)
    if dx * ex + dy * ey <= 0 or rise < scene.steep * aside:
        return NEAREST_M
    return max(NEAREST_M, reached * other / across)


@uncounted.inlined
def march(
    scene: Scene, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, start: float
) -> float:
    """Distance along a ray to the ground, not before `start`; infinite in the sky.

    Squares of meshes that lie wholly below the ray are passed in one step (Tevs, Ihrke and Seidel 2008,
    Maximum mipmaps for fast, accurate, and scalable dynamic height field rendering); in a mesh the ray meets
    a bilinear surface, which is a quadratic equation.
    """
    dx = dx if abs(dx) > 1e-12 else 1e-12
    dy = dy if abs(dy) > 1e-12 else 1e-12
    per_x, per_y = 1 / dx, 1 / dy
    to_i, to_j = (1 if dx > 0 else 0), (1 if dy > 0 else 0)
    t, found = start, math.inf
    squaring = 0 if start > NEAREST_M else _COARSEST
    for level in range(len(scene.height_shape)):
        if found < math.inf or t == math.inf:
            break
        x0, y0, step = scene.frame_m[level, 0, X], scene.frame_m[level, 0, Y], scene.frame_m[level, 0, STEP]
        start_h, wide, deep = (
            scene.height_shape[level, FIRST],
            scene.height_shape[level, ALONG_X],
            scene.height_shape[level, ALONG_Y],
        )
        rim_x = x0 + step * (wide - 1 - _RIM if to_i else _RIM)
        rim_y = y0 + step * (deep - 1 - _RIM if to_j else _RIM)
        leave = min((rim_x - ox) * per_x, (rim_y - oy) * per_y)
        while t < leave:
            if dz >= 0 and oz + t * dz > scene.top_m:
                t = math.inf
                break
            size = step * (1 << squaring)
            start_c, wide_c, deep_c = (
                scene.ceiling_shape[level, squaring, FIRST],
                scene.ceiling_shape[level, squaring, ALONG_X],
                scene.ceiling_shape[level, squaring, ALONG_Y],
            )
            # A little further on, since rounding might keep a ray on a border for ever.
            beyond = t + 1e-9 * (1 + t)
            i = min(max(int((ox + beyond * dx - x0) / size), 0), wide_c - 1)
            j = min(max(int((oy + beyond * dy - y0) / size), 0), deep_c - 1)
            end_i, end_j = (x0 + (i + to_i) * size - ox) * per_x, (y0 + (j + to_j) * size - oy) * per_y
            end = max(min(end_i, end_j, leave), beyond)
            if min(oz + t * dz, oz + end * dz) > scene.ceiling_m[start_c + j * wide_c + i]:
                t = end
                # The ray enters another square of the next size, which may be free as a whole.
                on = (i & 1) == to_i if end_i < end_j else (j & 1) == to_j
                if on and squaring < scene.ceiling_shape.shape[1] - 1:
                    squaring += 1
                continue
            if squaring > 0:
                squaring -= 1
                continue
            a, b, up = (ox + t * dx - x0) / step - i, (oy + t * dy - y0) / step - j, oz + t * dz
            p, q, at = dx / step, dy / step, start_h + j * wide + i
            h = scene.height_m[at]
            by_a, by_b = scene.height_m[at + 1] - h, scene.height_m[at + wide] - h
            twist = scene.height_m[at + wide + 1] - h - by_a - by_b
            c = up - (h + a * by_a + b * by_b + a * b * twist)
            if c <= 0:
                found = t
                break
            slope = dz - p * (by_a + b * twist) - q * (by_b + a * twist)
            bend = -p * q * twist
            root = slope * slope - 4 * bend * c
            if root >= 0:
                root = math.sqrt(root)
                ahead = 2 * c / (root - slope) if slope < 0 else -(slope + root) / (2 * bend)
                if ahead > 0 and t + ahead <= end:
                    found = t + ahead
                    break
            t = end
    return found
