"""The world that is rendered, drawn by seed: nested grids of ground, rocks, and the plates of a deck."""

from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np
import scipy

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.simulate import _rays
from pancam_graph.simulate._rays import Deck, Grids, Scene, heights
from pancam_graph.simulate._simulation_options import RenderOptions

__all__ = ["make_deck", "make_scene", "slopes"]

_MIPS = 8
_SQUARINGS = 7
_FINE_STEP_M, _FINE_REACH_M, _FINE_NODES = 0.03, 22.0, 9e6
_MID_STEP_M, _MID_REACH_M, _MID_NODES = 0.25, 150.0, 4e6
_FAR_NODES = 1024
_FAR_REACH = 2.5  # of the outermost ground, over the distance of the ridge
_RIDGE_SIZE = 0.05  # height of the ridge over its distance
_ROCK_REACH_M = 100.0
_ROCK_CELL_M = 0.5
_ROCK_M = (0.03, 1.3)  # diameters
_ROCK_RAD = 0.0012  # rocks that look smaller than this from the nearest stop are left out
_FORMS, _PLANES = 48, 9
_WHEELBASE_M = 0.6  # half of it
_CLEAR_M = 1.1  # no rock stands nearer to a mast: the rover is there

Nodes = tuple[FloatArray, FloatArray]
Level = tuple[FloatArray, FloatArray, FloatArray]


def make_scene(options: RenderOptions, xy_m: FloatArray, rng: np.random.Generator) -> Scene:
    """A world around stops at x and y (n, 2)."""
    noise = _Noise(_rays.make_lattice(rng), int(rng.integers(2**20)))
    low, high = xy_m.min(axis=0), xy_m.max(axis=0)
    reach = _FAR_REACH * options.ridge_m + np.max(high - low)
    middle = 0.5 * (low + high)
    far_frame = (middle - reach, 2 * reach / _FAR_NODES, (_FAR_NODES, _FAR_NODES))
    mid_frame = _frame(low - _MID_REACH_M, high + _MID_REACH_M, _MID_STEP_M, _MID_NODES)
    fine_frame = _frame(low - _FINE_REACH_M, high + _FINE_REACH_M, _FINE_STEP_M, _FINE_NODES)
    far = _far(_nodes(far_frame), middle, options.ridge_m + float(np.max(high - low)) / 2, noise)
    mid = _mid(_nodes(mid_frame), _finer(far, far_frame, mid_frame), noise.after(100))
    fine = _fine(_nodes(fine_frame), _finer(mid, mid_frame, fine_frame), fine_frame[1], noise.after(200))
    frames, levels = (fine_frame, mid_frame, far_frame), (fine, mid, far)
    az, el = options.sun_azimuth_rad, options.sun_elevation_rad
    sun = np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
    grids = [level[0].reshape(frame[2]) for level, frame in zip(levels, frames, strict=True)]
    surface, surface_shape, frame_m = _pyramids(levels, frames, _shades(grids, frames, sun))
    ceiling, ceiling_shape = _ceilings(grids)
    starts = np.cumsum([0, *[g.size for g in grids[:-1]]])
    scene = Scene(
        height_m=np.concatenate([g.ravel() for g in grids]).astype(np.float32),
        ceiling_m=ceiling,
        surface=surface,
        height_shape=np.array([(at, *g.shape[::-1]) for at, g in zip(starts, grids, strict=True)]),
        ceiling_shape=ceiling_shape,
        surface_shape=surface_shape,
        frame_m=frame_m,
        steep=max(_steepest(g, f[1]) for g, f in zip(grids, frames, strict=True)),
        top_m=float(max(g.max() for g in grids)),
        rocks=np.zeros((0, 17)),
        forms=_forms(rng),
        cells=np.zeros(2, dtype=np.int64),
        cell_rocks=np.zeros(0, dtype=np.int64),
        cell_top_m=np.full(2, -np.inf),
        shaded=np.zeros(2, dtype=np.int64),
        shaded_rocks=np.zeros(0, dtype=np.int64),
        cell_frame_m=np.array([*(low - _ROCK_REACH_M), _ROCK_CELL_M]),
        cell_shape=(1, 1),
        rock_top_m=-1e9,
        lattice=noise.lattice,
        sun=sun,
        haze_m=9000.0,
        key=noise.key,
    )
    return _with_rocks(scene, options, xy_m, low - _ROCK_REACH_M, high + _ROCK_REACH_M, rng)


def slopes(scene: Scene, xy_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Height (n,) and slope (n, 2) of the plane on which wheels around x and y (n, 2) stand."""
    offset = _WHEELBASE_M * np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 2), axis=-1).reshape(-1, 2)
    around = heights(scene, (xy_m[:, None] + offset).reshape(-1, 2)).reshape(len(xy_m), -1)
    return around.mean(axis=1), around @ offset / np.sum(offset[:, 0] ** 2)


def make_deck(mast_height_m: float, world_T_mast: gtsam.Pose3, *, seen: bool) -> Deck:
    """Solar panels around and behind a mast, as large as its height asks for: six corners each."""
    # x forward and y left of the mast, for a mast of 1.54 m, after photographs of MER.
    body = [(0.25, -0.35), (0.25, 0.35), (-0.35, 0.55), (-0.95, 0.55), (-0.95, -0.55), (-0.35, -0.55)]
    left = [(0.10, 0.42), (-0.02, 1.05), (-0.22, 1.16), (-0.80, 1.16), (-0.95, 0.95), (-0.92, 0.60)]
    tail = [(-1.00, 0.40), (-1.45, 0.50), (-1.62, 0.30), (-1.62, -0.30), (-1.45, -0.50), (-1.00, -0.40)]
    right = [(x, -y) for x, y in left[::-1]]
    scale = mast_height_m / 1.54
    plates = [
        [(scale * x, scale * y, scale * z) for x, y in corners]
        for corners, z in ((body, -0.88), (left, -0.90), (right, -0.90), (tail, -0.90))
    ]
    rotation = np.ascontiguousarray(world_T_mast.rotation().matrix())
    plates_m = np.array(plates) if seen else np.zeros((0, 6, 3))
    return Deck(rotation=rotation, centre_m=world_T_mast.translation(), plates_m=plates_m)


# --- grids: first node, step, nodes along y and x ---

Frame = tuple[FloatArray, float, tuple[int, int]]


@dataclass(frozen=True)
class _Noise:
    """Fractal noise of one world."""

    lattice: Grids
    key: int

    def __call__(
        self, x: FloatArray, y: FloatArray, longest_m: float, shortest_m: float, gain: float, which: int
    ) -> FloatArray:
        return _rays.noises(self.lattice, x, y, longest_m, shortest_m, gain, self.key + which)

    def after(self, more: int) -> "_Noise":
        return replace(self, key=self.key + more)


def _frame(low: FloatArray, high: FloatArray, step: float, most: float) -> Frame:
    step = max(step, float(np.sqrt(np.prod(high - low) / most)))
    across, deep = (int(n) for n in np.ceil((high - low) / step))
    return low, step, (deep, across)


def _nodes(frame: Frame) -> Nodes:
    first, step, (deep, across) = frame
    y, x = np.mgrid[0:deep, 0:across] * step
    return (x + first[0]).ravel(), (y + first[1]).ravel()


def _at_nodes(grid: FloatArray, frame: Frame, other: Frame, order: Literal[1, 3] = 1) -> FloatArray:
    """A grid interpolated at the nodes of another, which lies within it."""
    ratio = other[1] / frame[1]
    offset = (other[0] - frame[0])[::-1] / frame[1]
    out: FloatArray = scipy.ndimage.affine_transform(
        grid, np.array([ratio, ratio]), offset, output_shape=other[2], order=order
    )
    return out


def _finer(level: Level, frame: Frame, finer: Frame) -> Level:
    """A level at the nodes of a finer one, smoothly interpolated."""
    height, albedo, outcrop = (_at_nodes(a.reshape(frame[2]), frame, finer, 3).ravel() for a in level)
    return height, albedo, outcrop


def _rise(value: FloatArray, low: float, high: float) -> FloatArray:
    t = np.clip((value - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def _far(nodes: Nodes, middle: FloatArray, ridge_m: float, noise: _Noise) -> Level:
    """Plains with a crater's rim around: eroded, higher here and lower there."""
    x, y = nodes
    dx, dy = x - middle[0], y - middle[1]
    away = np.hypot(dx, dy)
    bend = noise(dx, dy, 1.2 * ridge_m, 0.1 * ridge_m, 0.5, 0)
    crest = ridge_m * (1 + 0.35 * bend)
    gullies = noise(x, y, 0.25 * ridge_m, 0.012 * ridge_m, 0.52, 20)
    size = (
        _RIDGE_SIZE
        * ridge_m
        * np.clip(0.75 + 1.5 * noise(dx, dy, 0.8 * ridge_m, 0.2 * ridge_m, 0.5, 10), 0.15, 2)
    )
    ridge = size * np.exp(-(((away - crest) / (0.22 * ridge_m)) ** 2)) * (1 + 0.55 * gullies)
    # Ground drops a little away from the drive, so that the plains are seen and not only their edge.
    plains = 0.02 * ridge_m * 0.25 * noise(x, y, 300.0, 25.0, 0.5, 30) * _rise(away, 20, 300)
    albedo = 0.21 * (1 + 0.5 * noise(x, 1.7 * y, 260.0, 12.0, 0.65, 40))
    albedo *= 1 - 0.25 * _rise(away, 150, 500) * (away < crest) + 0.15 * _rise(away, 0.8 * ridge_m, ridge_m)
    outcrop = _rise(noise(x, y, 60.0, 8.0, 0.5, 60), 0.05, 0.35)
    return ridge + plains, np.clip(albedo, 0.08, 0.45), outcrop


def _mid(nodes: Nodes, far: Level, noise: _Noise) -> Level:
    """Undulations of metres, patches of dust, sand and bare rock."""
    x, y = nodes
    height = far[0] + 1.1 * noise(x, y, 26.0, 1.0, 0.52, 0)
    outcrop = _rise(0.6 * (far[2] - 0.3) + noise(x, y, 11.0, 0.5, 0.62, 20), 0.02, 0.30)
    dust = noise(x, y, 14.0, 0.7, 0.62, 40)
    return height, np.clip(far[1] * (1 + 0.22 * dust + 0.12 * outcrop), 0.10, 0.33), outcrop


def _fine(nodes: Nodes, mid: Level, step: float, noise: _Noise) -> Level:
    """Decimetres: wind ripples where there is sand, steps and joints where there is rock."""
    x, y = nodes
    outcrop = np.clip(mid[2] + 0.9 * noise(x, y, 0.8, 0.1, 0.6, 0) * mid[2], 0, 1)
    sand = (1 - outcrop) * _rise(noise(x, y, 7.0, 1.5, 0.5, 20), 0.08, 0.4)
    warp = 0.35 * noise(x, y, 2.2, 0.5, 0.5, 40)
    phase = 2 * np.pi * (0.83 * x + 0.55 * y + warp) / 0.21
    wave = 0.5 + 0.5 * np.sin(phase + 0.5 * np.sin(phase))
    rough = noise(x, y, 0.7, 0.09, 0.55, 60)
    height = mid[0] + 0.035 * rough * (1 - 0.6 * sand) + 0.011 * sand * wave + 0.025 * outcrop
    albedo = mid[1] * (1 + 0.22 * noise(x, y, 0.6, 2.4 * step, 0.68, 80) + 0.12 * (outcrop - mid[2]))
    return height, albedo * (1 + 0.08 * sand * (wave - 0.5)), outcrop


def _shades(grids: list[FloatArray], frames: tuple[Frame, ...], sun: FloatArray) -> list[FloatArray]:
    """Per node of each grid, the height up to which ground keeps the sun away."""
    across = float(np.hypot(sun[0], sun[1]))
    towards, rise = sun[1::-1] / max(across, 1e-9), sun[2] / max(across, 1e-9)
    shades: list[FloatArray] = []
    around: Frame | None = None
    for grid, frame in reversed(list(zip(grids, frames, strict=True))):
        reached, nodes = np.ptp(grid) / (rise * frame[1]), 1.0
        shade = scipy.ndimage.shift(grid, -towards, order=1, mode="nearest") - rise * frame[1]
        while nodes < min(reached, max(grid.shape)):
            # The highest of the next 2n nodes: of n, and of n from there.
            further = (
                scipy.ndimage.shift(shade, -nodes * towards, order=1, mode="nearest")
                - nodes * rise * frame[1]
            )
            shade, nodes = np.maximum(shade, further), 2 * nodes
        if around is not None:
            shade = np.maximum(shade, _at_nodes(shades[0], around, frame))
        shades.insert(0, shade)
        around = frame
    return shades


def _pyramids(
    levels: tuple[Level, ...], frames: tuple[Frame, ...], shades: list[FloatArray]
) -> tuple[Grids, IntArray, FloatArray]:
    """What the nodes of all grids carry, each grid followed by its halvings."""
    shape, frame_m = np.zeros((len(levels), _MIPS, 3), dtype=np.int64), np.zeros((len(levels), _MIPS, 3))
    parts: list[Grids] = []
    start = 0
    for i, (level, (first, finest, whole), shade) in enumerate(zip(levels, frames, shades, strict=True)):
        height, albedo, outcrop = (a.reshape(whole) for a in level)
        slope_y, slope_x = np.gradient(height, finest)
        grid = np.stack([slope_x, slope_y, albedo, outcrop, shade], axis=-1).astype(np.float32)
        corner, step = first.astype(float), finest
        for mip in range(_MIPS):
            deep, across = grid.shape[:2]
            shape[i, mip], frame_m[i, mip] = (start, across, deep), (*corner, step)
            start += deep * across
            parts.append(grid.reshape(-1, _rays.CHANNELS))
            corner, step = corner + step / 2, 2 * step
            even = grid[: deep // 2 * 2, : across // 2 * 2]
            grid = 0.25 * (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2])
    return np.concatenate(parts).ravel(), shape, frame_m


def _ceilings(grids: list[FloatArray]) -> tuple[Grids, IntArray]:
    """Per mesh of each grid the height that it does not exceed, and per square of four, of sixteen ..."""
    shape = np.zeros((len(grids), _SQUARINGS, 3), dtype=np.int64)
    parts: list[Grids] = []
    start = 0
    for i, grid in enumerate(grids):
        # As rounded as the heights themselves.
        g = grid.astype(np.float32)
        top = np.maximum(np.maximum(g[1:, 1:], g[1:, :-1]), np.maximum(g[:-1, 1:], g[:-1, :-1]))
        for squaring in range(_SQUARINGS):
            shape[i, squaring] = (start, *top.shape[::-1])
            start += top.size
            parts.append(top.ravel())
            odd = [(0, n % 2) for n in top.shape]
            top = np.pad(top, odd, constant_values=-np.inf)
            top = np.maximum(
                np.maximum(top[::2, ::2], top[1::2, ::2]), np.maximum(top[::2, 1::2], top[1::2, 1::2])
            )
    return np.concatenate(parts), shape


def _steepest(height_m: FloatArray, step: float) -> float:
    """A slope that hardly any ground exceeds."""
    steep = np.hypot(np.diff(height_m, axis=0)[:, :-1], np.diff(height_m, axis=1)[:-1])
    return float(1.15 * np.quantile(steep, 0.9995) / step + 0.02)


# --- rocks ---


def _forms(rng: np.random.Generator) -> FloatArray:
    """Balls cut by planes: the later the form, the more corners are left."""
    normal = rng.standard_normal((_FORMS, _PLANES, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    distance = rng.uniform(0.5, 0.92, (_FORMS, _PLANES))
    left_out = rng.random((_FORMS, _PLANES)) < np.linspace(0.5, 0.0, _FORMS)[:, None]
    return np.concatenate([normal, np.where(left_out, 2.0, distance)[..., None]], axis=-1)


def _diameters(abundance: float, area_m2: float, rng: np.random.Generator) -> FloatArray:
    """Diameters of the rocks on an area.

    The share covered by rocks of D or more is k exp(-q D), q = 1.79 + 0.152 / k (Golombek and Rapp 1997).
    """
    q = 1.79 + 0.152 / abundance
    edges = np.geomspace(*_ROCK_M, 200)
    middle = np.sqrt(edges[1:] * edges[:-1])
    covered = -abundance * np.diff(np.exp(-q * edges))
    counts = rng.poisson(area_m2 * covered / (np.pi / 4 * middle**2))
    return np.repeat(middle, counts) * rng.uniform(0.99, 1.01, int(counts.sum()))


def _with_rocks(
    scene: Scene,
    options: RenderOptions,
    stops_m: FloatArray,
    low: FloatArray,
    high: FloatArray,
    rng: np.random.Generator,
) -> Scene:
    if options.rock_abundance == 0:
        return scene
    # Twice as many, of which half are left where they cluster.
    size = _diameters(options.rock_abundance, 2 * float(np.prod(high - low)), rng)
    xy = low + rng.random((len(size), 2)) * (high - low)
    field = _Noise(scene.lattice, scene.key)(xy[:, 0], xy[:, 1], 9.0, 0.5, 0.6, 300)
    away = np.min([np.linalg.norm(xy - s, axis=1) for s in stops_m], axis=0)
    kept = (rng.random(len(size)) < np.clip(0.45 + 1.3 * field, 0.06, 1)) & (away > _CLEAR_M + size)
    kept &= size > _ROCK_RAD * away
    size, xy = size[kept], xy[kept]
    if not len(size):
        return scene
    n = len(size)
    axes = 0.5 * size[:, None] * rng.uniform([0.9, 0.65, 0.45], [1.25, 1.0, 0.85], (n, 3))
    yaw, lean, towards = rng.uniform(0, 2 * np.pi, n), 0.3 * rng.standard_normal(n), rng.uniform(0, np.pi, n)
    turn = scipy.spatial.transform.Rotation.from_euler(
        "ZYZ", np.column_stack([yaw + towards, lean, -towards])
    ).as_matrix()
    tall = np.sqrt(np.sum((turn[:, 2] * axes) ** 2, axis=1))
    z = heights(scene, xy) + tall * rng.uniform(-0.25, 0.45, n)
    rocks = np.zeros((n, _rays.ROCK_COLUMNS))
    rocks[:, [_rays.ROCK_X, _rays.ROCK_Y]], rocks[:, _rays.ROCK_Z] = xy, z
    to_ball = turn.transpose(0, 2, 1) / axes[:, :, None]
    rocks[:, _rays.ROCK_TO_BALL : _rays.ROCK_TO_BALL + 9] = to_ball.reshape(n, 9)
    rocks[:, _rays.ROCK_TOP] = z + tall
    rocks[:, _rays.ROCK_FORM] = rng.integers(len(scene.forms), size=n)
    bright = rng.random(n) < 0.2
    rocks[:, _rays.ROCK_ALBEDO] = np.where(bright, rng.uniform(0.19, 0.24, n), rng.uniform(0.12, 0.19, n))
    rocks[:, _rays.ROCK_RADIUS] = axes[:, :2].max(axis=1)
    rocks[:, _rays.ROCK_KEY] = rng.integers(2**20, size=n)
    return _sorted_into_cells(scene._replace(rocks=rocks), low, high)


def _sorted_into_cells(scene: Scene, low: FloatArray, high: FloatArray) -> Scene:
    """Rocks by the cells that they reach into, and by those that they shade."""
    across, deep = (int(c) for c in np.ceil((high - low) / _ROCK_CELL_M))
    rocks, shape = scene.rocks, (across, deep)
    xy, radius = rocks[:, [_rays.ROCK_X, _rays.ROCK_Y]], rocks[:, [_rays.ROCK_RADIUS]]
    cell, rock = _cells_of(xy - radius - low, xy + radius - low, shape)
    order = np.argsort(cell, kind="stable")
    top = np.full((deep, across), -np.inf)
    np.maximum.at(top.reshape(-1), cell, rocks[rock, _rays.ROCK_TOP])
    padded = np.pad(top, [(0, -n % _rays.BLOCK) for n in top.shape], constant_values=-np.inf)
    blocks = padded.reshape(len(padded) // _rays.BLOCK, _rays.BLOCK, -1, _rays.BLOCK).max(axis=(1, 3))
    # The shadow ends on ground that may lie lower than the rock's own.
    lower = rocks[:, _rays.ROCK_TOP] - heights(scene, xy) + 0.5 * radius[:, 0]
    tip = xy - lower[:, None] * scene.sun[:2] / scene.sun[2]
    margin = _rays.DIM_FOOT * radius
    shaded, shading = _cells_of(
        np.minimum(xy - margin, tip - radius) - low, np.maximum(xy + margin, tip + radius) - low, shape
    )
    by_cell = np.argsort(shaded, kind="stable")
    bounds = np.arange(across * deep + 1)
    return scene._replace(
        cells=np.searchsorted(cell[order], bounds),
        cell_rocks=rock[order],
        cell_top_m=np.concatenate([top.ravel(), blocks.ravel()]),
        shaded=np.searchsorted(shaded[by_cell], bounds),
        shaded_rocks=shading[by_cell],
        cell_shape=shape,
        rock_top_m=float(top.max()),
    )


def _cells_of(low: FloatArray, high: FloatArray, shape: tuple[int, int]) -> tuple[IntArray, IntArray]:
    """Cells, and which of the boxes from `low` to `high` (n, 2) reaches into each: all pairs."""
    across, deep = shape
    first = np.clip(np.floor(low / _ROCK_CELL_M).astype(np.int64), 0, [across - 1, deep - 1])
    last = np.clip(np.floor(high / _ROCK_CELL_M).astype(np.int64), 0, [across - 1, deep - 1])
    wide = last - first + 1
    counts = wide.prod(axis=1)
    box = np.repeat(np.arange(len(counts)), counts)
    nth = np.arange(len(box)) - np.repeat(np.cumsum(counts) - counts, counts)
    return (first[box, 1] + nth // wide[box, 0]) * across + first[box, 0] + nth % wide[box, 0], box
