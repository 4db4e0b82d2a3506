"""The rover's deck: flat plates that the masts carry along."""

import math

from pancam_graph.base.compiled import uncounted
from pancam_graph.simulate._rays._noise import hashed, noise
from pancam_graph.simulate._rays._world import Deck, Grids

__all__ = ["RIM_M", "hit_deck", "panel"]

RIM_M = 0.03


@uncounted.inlined
def hit_deck(
    deck: Deck, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, end: float
) -> tuple[float, int, float, float, float]:
    """The first plate that a ray meets nearer than `end`.

    Returns its distance, the plate (-1: none), x and y on the plate, and the distance to the plate's rim.
    """
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


@uncounted.part
def panel(lattice: Grids, plate: int, x: float, y: float, rim: float, foot: float) -> float:
    """Albedo of a plate: dusty solar cells between bright connectors, within a plain rim."""
    if rim < RIM_M:
        return 0.30
    a, b = x / 0.105, y / 0.062
    i, j = math.floor(a), math.floor(b)
    gap = min(min(a - i, 1 - (a - i)) * 0.105, min(b - j, 1 - (b - j)) * 0.062)
    cell = 0.185 + 0.02 * ((hashed(int(i), int(j), plate) & 0xFF) / 255.0 - 0.5)
    line = min(1.0, max(0.0, (0.0025 - gap) / max(foot, 0.001) + 0.5))
    dust = (
        0.012 * noise(lattice, x * 14, y * 14, 5 + plate)[0]
        + 0.02 * noise(lattice, x * 3, y * 3, 9 + plate)[0]
    )
    return cell + dust + 0.16 * line * ((hashed(int(i) + 7, int(j), plate) >> 8 & 3) > 0)
