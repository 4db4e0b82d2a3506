"""What rays meet first, and the radiance of that."""

import math

from pancam_graph.base.compiled import uncounted
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.simulate._rays._deck import RIM_M, hit_deck, panel
from pancam_graph.simulate._rays._ground import NEAREST_M, height_at, level_at, march, march_start, sample
from pancam_graph.simulate._rays._light import of_ground, of_rock, of_sky, of_stone, reflected, sunlit
from pancam_graph.simulate._rays._rocks import hit_rocks, rock_shade
from pancam_graph.simulate._rays._stones import TALLEST_M, hit_stones, stone_shade
from pancam_graph.simulate._rays._world import Deck, Scene

__all__ = ["trace"]

_FACES = 64  # more than the planes of a form
_DECK_REACH_M = 8.0


@uncounted.inlined
def _trace(
    scene: Scene,
    deck: Deck,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    pixel: float,
    start: float,
    lit: bool,
) -> tuple[float, float, int, float]:
    """Follow one ray.

    Returns the radiance (if `lit`) and the distance of what it meets first, a number that changes at edges of
    the picture, and the distance of the ground.
    """
    ground = math.inf
    for _ in range(2):
        ground = march(scene, ox, oy, oz, dx, dy, dz, start)
        if ground > start or start == NEAREST_M:
            break
        start = NEAREST_M  # the start was below ground
    t, rock, face = hit_rocks(scene, ox, oy, oz, dx, dy, dz, ground)
    t, plate, plate_x, plate_y, rim = hit_deck(deck, ox, oy, oz, dx, dy, dz, t)
    light, key = 0.0, -1
    if t < math.inf:
        across = pixel * t
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        level = level_at(scene, x, y)
        sx, sy, sz = scene.sun
        cover, over = 0.0, 0.0
        if plate < 0:
            slope_x, slope_y, albedo, outcrop, shade_m = sample(scene, level, x, y, 0.0)
            over = 0.0 if rock < 0 else z - height_at(scene, level, x, y)
            if over < TALLEST_M:
                near, cover, nx, ny, nz, size, number = hit_stones(
                    scene, ox, oy, oz, dx, dy, dz, t, over, slope_x, slope_y, across
                )
        if lit:
            # From a little above the surface, which otherwise would shade itself.
            lift = 1e-4 + 1e-5 * t
            dark, sky = rock_shade(scene, x, y, z + lift, rock)
            if not dark and t < _DECK_REACH_M:
                dark = hit_deck(deck, x, y, z + lift, sx, sy, sz, _DECK_REACH_M)[1] >= 0
            sun = 0.0 if dark else 1.0
            if plate >= 0:
                painted = panel(scene.lattice, plate, plate_x, plate_y, rim, across / max(0.15, abs(dz)))
                r = deck.rotation
                light = reflected(scene, r[0, 2], r[1, 2], r[2, 2], painted, sun, 1.0)
                key = 2 + plate + 16 * (rim < RIM_M)
            elif rock >= 0:
                sun *= sunlit(shade_m, z, across)
                light = of_rock(scene, rock, face, x, y, z, 1.3 * across, sun, 1.0)
                key = (rock + 1) * _FACES * 2 + (face + 1) * 2
            else:
                key = 0
                if cover < 1:
                    flat = math.sqrt(dx * dx + dy * dy) + 1e-12
                    facing = (slope_x * dx + slope_y * dy - dz) / math.sqrt(
                        1 + slope_x * slope_x + slope_y * slope_y
                    )
                    along = across / max(facing, 0.02)
                    sun_left, sky_left = stone_shade(scene, x, y, z, math.sqrt(across * along))
                    here = (slope_x, slope_y, albedo, outcrop, shade_m)
                    light = of_ground(
                        scene,
                        level,
                        x,
                        y,
                        z,
                        dx / flat,
                        dy / flat,
                        across,
                        along,
                        sun * sun_left,
                        sky * sky_left,
                        here,
                    )
            key += 1 if dark else 0
            if cover > 0:
                px, py, pz = ox + near * dx, oy + near * dy, oz + near * dz
                sun *= sunlit(shade_m, z, across)
                stone = of_stone(scene, number, size, px, py, pz, nx, ny, nz, across, sun, sky)
                light += cover * (stone - light)
        if cover > 0.5:
            t = near
    if lit:
        far = of_sky(scene, dx, dy, min(dz, 0.0) if t < math.inf else dz)
        haze = math.exp(-t / scene.haze_m)
        light = light * haze + (1 - haze) * far
    return light, t, key, ground


@uncounted.entry
def trace(
    scene: Scene,
    deck: Deck,
    origin_m: FloatArray,
    direction: FloatArray,
    pixel_rad: FloatArray,
    below: IntArray,
    below_direction: FloatArray,
    below_m: FloatArray,
    lit: bool,
    light: FloatArray,
    distance_m: FloatArray,
    ground_m: FloatArray,
    edge: IntArray,
) -> None:
    """Follow rays (n, 3) in the world, of pixels `pixel_rad` (n,) wide, from the last to the first.

    `origin_m` has one row, or n. `below` (n,) is the row of another ray from the same place in
    `below_direction` and `below_m`, its direction and its distance to the ground; negative: none. A ray above
    it is followed from there on (see `march_start`). Rays of width 0 are not followed. Written are: radiance
    (if `lit`), the distance of what is met first (infinite in the sky), the distance of the ground, and a
    number that changes where the picture has an edge (-2 for rays of width 0).
    """
    for i in range(len(direction) - 1, -1, -1):
        if not pixel_rad[i] > 0:
            light[i], distance_m[i], ground_m[i], edge[i] = 0.0, math.inf, 0.0, -2
            continue
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        o, n, start = min(i, len(origin_m) - 1), below[i], NEAREST_M
        if n >= 0 and below_m[n] > 0:
            bx, by, bz = below_direction[n, 0], below_direction[n, 1], below_direction[n, 2]
            start = march_start(scene, dx, dy, dz, bx, by, bz, below_m[n])
        light[i], distance_m[i], edge[i], ground_m[i] = _trace(
            scene,
            deck,
            origin_m[o, 0],
            origin_m[o, 1],
            origin_m[o, 2],
            dx,
            dy,
            dz,
            pixel_rad[i],
            start,
            lit,
        )
