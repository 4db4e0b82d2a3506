"""Rays against ground, rocks and the rover's deck, and the light that comes back: what runs per pixel.

One module, since Numba's cache on disk watches only the file of a function, not those that it calls. All
detail is a function of the place on the surface, never of the image: the same point looks the same from
everywhere. Detail finer than a pixel's footprint is left out, octave by octave.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from pancam_graph.geometry import FloatArray, IntArray
from pancam_graph.kernel import compiled

__all__ = ["Deck", "Scene", "heights", "hits", "noise", "noises", "render", "smooth"]

_F = TypeVar("_F", bound=Callable[..., Any])

Grids = NDArray[np.float32]

_NEAREST_M = 0.05
_MAX_STEPS = 800
_MAX_TAPS = 4
_PEBBLE_CELL_M = 0.12  # pebbles up to 2 cm are painted on the ground; what is larger is a rock
_FACES = 64
_PI = math.pi


class Scene(NamedTuple):
    """Everything fixed to the world, as arrays that the compiled loops read."""

    height_m: Grids
    """Heights of all grids, one after the other."""
    albedo: Grids
    """Reflectance at the same nodes."""
    outcrop: Grids
    """0 soil to 1 bare rock at the same nodes."""
    shape: IntArray
    """(levels, mips, 3): where a grid starts, its nodes along x and along y. A mip halves the one before."""
    frame_m: FloatArray
    """(levels, mips, 3): x and y of its first node, and its step."""
    slope: FloatArray
    """(levels,) bound of the slope there."""
    top_m: float
    """Height of the highest ground."""
    rough_m: float
    """By how much the finest grid departs from the next one, up and down together."""
    tall_m: float
    """By how much rocks rise over the ground."""
    rocks: FloatArray
    """(rocks, 17): centre, world to unit ball (9, by rows), top, form, albedo, radius from above, key."""
    forms: FloatArray
    """(forms, planes, 4): unit normal and distance of the planes that cut a ball into a rock's form."""
    cells: IntArray
    """(cells + 1,) where the rocks of a cell start in `cell_rocks`; x runs fastest."""
    cell_rocks: IntArray
    """Rocks of all cells."""
    cell_top_m: FloatArray
    """(cells,) height of the highest rock there."""
    cell_frame_m: FloatArray
    """(3,) x and y of the corner of the first cell, and the width of a cell."""
    cell_shape: tuple[int, int]
    """Cells along x and along y."""
    rock_top_m: float
    """Height of the highest rock."""
    sun: FloatArray
    """(3,) unit vector to the sun."""
    haze_m: float
    """Distance at which 63 % of the light is the haze's."""
    key: int
    """Which fine detail."""


class Deck(NamedTuple):
    """The rover's deck as one mast sees it: flat plates that move along with the mast."""

    rotation: FloatArray
    """(3, 3) world_R_mast."""
    centre_m: FloatArray
    """(3,) of the mast in the world."""
    plates_m: FloatArray
    """(plates, corners, 3): convex, anticlockwise, in the mast frame; none where there is no deck."""


def _inlined(function: _F) -> _F:
    """Compile into its callers: to hand the many arrays of a scene to a call costs as much as its work."""
    dispatcher: Any = numba.njit(inline="always", nogil=True, error_model="numpy", fastmath={"contract"})(
        function
    )
    return cast(_F, dispatcher)


# --- noise ---


@compiled
def _hash(i: int, j: int, key: int) -> int:
    h = (i * 374761393 + j * 668265263 + key * 974711) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1103515245) & 0xFFFFFFFF
    return h ^ (h >> 16)


@compiled
def noise(x: float, y: float, key: int) -> tuple[float, float, float]:
    """Gradient noise of unit wavelength (Perlin 2002), RMS about 0.25, and its derivatives by x and y."""
    i, j = math.floor(x), math.floor(y)
    u, v = x - i, y - j
    i, j = int(i), int(j)
    a, b = _hash(i, j, key), _hash(i + 1, j, key)
    c, d = _hash(i, j + 1, key), _hash(i + 1, j + 1, key)
    k = 1 / 32768.0
    ax, ay = (a & 0xFFFF) * k - 1, (a >> 16) * k - 1
    bx, by = (b & 0xFFFF) * k - 1, (b >> 16) * k - 1
    cx, cy = (c & 0xFFFF) * k - 1, (c >> 16) * k - 1
    dx, dy = (d & 0xFFFF) * k - 1, (d >> 16) * k - 1
    at_a, at_b = ax * u + ay * v, bx * (u - 1) + by * v
    at_c, at_d = cx * u + cy * (v - 1), dx * (u - 1) + dy * (v - 1)
    s, r = u * u * u * (u * (u * 6 - 15) + 10), v * v * v * (v * (v * 6 - 15) + 10)
    ds, dr = 30 * u * u * (u - 1) ** 2, 30 * v * v * (v - 1) ** 2
    low, high = at_a + s * (at_b - at_a), at_c + s * (at_d - at_c)
    low_x = ax + s * (bx - ax) + ds * (at_b - at_a)
    high_x = cx + s * (dx - cx) + ds * (at_d - at_c)
    low_y, high_y = ay + s * (by - ay), cy + s * (dy - cy)
    return (
        low + r * (high - low),
        low_x + r * (high_x - low_x),
        low_y + r * (high_y - low_y) + dr * (high - low),
    )


@compiled
def _noise_in_space(x: float, y: float, z: float, key: int) -> tuple[float, float, float, float]:
    """Value noise of unit wavelength in [-1, 1], and its gradient."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - i, y - j, z - k
    s, du = u * u * (3 - 2 * u), 6 * u * (1 - u)
    r, dv = v * v * (3 - 2 * v), 6 * v * (1 - v)
    q, dw = w * w * (3 - 2 * w), 6 * w * (1 - w)
    value = gx = gy = gz = 0.0
    for c in range(8):
        p, m, n = c & 1, (c >> 1) & 1, c >> 2
        corner = (_hash(int(i) + p, int(j) + m, key + 7919 * (int(k) + n)) & 0xFFFF) / 32768.0 - 1
        a, b, e = (s if p else 1 - s), (r if m else 1 - r), (q if n else 1 - q)
        value += corner * a * b * e
        gx += corner * (du if p else -du) * b * e
        gy += corner * a * (dv if m else -dv) * e
        gz += corner * a * b * (dw if n else -dw)
    return value, gx, gy, gz


@compiled
def noises(
    x: FloatArray, y: FloatArray, longest_m: float, shortest_m: float, gain: float, key: int
) -> FloatArray:
    """Fractal noise at n places: octaves from the longest wavelength down, each `gain` of the one before.

    Each octave is turned against the last, so that no lattice shows.
    """
    out = np.zeros(len(x))
    for n in range(len(x)):
        length, size, px, py, k = longest_m, 1.0, x[n], y[n], key
        while length >= shortest_m:
            out[n] += size * noise(px / length, py / length, k)[0]
            px, py = 0.8 * px - 0.6 * py + 17.3, 0.6 * px + 0.8 * py - 9.1
            length, size, k = 0.5 * length, gain * size, k + 1
    return out


# --- the ground ---


@compiled
def _level(shape: IntArray, frame_m: FloatArray, x: float, y: float) -> int:
    """The finest grid that has ground around a place; as many as there are outside all."""
    for level in range(len(shape)):
        a = (x - frame_m[level, 0, 0]) / frame_m[level, 0, 2]
        b = (y - frame_m[level, 0, 1]) / frame_m[level, 0, 2]
        if a >= 1 and b >= 1 and a < shape[level, 0, 1] - 2 and b < shape[level, 0, 2] - 2:
            return level
    return len(shape)


@compiled
def _height(height_m: Grids, shape: IntArray, frame_m: FloatArray, level: int, x: float, y: float) -> float:
    """The surface: bilinear between the nodes of the finest grid."""
    if level == len(shape):
        return -1e9
    a = (x - frame_m[level, 0, 0]) / frame_m[level, 0, 2]
    b = (y - frame_m[level, 0, 1]) / frame_m[level, 0, 2]
    i, j = int(a), int(b)
    u, v = a - i, b - j
    wide = shape[level, 0, 1]
    at = shape[level, 0, 0] + j * wide + i
    low: float = height_m[at] + u * (height_m[at + 1] - height_m[at])
    high: float = height_m[at + wide] + u * (height_m[at + wide + 1] - height_m[at + wide])
    over: float = low + v * (high - low)
    return over


@compiled
def heights(scene: Scene, xy_m: FloatArray) -> FloatArray:
    """Height of the ground (n,) at x and y (n, 2)."""
    out = np.empty(len(xy_m))
    for i in range(len(xy_m)):
        x, y = xy_m[i, 0], xy_m[i, 1]
        level = _level(scene.shape, scene.frame_m, x, y)
        out[i] = _height(scene.height_m, scene.shape, scene.frame_m, level, x, y)
    return out


@_inlined
def _sample(scene: Scene, level: int, mip: int, x: float, y: float) -> tuple[float, float, float, float]:
    """Slopes along x and y, albedo and outcrop of a mip: quadratic B-splines over its nodes."""
    step = scene.frame_m[level, mip, 2]
    a = (x - scene.frame_m[level, mip, 0]) / step
    b = (y - scene.frame_m[level, mip, 1]) / step
    wide, deep = scene.shape[level, mip, 1], scene.shape[level, mip, 2]
    i = min(max(math.floor(a + 0.5), 1), wide - 2)
    j = min(max(math.floor(b + 0.5), 1), deep - 2)
    u, v = min(max(a - i, -0.5), 0.5), min(max(b - j, -0.5), 0.5)
    u0, u1, u2 = 0.5 * (0.5 - u) ** 2, 0.75 - u * u, 0.5 * (0.5 + u) ** 2
    v0, v1, v2 = 0.5 * (0.5 - v) ** 2, 0.75 - v * v, 0.5 * (0.5 + v) ** 2
    e0, e1, e2 = u - 0.5, -2 * u, u + 0.5
    f0, f1, f2 = v - 0.5, -2 * v, v + 0.5
    slope_x = slope_y = albedo = outcrop = 0.0
    for k in range(3):
        at = scene.shape[level, mip, 0] + (j - 1 + k) * wide + i
        w, f = (v0, f0) if k == 0 else ((v1, f1) if k == 1 else (v2, f2))
        p, q, r = scene.height_m[at - 1], scene.height_m[at], scene.height_m[at + 1]
        slope_x += w * (e0 * p + e1 * q + e2 * r)
        slope_y += f * (u0 * p + u1 * q + u2 * r)
        albedo += w * (u0 * scene.albedo[at - 1] + u1 * scene.albedo[at] + u2 * scene.albedo[at + 1])
        outcrop += w * (u0 * scene.outcrop[at - 1] + u1 * scene.outcrop[at] + u2 * scene.outcrop[at + 1])
    return slope_x / step, slope_y / step, albedo, outcrop


@_inlined
def _march(
    scene: Scene, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, float]:
    """Distance along a ray to the ground (infinite in the sky), and up to where no rock can be met."""
    height, shape, frame, slope = scene.height_m, scene.shape, scene.frame_m, scene.slope
    top, tall, rough = scene.top_m, scene.tall_m, scene.rough_m
    across = math.hypot(dx, dy)
    before, was, t, over = 0.0, 1.0, _NEAREST_M, 1.0
    free_of_rocks, contiguous = 0.0, True
    level, last = 0, len(slope) - 1
    first_x, first_y, step = frame[0, 0, 0], frame[0, 0, 1], frame[0, 0, 2]
    start, wide, deep = shape[0, 0, 0], shape[0, 0, 1], shape[0, 0, 2]
    closing = slope[0] * across - dz
    gently = slope[min(1, last)] * across - dz
    found = False
    for _ in range(_MAX_STEPS):
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        if dz >= 0 and z > top:
            return math.inf, free_of_rocks
        a, b = (x - first_x) / step, (y - first_y) / step
        while not (a >= 1 and b >= 1 and a < wide - 2 and b < deep - 2):
            if level == last:
                return math.inf, free_of_rocks
            level += 1
            first_x, first_y, step = frame[level, 0, 0], frame[level, 0, 1], frame[level, 0, 2]
            start, wide, deep = shape[level, 0, 0], shape[level, 0, 1], shape[level, 0, 2]
            closing = slope[level] * across - dz
            gently = closing
            rough = 0.0
            a, b = (x - first_x) / step, (y - first_y) / step
        i, j = int(a), int(b)
        u, v = a - i, b - j
        at = start + j * wide + i
        low = height[at] + u * (height[at + 1] - height[at])
        high = height[at + wide] + u * (height[at + wide + 1] - height[at + wide])
        over = z - (low + v * (high - low))
        if over <= 0:
            found = True
            break
        before, was = t, over
        # Well above ground only the slope without the finest relief counts.
        free = max(over / max(closing, 1e-6), (over - rough) / max(gently, 1e-6))
        if contiguous:
            contiguous = over > tall
            if contiguous:
                free_of_rocks = t + (over - tall) / max(closing, 1e-6)
        # The next level may be steeper than this one; and what is finer than a pixel may be passed by.
        t += max(min(free, 0.5 * t + 1.0), t * (0.0015 + 2e-5 * t))
    if not found:
        return math.inf, free_of_rocks
    # Regula falsi (Illinois) between above and below.
    low, high, above, below, side = before, t, was, over, 0
    for _ in range(40):
        t = low + (high - low) * above / (above - below)
        x, y = ox + t * dx, oy + t * dy
        over = oz + t * dz - _height(height, shape, frame, _level(shape, frame, x, y), x, y)
        if abs(over) < 1e-7 * (1 + t) or high - low < 1e-9 * (1 + t):
            break
        if over > 0:
            low, above = t, over
            below *= 0.5 if side > 0 else 1.0
            side = 1
        else:
            high, below = t, over
            above *= 0.5 if side < 0 else 1.0
            side = -1
    return t, free_of_rocks


# --- rocks ---


@compiled
def _cut(
    rocks: FloatArray,
    forms: FloatArray,
    n: int,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> tuple[float, int]:
    """Where a ray enters rock n (infinite: nowhere), and through which plane (-1: through the ball)."""
    px, py, pz = ox - rocks[n, 0], oy - rocks[n, 1], oz - rocks[n, 2]
    ax = rocks[n, 3] * px + rocks[n, 4] * py + rocks[n, 5] * pz
    ay = rocks[n, 6] * px + rocks[n, 7] * py + rocks[n, 8] * pz
    az = rocks[n, 9] * px + rocks[n, 10] * py + rocks[n, 11] * pz
    bx = rocks[n, 3] * dx + rocks[n, 4] * dy + rocks[n, 5] * dz
    by = rocks[n, 6] * dx + rocks[n, 7] * dy + rocks[n, 8] * dz
    bz = rocks[n, 9] * dx + rocks[n, 10] * dy + rocks[n, 11] * dz
    bb, ab, aa = bx * bx + by * by + bz * bz, ax * bx + ay * by + az * bz, ax * ax + ay * ay + az * az
    inside = ab * ab - bb * (aa - 1)
    if inside <= 0:
        return math.inf, -1
    root = math.sqrt(inside)
    enter, leave, face = (-ab - root) / bb, (-ab + root) / bb, -1
    form = int(rocks[n, 13])
    for k in range(forms.shape[1]):
        nx, ny, nz = forms[form, k, 0], forms[form, k, 1], forms[form, k, 2]
        towards = nx * bx + ny * by + nz * bz
        out = nx * ax + ny * ay + nz * az - forms[form, k, 3]
        if towards < 0:
            t = -out / towards
            if t > enter:
                enter, face = t, k
        elif towards > 0:
            leave = min(leave, -out / towards)
        elif out > 0:
            return math.inf, -1
    if enter >= leave or enter <= 1e-6:
        return math.inf, -1
    return enter, face


@compiled
def _hit_rocks(
    scene: Scene,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    begin: float,
    end: float,
    any_of: bool,
) -> tuple[float, int, int]:
    """The first rock (or any one) between two distances: distance, rock (-1: none), plane.

    Walks the cells below the ray. The distance is `end` where there is none.
    """
    rocks, forms, cells = scene.rocks, scene.forms, scene.cells
    cell_rocks, cell_top = scene.cell_rocks, scene.cell_top_m
    best, rock, face = end, -1, -1
    wide, deep = scene.cell_shape
    x0, y0, cell = scene.cell_frame_m[0], scene.cell_frame_m[1], scene.cell_frame_m[2]
    if dz < 0:
        begin = max(begin, (scene.rock_top_m - oz) / dz)
    elif dz > 0:
        end = min(end, (scene.rock_top_m - oz) / dz)
    dx = dx if abs(dx) > 1e-12 else 1e-12
    dy = dy if abs(dy) > 1e-12 else 1e-12
    a, b = (x0 - ox) / dx, (x0 + wide * cell - ox) / dx
    begin, end = max(begin, min(a, b)), min(end, max(a, b))
    a, b = (y0 - oy) / dy, (y0 + deep * cell - oy) / dy
    begin, end = max(begin, min(a, b)), min(end, max(a, b))
    if begin >= end:
        return best, rock, face
    i = min(max(int((ox + begin * dx - x0) / cell), 0), wide - 1)
    j = min(max(int((oy + begin * dy - y0) / cell), 0), deep - 1)
    to_i, to_j = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    next_i = (x0 + (i + (dx > 0)) * cell - ox) / dx
    next_j = (y0 + (j + (dy > 0)) * cell - oy) / dy
    wait_i, wait_j = cell / abs(dx), cell / abs(dy)
    t = begin
    while t < end:
        leave = min(next_i, next_j)
        at = j * wide + i
        if min(oz + t * dz, oz + leave * dz) < cell_top[at]:
            for n in range(cells[at], cells[at + 1]):
                enter, plane = _cut(rocks, forms, cell_rocks[n], ox, oy, oz, dx, dy, dz)
                if enter < best:
                    best, rock, face = enter, cell_rocks[n], plane
                    if any_of:
                        return best, rock, face
            if best <= leave:
                break
        t = leave
        if next_i < next_j:
            i, next_i = i + to_i, next_i + wait_i
            if i < 0 or i >= wide:
                break
        else:
            j, next_j = j + to_j, next_j + wait_j
            if j < 0 or j >= deep:
                break
    return best, rock, face


@_inlined
def _openness(scene: Scene, x: float, y: float) -> float:
    """Share of the sky's light that rocks nearby leave to the ground."""
    wide, deep = scene.cell_shape
    i = math.floor((x - scene.cell_frame_m[0]) / scene.cell_frame_m[2])
    j = math.floor((y - scene.cell_frame_m[1]) / scene.cell_frame_m[2])
    out = 1.0
    if i < 0 or j < 0 or i >= wide or j >= deep:
        return out
    for n in range(scene.cells[j * wide + i], scene.cells[j * wide + i + 1]):
        rock = scene.cell_rocks[n]
        away = math.hypot(x - scene.rocks[rock, 0], y - scene.rocks[rock, 1]) / scene.rocks[rock, 15]
        if away < 1.6:
            out *= 1 - 0.5 * min(1.0, (1.6 - away) / 0.9)
    return out


# --- light ---


@_inlined
def _reflected(
    sun_at: FloatArray, nx: float, ny: float, nz: float, albedo: float, sunlit: float, sky: float
) -> float:
    """Radiance of a rough surface of unit normal under sun and sky."""
    sun: float = max(0.0, nx * sun_at[0] + ny * sun_at[1] + nz * sun_at[2])
    return albedo * (sunlit * sun + sky * 0.22 * (0.6 + 0.4 * nz))


@compiled
def _pebbles(
    sun_at: FloatArray, x: float, y: float, foot: float, cell: float, share: float, key: int
) -> tuple[float, float, float, float, float]:
    """A small stone, at most one a cell: how much of it is here, slopes of its top, shadow, shade."""
    i, j = math.floor(x / cell), math.floor(y / cell)
    h = _hash(int(i), int(j), key)
    if (h & 0xFF) > 255 * share:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    g = _hash(int(i), int(j), key + 1)
    size = (h >> 8 & 0xFF) / 255.0
    radius = cell * (0.05 + 0.12 * size * size * size)
    room = cell - 7 * radius
    cx = i * cell + 3.5 * radius + max(room, 0.0) * (g >> 16 & 0xFF) / 255.0
    cy = j * cell + 3.5 * radius + max(room, 0.0) * (g >> 24 & 0xFF) / 255.0
    if abs(x - cx) > 3.3 * radius or abs(y - cy) > 3.3 * radius:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    turn = _PI * (g & 0xFF) / 255.0
    c, s = math.cos(turn), math.sin(turn)
    long = 1.0 + 0.8 * (g >> 8 & 0xFF) / 255.0
    # A polygon of five uneven sides, so that they are stones and no drops.
    level = h >> 16
    away = lean_u = lean_v = shaded = 0.0
    across = math.hypot(sun_at[0], sun_at[1]) + 1e-9
    length = (0.5 + 0.5 * (level & 15) / 15.0) * radius * across / max(sun_at[2], 0.2)
    u, v = (c * (x - cx) + s * (y - cy)) / (radius * long), (-s * (x - cx) + c * (y - cy)) / radius
    px, py = x + length * sun_at[0] / across - cx, y + length * sun_at[1] / across - cy
    p, q = (c * px + s * py) / (radius * long), (-s * px + c * py) / radius
    # The nearest place to here on the line from the stone to the tip of its shadow.
    tu, tv = u - p, v - q
    part = min(1.0, max(0.0, (u * tu + v * tv) / (tu * tu + tv * tv + 1e-12)))
    wu, wv = u - part * tu, v - part * tv
    narrow = 1 + 0.5 * part
    for k in range(5):
        angle = 1.2566 * k + 0.5 * ((g >> (4 * k) & 15) / 15.0 - 0.5)
        a, b = math.cos(angle), math.sin(angle)
        side = (a * u + b * v) * (0.9 + 0.35 * (h >> (3 * k) & 7) / 7.0)
        shaded = max(shaded, (a * wu + b * wv) * narrow)
        if side > away:
            away, lean_u, lean_v = side, a, b
    edge = max(foot / radius, 0.1)
    fade = min(1.0, max(0.0, 2.2 - foot / radius))
    here = fade * min(1.0, max(0.0, (1 - away) / edge + 0.5))
    shadow = fade * min(1.0, max(0.0, (1 - shaded) / (1.5 * edge) + 0.5)) * (1 - here)
    lean = 0.25 + 0.65 * min(away, 1.0)
    lean_u, lean_v = lean * (0.6 * lean_u + 0.4 * u), lean * (0.6 * lean_v + 0.4 * v)
    return here, -(c * lean_u - s * lean_v), -(s * lean_u + c * lean_v), shadow, (level >> 4 & 15) / 15.0


@compiled
def _crack(x: float, y: float, key: int) -> tuple[float, float]:
    """Distance to the nearest joint of a pavement of unit slabs, and the slab's own shade in [-1, 1]."""
    i, j = math.floor(x), math.floor(y)
    first = second = 9.0
    shade = 0.0
    for a in range(-1, 2):
        for b in range(-1, 2):
            h = _hash(int(i) + a, int(j) + b, key)
            dx, dy = i + a + (h & 0xFF) / 255.0 - x, j + b + (h >> 8 & 0xFF) / 255.0 - y
            d = dx * dx + dy * dy
            if d < first:
                first, second, shade = d, first, (h >> 16 & 0xFF) / 127.5 - 1
            elif d < second:
                second = d
    return 0.5 * (math.sqrt(second) - math.sqrt(first)), shade


@_inlined
def _soil(scene: Scene, level: int, x: float, y: float, foot: float, sunlit: float, sky: float) -> float:
    """Radiance of the ground around a place, over a round footprint of that width."""
    step = scene.frame_m[level, 0, 2]
    mip = max(0.0, math.log2(max(foot, 1e-9) / step))
    m = min(int(mip), scene.shape.shape[1] - 2)
    part = min(mip - m, 1.0)
    gx, gy, albedo, outcrop = _sample(scene, level, m, x, y)
    if part > 0:
        hx, hy, a, o = _sample(scene, level, m + 1, x, y)
        gx, gy, albedo, outcrop = (
            gx + part * (hx - gx),
            gy + part * (hy - gy),
            albedo + part * (a - albedo),
            outcrop + part * (o - outcrop),
        )
    rough = 1 - 0.6 * outcrop if level == 0 else 1.6
    length, px, py, k = 2.4 * step, x, y, scene.key
    c, s = 1.0, 0.0
    while length > 2 * foot and length > 0.0008:
        weight = min(1.0, length / foot - 2) * rough
        value, nx, ny = noise(px / length, py / length, k)
        gx += 0.11 * weight * (c * nx + s * ny)
        gy += 0.11 * weight * (c * ny - s * nx)
        albedo *= 1 + 0.16 * weight * value
        px, py = 0.8 * px - 0.6 * py, 0.6 * px + 0.8 * py
        c, s = 0.8 * c - 0.6 * s, 0.6 * c + 0.8 * s
        length, k = 0.5 * length, k + 1
    if level > 0:
        return _finish(scene.sun, gx, gy, albedo, sunlit, sky)
    if outcrop > 0.05 and foot < 0.04:
        wx, wy = 0.13 * noise(x * 7, y * 7, scene.key + 40)[0], 0.13 * noise(x * 7, y * 7, scene.key + 41)[0]
        joint, shade = _crack((x + wx) * 6.5, (y + wy) * 4.5, scene.key + 42)
        width = 0.04 + 4 * foot
        depth = (0.03 / width) * max(0.0, 1 - joint / width)
        albedo *= 1 + outcrop * (
            0.07 * shade - 0.5 * min(1.0, 1.6 * (1 - outcrop) + 0.25 * (shade + 1)) * depth
        )
    if foot > 0.35 * _PEBBLE_CELL_M:
        return _finish(scene.sun, gx, gy, albedo, sunlit, sky)
    gravel = (0.35 + 4 * max(0.0, 0.30 - albedo)) * (1 - 0.6 * outcrop)  # where it lies, the ground is darker
    shadow = 0.0
    for n in range(5):
        cell = _PEBBLE_CELL_M * 0.55**n
        if foot > 0.35 * cell:
            break
        share = min(0.9, (0.35 + 0.14 * n) * gravel)
        here, sx, sy, dark, shade = _pebbles(scene.sun, x, y, foot, cell, share, scene.key + 60 + 2 * n)
        gx, gy = gx * (1 - 0.7 * here) + here * sx, gy * (1 - 0.7 * here) + here * sy
        albedo *= 1 + (0.25 * shade - 0.25) * here
        shadow = max(shadow * (1 - here), dark)
    return _finish(scene.sun, gx, gy, albedo, sunlit * (1 - 0.85 * shadow), sky * (1 - 0.4 * shadow))


@_inlined
def _finish(sun_at: FloatArray, gx: float, gy: float, albedo: float, sunlit: float, sky: float) -> float:
    norm = 1 / math.sqrt(1 + gx * gx + gy * gy)
    return _reflected(sun_at, -gx * norm, -gy * norm, norm, albedo, sunlit, sky)


@_inlined
def _stone(
    scene: Scene, rock: int, face: int, x: float, y: float, z: float, foot: float, sunlit: float
) -> float:
    """Radiance of a rock's surface."""
    m = scene.rocks
    px, py, pz = x - m[rock, 0], y - m[rock, 1], z - m[rock, 2]
    if face < 0:
        ux, uy, uz = (
            m[rock, 3] * px + m[rock, 4] * py + m[rock, 5] * pz,
            m[rock, 6] * px + m[rock, 7] * py + m[rock, 8] * pz,
            m[rock, 9] * px + m[rock, 10] * py + m[rock, 11] * pz,
        )
    else:
        form = int(m[rock, 13])
        ux, uy, uz = scene.forms[form, face, 0], scene.forms[form, face, 1], scene.forms[form, face, 2]
    nx, ny, nz = (
        m[rock, 3] * ux + m[rock, 6] * uy + m[rock, 9] * uz,
        m[rock, 4] * ux + m[rock, 7] * uy + m[rock, 10] * uz,
        m[rock, 5] * ux + m[rock, 8] * uy + m[rock, 11] * uz,
    )
    norm = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx * norm, ny * norm, nz * norm
    albedo = m[rock, 14]
    length, key = 0.7 * m[rock, 15], int(m[rock, 16])
    while length > 2 * foot and length > 0.001:
        weight = min(1.0, length / foot - 2)
        value, gx, gy, gz = _noise_in_space(px / length, py / length, pz / length, key)
        nx, ny, nz = nx - 0.13 * weight * gx, ny - 0.13 * weight * gy, nz - 0.13 * weight * gz
        albedo *= 1 + 0.12 * weight * value
        length, key = 0.45 * length, key + 1
    norm = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
    nz *= norm
    albedo *= 1 + 0.25 * max(0.0, nz)  # dust settles on top
    low = min(
        1.0, max(0.0, (pz + 0.2 * (m[rock, 12] - m[rock, 2])) / (m[rock, 12] - m[rock, 2]) + 0.35)
    )  # little sky near the ground
    return _reflected(scene.sun, nx * norm, ny * norm, nz, albedo, sunlit, low)


@_inlined
def _sky(scene: Scene, dx: float, dy: float, dz: float) -> float:
    """Radiance of the dusty sky: brighter towards the horizon and around the sun."""
    up = max(0.0, dz)
    near: float = max(0.0, dx * scene.sun[0] + dy * scene.sun[1] + dz * scene.sun[2])
    return 0.150 + 0.035 * math.exp(-5 * up) + 0.05 * near**6


# --- the deck ---


@_inlined
def _hit_deck(
    deck: Deck, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, end: float
) -> tuple[float, int, float, float, float]:
    """The first plate before `end`: distance, plate (-1: none), x and y on it, distance to its rim."""
    best, plate, hit_x, hit_y, hit_rim = end, -1, 0.0, 0.0, 0.0
    r, c = deck.rotation, deck.centre_m
    px, py, pz = ox - c[0], oy - c[1], oz - c[2]
    ax = r[0, 0] * px + r[1, 0] * py + r[2, 0] * pz
    ay = r[0, 1] * px + r[1, 1] * py + r[2, 1] * pz
    az = r[0, 2] * px + r[1, 2] * py + r[2, 2] * pz
    bx = r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz
    by = r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz
    bz = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz
    for n in range(deck.plates_m.shape[0]):
        if abs(bz) < 1e-9:
            continue
        t = (deck.plates_m[n, 0, 2] - az) / bz
        if t <= 1e-4 or t >= best:
            continue
        x, y, rim = ax + t * bx, ay + t * by, 1e9
        corners = deck.plates_m.shape[1]
        for k in range(corners):
            qx, qy = deck.plates_m[n, k, 0], deck.plates_m[n, k, 1]
            ex, ey = deck.plates_m[n, (k + 1) % corners, 0] - qx, deck.plates_m[n, (k + 1) % corners, 1] - qy
            rim = min(rim, (ex * (y - qy) - ey * (x - qx)) / math.hypot(ex, ey))
        if rim > 0:
            best, plate, hit_x, hit_y, hit_rim = t, n, x, y, rim
    return best, plate, hit_x, hit_y, hit_rim


@compiled
def _panel(plate: int, x: float, y: float, rim: float, foot: float) -> float:
    """Albedo of a plate: dusty solar cells between bright connectors, within a plain rim."""
    if rim < 0.03:
        return 0.30
    a, b = x / 0.105, y / 0.062
    i, j = math.floor(a), math.floor(b)
    gap = min(min(a - i, 1 - (a - i)) * 0.105, min(b - j, 1 - (b - j)) * 0.062)
    cell = 0.185 + 0.02 * ((_hash(int(i), int(j), plate) & 0xFF) / 255.0 - 0.5)
    line = min(1.0, max(0.0, (0.0025 - gap) / max(foot, 0.001) + 0.5))
    dust = 0.012 * noise(x * 14, y * 14, 5 + plate)[0] + 0.02 * noise(x * 3, y * 3, 9 + plate)[0]
    return cell + dust + 0.16 * line * ((_hash(int(i) + 7, int(j), plate) >> 8 & 3) > 0)


# --- pixels ---


@compiled
def _trace(
    scene: Scene, deck: Deck, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, pixel: float
) -> tuple[float, float, int]:
    """Radiance and distance of a ray, and a number that changes where the picture has an edge."""
    t, begin = _march(scene, ox, oy, oz, dx, dy, dz)
    t, rock, face = _hit_rocks(scene, ox, oy, oz, dx, dy, dz, begin, t, False)
    t, plate, plate_x, plate_y, rim = _hit_deck(deck, ox, oy, oz, dx, dy, dz, t)
    if t == math.inf:
        return _sky(scene, dx, dy, dz), t, -1
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    sx, sy, sz = scene.sun
    # From a little above the surface, or it would shade itself.
    lift = 1e-4 + 1e-5 * t
    shaded = _hit_rocks(scene, x, y, z + lift, sx, sy, sz, 0.0, 60.0, True)[1] >= 0
    if not shaded and t < 8:
        shaded = _hit_deck(deck, x, y, z + lift, sx, sy, sz, 8.0)[1] >= 0
    sunlit = 0.0 if shaded else 1.0
    across = pixel * t
    if plate >= 0:
        albedo = _panel(plate, plate_x, plate_y, rim, across / max(0.15, abs(dz)))
        light = _reflected(
            scene.sun, deck.rotation[0, 2], deck.rotation[1, 2], deck.rotation[2, 2], albedo, sunlit, 1.0
        )
        key = 2 + plate + 16 * (rim < 0.03)
    elif rock >= 0:
        light = _stone(scene, rock, face, x, y, z, 1.3 * across, sunlit)
        key = (rock + 1) * _FACES * 2 + (face + 1) * 2
    else:
        level = _level(scene.shape, scene.frame_m, x, y)
        gx, gy, _, _ = _sample(scene, level, 0, x, y)
        facing = (gx * dx + gy * dy - dz) / math.sqrt(1 + gx * gx + gy * gy)
        along = across / max(facing, 0.02)
        taps = min(max(int(along / (2 * across) + 0.5), 1), _MAX_TAPS)
        foot = max(across, along / taps)
        sky = _openness(scene, x, y)
        norm = math.hypot(dx, dy) + 1e-12
        light = 0.0
        for n in range(taps):
            shift = ((n + 0.5) / taps - 0.5) * along / norm
            light += _soil(scene, level, x + shift * dx, y + shift * dy, foot, sunlit, sky)
        light /= taps
        key = 0
    haze = math.exp(-t / scene.haze_m)
    return light * haze + (1 - haze) * _sky(scene, dx, dy, 0.0), t, key + (1 if shaded else 0)


@compiled
def render(
    scene: Scene,
    deck: Deck,
    rotation: FloatArray,
    centre_m: FloatArray,
    origin_m: FloatArray,
    direction: FloatArray,
    valid: NDArray[np.bool_],
    light: FloatArray,
    distance_m: FloatArray,
    edge: IntArray,
) -> None:
    """Trace the middle of each pixel: rows of rays (h, w, 3) in the camera frame into (h, w) arrays.

    `origin_m` has one row, or as many as there are rays.
    """
    rows, columns = light.shape
    ray, start = np.empty(3), np.empty(3)
    for v in range(rows):
        for u in range(columns):
            if not valid[v, u]:
                light[v, u], distance_m[v, u], edge[v, u] = 0.0, math.inf, -2
                continue
            w = u + 1 if u + 1 < columns else u - 1
            d = direction[v, u]
            e = direction[v, w]
            pixel = math.sqrt((d[0] - e[0]) ** 2 + (d[1] - e[1]) ** 2 + (d[2] - e[2]) ** 2)
            o = origin_m[(v * columns + u) % len(origin_m)]
            for k in range(3):
                ray[k] = rotation[k, 0] * d[0] + rotation[k, 1] * d[1] + rotation[k, 2] * d[2]
                start[k] = centre_m[k] + rotation[k, 0] * o[0] + rotation[k, 1] * o[1] + rotation[k, 2] * o[2]
            light[v, u], distance_m[v, u], edge[v, u] = _trace(
                scene, deck, start[0], start[1], start[2], ray[0], ray[1], ray[2], pixel
            )


@compiled
def smooth(
    scene: Scene,
    deck: Deck,
    rotation: FloatArray,
    centre_m: FloatArray,
    origin_m: FloatArray,
    direction: FloatArray,
    light: FloatArray,
    distance_m: FloatArray,
    edge: IntArray,
    side: int,
) -> None:
    """Trace pixels on edges anew, side x side rays each, and average; the outermost pixels stay."""
    rows, columns = light.shape
    ray, start, d = np.empty(3), np.empty(3), np.empty(3)
    for v in range(1, rows - 1):
        for u in range(1, columns - 1):
            here, away = edge[v, u], distance_m[v, u]
            if here == -2:
                continue
            rough = False
            for a, b in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                there, far = edge[v + a, u + b], distance_m[v + a, u + b]
                if there == -2:
                    rough = False
                    break
                rough = rough or there != here or (here >= 0 and abs(far - away) > 0.04 * away + 0.02 * far)
            if not rough:
                continue
            total = 0.0
            o = origin_m[(v * columns + u) % len(origin_m)]
            pixel = 0.0
            for k in range(3):
                start[k] = centre_m[k] + rotation[k, 0] * o[0] + rotation[k, 1] * o[1] + rotation[k, 2] * o[2]
                pixel += (direction[v, u + 1, k] - direction[v, u, k]) ** 2
            pixel = math.sqrt(pixel) / side
            for a in range(side):
                for b in range(side):
                    p, q = (a + 0.5) / side - 0.5, (b + 0.5) / side - 0.5
                    norm = 0.0
                    for k in range(3):
                        d[k] = (
                            direction[v, u, k]
                            + 0.5 * p * (direction[v + 1, u, k] - direction[v - 1, u, k])
                            + 0.5 * q * (direction[v, u + 1, k] - direction[v, u - 1, k])
                        )
                        norm += d[k] * d[k]
                    norm = 1 / math.sqrt(norm)
                    for k in range(3):
                        ray[k] = norm * (
                            rotation[k, 0] * d[0] + rotation[k, 1] * d[1] + rotation[k, 2] * d[2]
                        )
                    total += _trace(scene, deck, start[0], start[1], start[2], ray[0], ray[1], ray[2], pixel)[
                        0
                    ]
            light[v, u] = total / (side * side)


@compiled
def hits(
    scene: Scene, deck: Deck, origin_m: FloatArray, direction: FloatArray, distance_m: FloatArray
) -> None:
    """Distance along rays (n, 3) in the world to what they meet first; infinite in the sky."""
    for i in range(len(direction)):
        ox, oy, oz = origin_m[i]
        dx, dy, dz = direction[i]
        t, begin = _march(scene, ox, oy, oz, dx, dy, dz)
        t = _hit_rocks(scene, ox, oy, oz, dx, dy, dz, begin, t, False)[0]
        distance_m[i] = _hit_deck(deck, ox, oy, oz, dx, dy, dz, t)[0]
