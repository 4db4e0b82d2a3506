"""Pebbles and granules, which are too many to store: each is computed from the number of its cell.

A cell of one of a few nested grids holds at most one stone.

All sizes take the same share of the ground, so that the number larger than D goes as D^-2, which is what
small fragments on Mars follow within a factor of two. They are forms like rocks, partly buried.
"""

import math

from pancam_graph.base.compiled import uncounted
from pancam_graph.simulate._rays._ground import height_at, level_at
from pancam_graph.simulate._rays._noise import hashed, noise
from pancam_graph.simulate._rays._rocks import through_form
from pancam_graph.simulate._rays._world import Grids, Scene

__all__ = ["TALLEST_M", "hit_stones", "stone_shade"]

_CELL_M = 0.12  # of the coarsest grid, whose stones reach 4 cm; larger ones are rocks
_CLASSES = 6
_RADIUS = 0.16  # of the largest stone of a grid, over the width of a cell
_TALL = 0.15  # height of the tallest stone over the ground, over the width of a cell
_SMALLEST = 1.0  # a grid is left out if its largest radius, over the pixel's width, is below this
_ROUND = 2.0  # a stone whose half axis, over the pixel's width, is below this is taken for an ellipsoid
_SHARE = 0.45  # of cells with a stone, on average
TALLEST_M = _TALL * _CELL_M
_BYTE = 1 / 255.0


@uncounted.part
def _place(i: int, j: int, cell: float, key: int) -> tuple[float, float, float, float]:
    """Centre and radius (0: no stone) of the stone that a cell may hold, and a random number in [0, 1].

    The stone is there if the number is below the share of cells with a stone around there; see `_stone`.
    """
    h = hashed(i, j, key)
    chance = (h & 0xFF) * _BYTE
    radius = _RADIUS * cell / math.sqrt(1 + 3 * (h >> 8 & 0xFF) * _BYTE)
    return (
        (i + 0.28 + 0.44 * (h >> 16 & 0xFF) * _BYTE) * cell,
        (j + 0.28 + 0.44 * (h >> 24) * _BYTE) * cell,
        radius if chance < 1.9 * _SHARE else 0.0,
        chance,
    )


@uncounted.part
def _stone(
    lattice: Grids, i: int, j: int, x: float, y: float, chance: float, radius: float, key: int
) -> tuple[float, float, float, float, float, float, int]:
    """The stone of a cell.

    Returns half axes along (0: no stone), across and up, cosine and sine of its heading, the height of its
    centre over the ground, and its number.
    """
    if chance > _SHARE * (1 + 2.2 * noise(lattice, 0.8 * x, 0.8 * y, 0)[0]):  # stones gather here and there
        return 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0
    g = hashed(i, j, key + 1)
    along, across = radius * (1 + 0.5 * (g & 0xFF) * _BYTE), radius * (0.7 + 0.3 * (g >> 8 & 0xFF) * _BYTE)
    up = radius * (0.45 + 0.4 * (g >> 16 & 15) / 15.0)
    angle = 0.0245 * (g >> 24)
    depth = up * (0.55 * (g >> 20 & 15) / 15.0 - 0.4)
    return along, across, up, math.cos(angle), math.sin(angle), depth, g


@uncounted.inlined
def hit_stones(
    scene: Scene,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    far: float,
    over: float,
    slope_x: float,
    slope_y: float,
    pixel_m: float,
) -> tuple[float, float, float, float, float, float, int]:
    """The first stone that a ray meets before `far`, where it is `over` metres above sloping ground.

    Returns its distance, the share of the pixel that it fills (0: no stone), its unit normal, its largest
    radius, and its number.
    """
    dx = dx if abs(dx) > 1e-12 else 1e-12
    dy = dy if abs(dy) > 1e-12 else 1e-12
    across = math.sqrt(dx * dx + dy * dy)
    closing = max(slope_x * dx + slope_y * dy - dz, 0.02)
    best, cover, nx, ny, nz, size, number = far, 0.0, 0.0, 0.0, 1.0, 0.0, 0
    cell = 2 * _CELL_M
    for n in range(_CLASSES):
        cell *= 0.5
        if _RADIUS * cell < _SMALLEST * pixel_m:
            break
        reach = min((_TALL * cell - over) / closing, 12 * cell / across)
        if reach <= 0:
            break
        x, y = ox + (far - reach) * dx, oy + (far - reach) * dy
        i, j = math.floor(x / cell), math.floor(y / cell)
        next_i, next_j = ((i + (dx > 0)) * cell - x) / dx, ((j + (dy > 0)) * cell - y) / dy
        key, passed = scene.key + 60 + 2 * n, 0.0
        while passed < reach:
            cx, cy, radius, chance = _place(i, j, cell, key)
            along = 0.0
            if abs((cx - ox) * dy - (cy - oy) * dx) < 1.5 * radius * across:
                along, side, up, c, s, depth, which = _stone(scene.lattice, i, j, cx, cy, chance, radius, key)
            if along > 0:
                form = which % len(scene.forms)
                planes = scene.forms.shape[1] if along > _ROUND * pixel_m else 0
                cz = height_at(scene, level_at(scene, cx, cy), cx, cy) + depth
                px, py, pz = ox - cx, oy - cy, oz - cz
                ax, ay, az = (c * px + s * py) / along, (c * py - s * px) / side, pz / up
                bx, by, bz = (c * dx + s * dy) / along, (c * dy - s * dx) / side, dz / up
                enter, leave, face = through_form(scene.forms, form, planes, ax, ay, az, bx, by, bz)
                if enter < best:
                    # The pixel is filled by the share that the chord is of the pixel's width.
                    chord = (leave - enter) * math.sqrt(bx * bx + by * by + bz * bz)
                    part_of = min(1.0, chord * side / pixel_m)
                    if part_of > 0.5 or (cover <= 0.5 and part_of > cover):
                        best, cover, size, number = enter, part_of, along, which
                        ux, uy, uz = ax + enter * bx, ay + enter * by, az + enter * bz
                        if face >= 0:
                            ux, uy = scene.forms[form, face, 0], scene.forms[form, face, 1]
                            uz = scene.forms[form, face, 2]
                        ux, uy, uz = ux / along, uy / side, uz / up
                        nx, ny, nz = c * ux - s * uy, s * ux + c * uy, uz
            passed = min(next_i, next_j)
            if next_i < next_j:
                i, next_i = i + (1 if dx > 0 else -1), next_i + cell / abs(dx)
            else:
                j, next_j = j + (1 if dy > 0 else -1), next_j + cell / abs(dy)
    norm = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
    return best, cover, nx * norm, ny * norm, nz * norm, size, number


@uncounted.inlined
def stone_shade(scene: Scene, x: float, y: float, z: float, pixel_m: float) -> tuple[float, float]:
    """Shares of the sun's and of the sky's light that stones leave to a place on the ground."""
    sun, sky = 1.0, 1.0
    sx, sy, sz = scene.sun
    across = math.hypot(sx, sy) + 1e-9
    dx, dy = sx / across, sy / across
    dx = dx if abs(dx) > 1e-9 else 1e-9
    dy = dy if abs(dy) > 1e-9 else 1e-9
    rise = sz / across
    cell = 2 * _CELL_M
    for n in range(_CLASSES):
        cell *= 0.5
        if _RADIUS * cell < _SMALLEST * pixel_m:
            break
        reach = min(_TALL * cell / rise, 3 * cell)
        i, j = math.floor(x / cell), math.floor(y / cell)
        next_i, next_j = ((i + (dx > 0)) * cell - x) / dx, ((j + (dy > 0)) * cell - y) / dy
        key, passed = scene.key + 60 + 2 * n, 0.0
        while passed < reach:
            cx, cy, radius, chance = _place(i, j, cell, key)
            px, py, along = x - cx, y - cy, 0.0
            if abs(px * dy - py * dx) < 1.5 * radius or px * px + py * py < 6 * radius * radius:
                along, side, up, c, s, depth, which = _stone(scene.lattice, i, j, cx, cy, chance, radius, key)
            if along > 0:
                u, v = (c * px + s * py) / along, (c * py - s * px) / side
                away = u * u + v * v
                if away < 2.6:
                    sky *= 1 - 0.45 * min(1.0, 1.6 - math.sqrt(away) * 0.99)
                if abs(px * dy - py * dx) < along:
                    w = (z - height_at(scene, level_at(scene, cx, cy), cx, cy) - depth) / up
                    bx, by, bz = (c * dx + s * dy) / along, (c * dy - s * dx) / side, rise / up
                    # The form casts the shadow: that of its ball would lie as a dark ring around it.
                    planes = scene.forms.shape[1] if along > _ROUND * pixel_m else 0
                    enter, leave, _ = through_form(
                        scene.forms, which % len(scene.forms), planes, u, v, w, bx, by, bz
                    )
                    if enter < leave and leave > 0:
                        chord = (leave - max(enter, 0.0)) * math.sqrt(bx * bx + by * by + bz * bz)
                        sun = min(sun, 1 - min(1.0, chord * side / (1.5 * pixel_m)))
            passed = min(next_i, next_j)
            if next_i < next_j:
                i, next_i = i + (1 if dx > 0 else -1), next_i + cell / abs(dx)
            else:
                j, next_j = j + (1 if dy > 0 else -1), next_j + cell / abs(dy)
    return sun, sky
