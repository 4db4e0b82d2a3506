"""Radiance of ground, stones, rocks and sky over the footprint of a pixel."""

import math

from pancam_graph.base.compiled import uncounted
from pancam_graph.simulate._rays._ground import sample
from pancam_graph.simulate._rays._noise import hashed, noise, noise_in_space
from pancam_graph.simulate._rays._rocks import normal_of_ball, to_ball
from pancam_graph.simulate._rays._world import (
    ROCK_ALBEDO,
    ROCK_FORM,
    ROCK_KEY,
    ROCK_RADIUS,
    ROCK_TOP,
    ROCK_X,
    ROCK_Y,
    ROCK_Z,
    STEP,
    Scene,
)

__all__ = ["of_ground", "of_rock", "of_sky", "of_stone", "reflected", "sunlit"]

_SKYLIGHT = 0.28  # light of the sky on level ground, over that of the sun on ground that faces it
_MAX_TAPS = 4
_FINEST_M = 0.0008
_AVERAGED = 4.0  # detail is left out with so many waves along a footprint


@uncounted.inlined
def reflected(
    scene: Scene, nx: float, ny: float, nz: float, albedo: float, sunlit: float, sky: float
) -> float:
    """Radiance of a rough surface of unit normal under sun and sky."""
    sun: float = max(0.0, nx * scene.sun[0] + ny * scene.sun[1] + nz * scene.sun[2])
    return albedo * (sunlit * sun + sky * _SKYLIGHT * (0.6 + 0.4 * nz))


@uncounted.inlined
def sunlit(shade_m: float, z: float, foot: float) -> float:
    """Share of the sun that is seen from height z, where other ground hides it up to the height `shade_m`."""
    return min(1.0, max(0.0, 0.5 - (shade_m - z) / (0.004 + 0.5 * foot)))


@uncounted.part
def _crack(x: float, y: float, key: int) -> tuple[float, float]:
    """Distance to the nearest joint of a pavement of unit slabs, and the slab's own shade in [-1, 1]."""
    i, j = math.floor(x), math.floor(y)
    first = second = 9.0
    shade = 0.0
    for a in range(-1, 2):
        for b in range(-1, 2):
            h = hashed(int(i) + a, int(j) + b, key)
            dx, dy = i + a + (h & 0xFF) / 255.0 - x, j + b + (h >> 8 & 0xFF) / 255.0 - y
            d = dx * dx + dy * dy
            if d < first:
                first, second, shade = d, first, (h >> 16 & 0xFF) / 127.5 - 1
            elif d < second:
                second = d
    return 0.5 * (math.sqrt(second) - math.sqrt(first)), shade


@uncounted.inlined
def of_ground(
    scene: Scene,
    level: int,
    x: float,
    y: float,
    z: float,
    ux: float,
    uy: float,
    across: float,
    along: float,
    sun: float,
    sky: float,
    here: tuple[float, float, float, float, float],
) -> float:
    """Radiance of the ground over a footprint `across` wide and `along` long in the direction (ux, uy).

    `here` is a sample of the middle. Detail is averaged along the footprint, not over a circle as long as it:
    that would smear far ground, which is seen at a low angle, sideways.
    """
    step = scene.frame_m[level, 0, STEP]
    taps = min(max(int(0.5 * along / max(across, step) + 0.5), 1), _MAX_TAPS)
    foot = max(across, along / taps)
    gx, gy, albedo, outcrop, lit = here
    if taps > 1 or foot > step:
        gx = gy = albedo = outcrop = lit = 0.0
        for n in range(taps):
            shift = ((n + 0.5) / taps - 0.5) * along
            a, b, c, d, e = sample(scene, level, x + shift * ux, y + shift * uy, foot)
            gx, gy, albedo, outcrop, lit = gx + a, gy + b, albedo + c, outcrop + d, lit + e
        gx, gy, albedo, outcrop, lit = gx / taps, gy / taps, albedo / taps, outcrop / taps, lit / taps
    lit = sunlit(lit, z, along)
    rough = 1 - 0.6 * outcrop if level == 0 else 0.8
    length, px, py, vx, vy, k = 2.4 * step, x, y, ux, uy, scene.key
    c, s = 1.0, 0.0
    while length > 2 * across and length > _FINEST_M and length * _AVERAGED > along:
        weight = min(1.0, length / across - 2) * min(1.0, 2 - along / (0.5 * _AVERAGED * length)) * rough
        times = int(1.2 * along / length) + 1
        value = nx = ny = 0.0
        for n in range(times):
            shift = ((n + 0.5) / times - 0.5) * along
            a, b, d = noise(scene.lattice, (px + shift * vx) / length, (py + shift * vy) / length, k)
            value, nx, ny = value + a, nx + b, ny + d
        weight /= times
        gx += 0.11 * weight * (c * nx + s * ny)
        gy += 0.11 * weight * (c * ny - s * nx)
        albedo *= 1 + 0.16 * weight * value
        px, py = 0.8 * px - 0.6 * py, 0.6 * px + 0.8 * py
        vx, vy = 0.8 * vx - 0.6 * vy, 0.6 * vx + 0.8 * vy
        c, s = 0.8 * c - 0.6 * s, 0.6 * c + 0.8 * s
        length, k = 0.5 * length, k + 1
    if level == 0 and outcrop > 0.05 and along < 0.04:
        wx = 0.13 * noise(scene.lattice, x * 7, y * 7, scene.key + 40)[0]
        wy = 0.13 * noise(scene.lattice, x * 7, y * 7, scene.key + 41)[0]
        joint, shade = _crack((x + wx) * 6.5, (y + wy) * 4.5, scene.key + 42)
        width = 0.04 + 4 * along
        depth = (0.03 / width) * max(0.0, 1 - joint / width)
        albedo *= 1 + outcrop * (
            0.07 * shade - 0.5 * min(1.0, 1.6 * (1 - outcrop) + 0.25 * (shade + 1)) * depth
        )
    norm = 1 / math.sqrt(1 + gx * gx + gy * gy)
    return reflected(scene, -gx * norm, -gy * norm, norm, albedo, min(sun, lit), sky)


@uncounted.inlined
def of_stone(
    scene: Scene,
    number: int,
    size: float,
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
    pixel_m: float,
    sun: float,
    sky: float,
) -> float:
    """Radiance of a pebble at a point of its surface with the normal n; `number` is the pebble's."""
    albedo = 0.11 + 0.11 * (number & 0xFF) / 255.0
    length, key = 0.8 * size, number >> 8
    while length > 2 * pixel_m and length > _FINEST_M:
        weight = min(1.0, length / pixel_m - 2)
        value, gx, gy, gz = noise_in_space(x / length, y / length, z / length, key)
        nx, ny, nz = nx - 0.12 * weight * gx, ny - 0.12 * weight * gy, nz - 0.12 * weight * gz
        albedo *= 1 + 0.12 * weight * value
        length, key = 0.4 * length, key + 1
    norm = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
    up = nz * norm
    albedo *= 1 + 0.25 * max(0.0, up)  # dust settles on top
    return reflected(scene, nx * norm, ny * norm, up, albedo, sun, sky * (0.75 + 0.25 * up))


@uncounted.inlined
def of_rock(
    scene: Scene,
    rock: int,
    face: int,
    x: float,
    y: float,
    z: float,
    pixel_m: float,
    sun: float,
    sky: float,
) -> float:
    """Radiance of a rock at a point of its surface; `face` is the plane of its form there (-1: the ball)."""
    rocks = scene.rocks
    px, py, pz = x - rocks[rock, ROCK_X], y - rocks[rock, ROCK_Y], z - rocks[rock, ROCK_Z]
    if face < 0:
        ux, uy, uz = to_ball(rocks, rock, px, py, pz)
    else:
        form = int(rocks[rock, ROCK_FORM])
        ux, uy, uz = scene.forms[form, face, 0], scene.forms[form, face, 1], scene.forms[form, face, 2]
    nx, ny, nz = normal_of_ball(rocks, rock, ux, uy, uz)
    norm = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx * norm, ny * norm, nz * norm
    albedo = rocks[rock, ROCK_ALBEDO]
    length, key = 0.7 * rocks[rock, ROCK_RADIUS], int(rocks[rock, ROCK_KEY])
    while length > 2 * pixel_m and length > _FINEST_M:
        weight = min(1.0, length / pixel_m - 2)
        value, gx, gy, gz = noise_in_space(px / length, py / length, pz / length, key)
        nx, ny, nz = nx - 0.13 * weight * gx, ny - 0.13 * weight * gy, nz - 0.13 * weight * gz
        albedo *= 1 + 0.12 * weight * value
        length, key = 0.45 * length, key + 1
    norm = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
    nz *= norm
    albedo *= 1 + 0.25 * max(0.0, nz)  # dust settles on top
    rise = rocks[rock, ROCK_TOP] - rocks[rock, ROCK_Z]
    high = (pz + 0.2 * rise) / rise + 0.35
    return reflected(
        scene,
        nx * norm,
        ny * norm,
        nz,
        albedo,
        sun,
        sky * min(1.0, max(0.2, high)),  # less sky near the ground
    )


@uncounted.inlined
def of_sky(scene: Scene, dx: float, dy: float, dz: float) -> float:
    """Radiance of the dusty sky: brighter towards the horizon and around the sun."""
    up = max(0.0, dz)
    near: float = max(0.0, dx * scene.sun[0] + dy * scene.sun[1] + dz * scene.sun[2])
    return 0.150 + 0.035 * math.exp(-5 * up) + 0.05 * near**6
