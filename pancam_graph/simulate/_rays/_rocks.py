"""Rocks: ellipsoids cut by planes, listed by the cells of a grid."""

import math

from pancam_graph.base.compiled import uncounted
from pancam_graph.base.geometry import FloatArray
from pancam_graph.simulate._rays._world import (
    ROCK_FORM,
    ROCK_RADIUS,
    ROCK_TO_BALL,
    ROCK_TOP,
    ROCK_X,
    ROCK_Y,
    ROCK_Z,
    STEP,
    Scene,
    X,
    Y,
)

__all__ = ["BLOCK", "DIM_FOOT", "hit_rocks", "normal_of_ball", "rock_shade", "through_form", "to_ball"]

BLOCK = 8
"""Cells along each side of a block, which a ray above all its rocks passes in one step."""
DIM_FOOT = 1.6
"""Distance from a rock's centre, in its radii, up to which it hides some of the sky."""


@uncounted.part
def through_form(
    forms: FloatArray,
    form: int,
    planes: int,
    ax: float,
    ay: float,
    az: float,
    bx: float,
    by: float,
    bz: float,
) -> tuple[float, float, int]:
    """Where a ray a + t b enters and leaves the unit ball cut by the first `planes` planes of a form.

    Returns t at both, and the plane through which it enters (-1: the ball). A ray that misses enters at
    infinity.
    """
    bb, ab, aa = bx * bx + by * by + bz * bz, ax * bx + ay * by + az * bz, ax * ax + ay * ay + az * az
    inside = ab * ab - bb * (aa - 1)
    if inside <= 0:
        return math.inf, 0.0, -1
    root = math.sqrt(inside)
    enter, leave, face = (-ab - root) / bb, (-ab + root) / bb, -1
    for k in range(planes):
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
            return math.inf, 0.0, -1
    return (enter if enter < leave else math.inf), leave, face


@uncounted.inlined
def to_ball(rocks: FloatArray, n: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A vector from the centre of rock n, or a direction, taken to the frame of the unit ball."""
    k = ROCK_TO_BALL
    return (
        rocks[n, k] * x + rocks[n, k + 1] * y + rocks[n, k + 2] * z,
        rocks[n, k + 3] * x + rocks[n, k + 4] * y + rocks[n, k + 5] * z,
        rocks[n, k + 6] * x + rocks[n, k + 7] * y + rocks[n, k + 8] * z,
    )


@uncounted.inlined
def normal_of_ball(rocks: FloatArray, n: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A normal in the frame of the unit ball of rock n, taken to the world; its length means nothing."""
    k = ROCK_TO_BALL
    return (
        rocks[n, k] * x + rocks[n, k + 3] * y + rocks[n, k + 6] * z,
        rocks[n, k + 1] * x + rocks[n, k + 4] * y + rocks[n, k + 7] * z,
        rocks[n, k + 2] * x + rocks[n, k + 5] * y + rocks[n, k + 8] * z,
    )


@uncounted.part
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
    px, py, pz = ox - rocks[n, ROCK_X], oy - rocks[n, ROCK_Y], oz - rocks[n, ROCK_Z]
    ax, ay, az = to_ball(rocks, n, px, py, pz)
    bx, by, bz = to_ball(rocks, n, dx, dy, dz)
    enter, _, face = through_form(forms, int(rocks[n, ROCK_FORM]), forms.shape[1], ax, ay, az, bx, by, bz)
    return (enter if enter > 1e-6 else math.inf), face


@uncounted.inlined
def hit_rocks(
    scene: Scene, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, far: float
) -> tuple[float, int, int]:
    """The first rock that a ray meets nearer than `far`, found cell by cell along the ray.

    Returns its distance (`far` if there is none), the rock (-1: none), and the plane of its form (-1: the
    ball).
    """
    rocks, forms, cells = scene.rocks, scene.forms, scene.cells
    cell_rocks, top = scene.cell_rocks, scene.cell_top_m
    best, rock, face = far, -1, -1
    wide, deep = scene.cell_shape
    wide_b, first_b = (wide + BLOCK - 1) // BLOCK, wide * deep
    x0, y0, cell = scene.cell_frame_m[X], scene.cell_frame_m[Y], scene.cell_frame_m[STEP]
    dx = dx if abs(dx) > 1e-12 else 1e-12
    dy = dy if abs(dy) > 1e-12 else 1e-12
    per_x, per_y = 1 / dx, 1 / dy
    begin, end = 0.0, far
    if dz < 0:
        begin = max(begin, (scene.rock_top_m - oz) / dz)
    elif dz > 0:
        end = min(end, (scene.rock_top_m - oz) / dz)
    a, b = (x0 - ox) * per_x, (x0 + wide * cell - ox) * per_x
    begin, end = max(begin, min(a, b)), min(end, max(a, b))
    a, b = (y0 - oy) * per_y, (y0 + deep * cell - oy) * per_y
    begin, end = max(begin, min(a, b)), min(end, max(a, b))
    to_i, to_j = (1 if dx > 0 else 0), (1 if dy > 0 else 0)
    t, block = begin, True
    while t < end:
        size = BLOCK * cell if block else cell
        beyond = t + 1e-9 * (1 + t)
        i = min(max(int((ox + beyond * dx - x0) / size), 0), (wide_b if block else wide) - 1)
        j = min(
            max(int((oy + beyond * dy - y0) / size), 0),
            (deep + BLOCK - 1) // BLOCK - 1 if block else deep - 1,
        )
        end_i, end_j = (x0 + (i + to_i) * size - ox) * per_x, (y0 + (j + to_j) * size - oy) * per_y
        leave = max(min(end_i, end_j), beyond)
        at = first_b + j * wide_b + i if block else j * wide + i
        low = min(oz + t * dz, oz + min(leave, end) * dz)
        if low >= top[at]:
            t = leave
            if not block:
                block = i % BLOCK == (BLOCK - 1) * to_i if end_i < end_j else j % BLOCK == (BLOCK - 1) * to_j
            continue
        if block:
            block = False
            continue
        for n in range(cells[at], cells[at + 1]):
            enter, plane = _cut(rocks, forms, cell_rocks[n], ox, oy, oz, dx, dy, dz)
            if enter < best:
                best, rock, face = enter, cell_rocks[n], plane
        if best <= leave:
            break
        t = leave
        block = i % BLOCK == (BLOCK - 1) * to_i if end_i < end_j else j % BLOCK == (BLOCK - 1) * to_j
    return best, rock, face


@uncounted.inlined
def rock_shade(scene: Scene, x: float, y: float, z: float, but: int) -> tuple[bool, float]:
    """Whether a rock hides the sun from a point, and the share of the sky's light that rocks leave to it.

    The rock `but` is left out.
    """
    wide, deep = scene.cell_shape
    i = math.floor((x - scene.cell_frame_m[X]) / scene.cell_frame_m[STEP])
    j = math.floor((y - scene.cell_frame_m[Y]) / scene.cell_frame_m[STEP])
    dark, sky = False, 1.0
    if i >= 0 and j >= 0 and i < wide and j < deep:
        sx, sy, sz = scene.sun
        for n in range(scene.shaded[j * wide + i], scene.shaded[j * wide + i + 1]):
            rock = scene.shaded_rocks[n]
            if rock == but:
                continue
            px, py = x - scene.rocks[rock, ROCK_X], y - scene.rocks[rock, ROCK_Y]
            away = math.sqrt(px * px + py * py) / scene.rocks[rock, ROCK_RADIUS]
            if away < DIM_FOOT:
                sky *= 1 - 0.5 * min(1.0, (DIM_FOOT - away) / 0.9)
            if not dark and z < scene.rocks[rock, ROCK_TOP]:
                dark = _cut(scene.rocks, scene.forms, rock, x, y, z, sx, sy, sz)[0] < math.inf
    return dark, sky
