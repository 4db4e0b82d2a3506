"""The world that is rendered, drawn by seed: nested grids of ground, rocks, and the plates of a deck."""

import gtsam
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from pancam_graph.geometry import FloatArray, IntArray
from pancam_graph.simulate._options import RenderOptions
from pancam_graph.simulate._raycast import Deck, Grids, Scene, heights, noises

__all__ = ["make_deck", "make_scene", "slopes"]

_MIPS = 8
_FINE_STEP_M, _FINE_REACH_M, _FINE_NODES = 0.03, 22.0, 9e6
_MID_STEP_M, _MID_REACH_M, _MID_NODES = 0.25, 150.0, 4e6
_FAR_NODES = 1024
_FAR_REACH = 2.5  # of the outermost ground, over the distance of the ridge
_RIDGE_SIZE = 0.05  # height of the ridge over its distance
_ROCK_REACH_M = 100.0
_ROCK_CELL_M = 0.5
_ROCK_M = (0.03, 1.3)  # diameters
_ROCK_RAD = 0.0018  # rocks that look smaller than this from the nearest stop are left out
_FORMS, _PLANES = 48, 9
_WHEELBASE_M = 0.6  # half of it
_CLEAR_M = 1.1  # no rock stands nearer to a mast: the rover is there

Nodes = tuple[FloatArray, FloatArray]
Level = tuple[FloatArray, FloatArray, FloatArray]


def make_scene(options: RenderOptions, xy_m: FloatArray, rng: np.random.Generator) -> Scene:
    """A world around stops at x and y (n, 2)."""
    key = int(rng.integers(2**20))
    low, high = xy_m.min(axis=0), xy_m.max(axis=0)
    reach = _FAR_REACH * options.ridge_m + np.max(high - low)
    middle = 0.5 * (low + high)
    far_frame = (middle - reach, 2 * reach / _FAR_NODES, (_FAR_NODES, _FAR_NODES))
    mid_frame = _frame(low - _MID_REACH_M, high + _MID_REACH_M, _MID_STEP_M, _MID_NODES)
    fine_frame = _frame(low - _FINE_REACH_M, high + _FINE_REACH_M, _FINE_STEP_M, _FINE_NODES)
    far = _far(_nodes(far_frame), middle, options.ridge_m + float(np.max(high - low)) / 2, key)
    mid = _mid(_nodes(mid_frame), _finer(far, far_frame, mid_frame), key + 100)
    fine = _fine(_nodes(fine_frame), _finer(mid, mid_frame, fine_frame), fine_frame[1], key + 200)
    frames, levels = (fine_frame, mid_frame, far_frame), (fine, mid, far)
    arrays, shape, frame_m = _pyramids(levels, frames)
    slope = np.array(
        [_steepest(level[0].reshape(f[2]), f[1]) for level, f in zip(levels, frames, strict=True)]
    )
    az, el = options.sun_azimuth_rad, options.sun_elevation_rad
    empty = np.zeros((0, 17))
    scene = Scene(
        height_m=arrays[0],
        albedo=arrays[1],
        outcrop=arrays[2],
        shape=shape,
        frame_m=frame_m,
        slope=slope,
        top_m=float(max(level[0].max() for level in levels)),
        rough_m=2 * float(np.abs(fine[0] - _finer(mid, mid_frame, fine_frame)[0]).max()),
        tall_m=0.0,
        rocks=empty,
        forms=_forms(rng),
        cells=np.zeros(2, dtype=np.int64),
        cell_rocks=np.zeros(0, dtype=np.int64),
        cell_top_m=np.full(1, -np.inf),
        cell_frame_m=np.array([*(low - _ROCK_REACH_M), _ROCK_CELL_M]),
        cell_shape=(1, 1),
        rock_top_m=-1e9,
        sun=np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)]),
        haze_m=9000.0,
        key=key,
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


def _frame(low: FloatArray, high: FloatArray, step: float, most: float) -> Frame:
    step = max(step, float(np.sqrt(np.prod(high - low) / most)))
    across, deep = (int(n) for n in np.ceil((high - low) / step))
    return low, step, (deep, across)


def _nodes(frame: Frame) -> Nodes:
    first, step, (deep, across) = frame
    y, x = np.mgrid[0:deep, 0:across] * step
    return (x + first[0]).ravel(), (y + first[1]).ravel()


def _finer(level: Level, frame: Frame, finer: Frame) -> Level:
    """A level at the nodes of a finer one, smoothly interpolated."""
    x, y = _nodes(finer)
    at = np.stack([(y - frame[0][1]) / frame[1], (x - frame[0][0]) / frame[1]])
    height, albedo, outcrop = (map_coordinates(a.reshape(frame[2]), at, order=3) for a in level)
    return height, albedo, outcrop


def _rise(value: FloatArray, low: float, high: float) -> FloatArray:
    t = np.clip((value - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def _far(nodes: Nodes, middle: FloatArray, ridge_m: float, key: int) -> Level:
    """Plains with a crater's rim around: eroded, higher here and lower there."""
    x, y = nodes
    dx, dy = x - middle[0], y - middle[1]
    away = np.hypot(dx, dy)
    bend = noises(dx, dy, 1.2 * ridge_m, 0.1 * ridge_m, 0.5, key)
    crest = ridge_m * (1 + 0.35 * bend)
    gullies = noises(x, y, 0.25 * ridge_m, 0.012 * ridge_m, 0.52, key + 20)
    size = (
        _RIDGE_SIZE
        * ridge_m
        * np.clip(0.75 + 1.5 * noises(dx, dy, 0.8 * ridge_m, 0.2 * ridge_m, 0.5, key + 10), 0.15, 2)
    )
    ridge = size * np.exp(-(((away - crest) / (0.22 * ridge_m)) ** 2)) * (1 + 0.55 * gullies)
    # Ground drops a little away from the drive, so that the plains are seen and not only their edge.
    plains = 0.02 * ridge_m * 0.25 * noises(x, y, 300.0, 25.0, 0.5, key + 30) * _rise(away, 20, 300)
    albedo = 0.21 * (1 + 0.5 * noises(x, 1.7 * y, 260.0, 12.0, 0.65, key + 40))
    albedo *= 1 - 0.25 * _rise(away, 150, 500) * (away < crest) + 0.15 * _rise(away, 0.8 * ridge_m, ridge_m)
    outcrop = _rise(noises(x, y, 60.0, 8.0, 0.5, key + 60), 0.05, 0.35)
    return ridge + plains, np.clip(albedo, 0.08, 0.45), outcrop


def _mid(nodes: Nodes, far: Level, key: int) -> Level:
    """Undulations of metres, patches of dust, sand and bare rock."""
    x, y = nodes
    height = far[0] + 1.1 * noises(x, y, 26.0, 1.0, 0.52, key)
    outcrop = _rise(0.6 * (far[2] - 0.3) + noises(x, y, 11.0, 0.5, 0.62, key + 20), 0.02, 0.30)
    dust = noises(x, y, 14.0, 0.7, 0.62, key + 40)
    return height, np.clip(far[1] * (1 + 0.28 * dust + 0.22 * outcrop), 0.10, 0.33), outcrop


def _fine(nodes: Nodes, mid: Level, step: float, key: int) -> Level:
    """Decimetres: wind ripples where there is sand, steps and joints where there is rock."""
    x, y = nodes
    outcrop = np.clip(mid[2] + 0.9 * noises(x, y, 0.8, 0.1, 0.6, key) * mid[2], 0, 1)
    sand = (1 - outcrop) * _rise(noises(x, y, 7.0, 1.5, 0.5, key + 20), 0.08, 0.4)
    warp = 0.35 * noises(x, y, 2.2, 0.5, 0.5, key + 40)
    phase = 2 * np.pi * (0.83 * x + 0.55 * y + warp) / 0.21
    wave = 0.5 + 0.5 * np.sin(phase + 0.5 * np.sin(phase))
    rough = noises(x, y, 0.7, 0.09, 0.55, key + 60)
    height = mid[0] + 0.035 * rough * (1 - 0.6 * sand) + 0.011 * sand * wave + 0.025 * outcrop
    albedo = mid[1] * (1 + 0.22 * noises(x, y, 0.6, 2.4 * step, 0.68, key + 80) + 0.12 * (outcrop - mid[2]))
    return height, albedo * (1 + 0.08 * sand * (wave - 0.5)), outcrop


def _pyramids(
    levels: tuple[Level, ...], frames: tuple[Frame, ...]
) -> tuple[list[Grids], IntArray, FloatArray]:
    """All grids of all levels, each followed by its halvings, one after the other."""
    shape, frame_m = np.zeros((len(levels), _MIPS, 3), dtype=np.int64), np.zeros((len(levels), _MIPS, 3))
    parts: list[list[FloatArray]] = [[], [], []]
    start = 0
    for i, (level, (first, finest, whole)) in enumerate(zip(levels, frames, strict=True)):
        grids: list[FloatArray] = [a.reshape(whole) for a in level]
        size = whole
        corner, step = first.astype(float), finest
        for mip in range(_MIPS):
            deep, across = size
            shape[i, mip], frame_m[i, mip] = (start, across, deep), (*corner, step)
            start += deep * across
            for part, grid in zip(parts, grids, strict=True):
                part.append(grid.ravel())
            corner, step = corner + step / 2, 2 * step
            size = (deep // 2, across // 2)
            even = [g[: deep // 2 * 2, : across // 2 * 2] for g in grids]
            grids = [0.25 * (g[::2, ::2] + g[1::2, ::2] + g[::2, 1::2] + g[1::2, 1::2]) for g in even]
    return [np.concatenate(part).astype(np.float32) for part in parts], shape, frame_m


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
    field = noises(xy[:, 0], xy[:, 1], 9.0, 0.5, 0.6, scene.key + 300)
    away = np.min([np.linalg.norm(xy - s, axis=1) for s in stops_m], axis=0)
    kept = (rng.random(len(size)) < np.clip(0.45 + 1.3 * field, 0.06, 1)) & (away > _CLEAR_M + size)
    kept &= size > _ROCK_RAD * away
    size, xy = size[kept], xy[kept]
    if not len(size):
        return scene
    n = len(size)
    axes = 0.5 * size[:, None] * rng.uniform([0.9, 0.65, 0.45], [1.25, 1.0, 0.85], (n, 3))
    yaw, lean, towards = rng.uniform(0, 2 * np.pi, n), 0.3 * rng.standard_normal(n), rng.uniform(0, np.pi, n)
    turn = Rotation.from_euler("ZYZ", np.column_stack([yaw + towards, lean, -towards])).as_matrix()
    tall = np.sqrt(np.sum((turn[:, 2] * axes) ** 2, axis=1))
    z = heights(scene, xy) + tall * rng.uniform(-0.25, 0.45, n)
    rocks = np.zeros((n, 17))
    rocks[:, :2], rocks[:, 2] = xy, z
    rocks[:, 3:12] = (turn.transpose(0, 2, 1) / axes[:, :, None]).reshape(n, 9)
    rocks[:, 12] = z + tall
    rocks[:, 13] = rng.integers(len(scene.forms), size=n)
    bright = rng.random(n) < 0.2
    rocks[:, 14] = np.where(bright, rng.uniform(0.19, 0.24, n), rng.uniform(0.12, 0.19, n))
    rocks[:, 15] = axes[:, :2].max(axis=1)
    rocks[:, 16] = rng.integers(2**20, size=n)
    # A rock's top may be over lower ground than its middle.
    tall_m = float((rocks[:, 12] - heights(scene, xy) + scene.slope[0] * rocks[:, 15]).max())
    return _sorted_into_cells(scene._replace(rocks=rocks, tall_m=tall_m), low, high)


def _sorted_into_cells(scene: Scene, low: FloatArray, high: FloatArray) -> Scene:
    """Rocks by the cells that they, and the dim ground around them, reach into."""
    across, deep = (int(c) for c in np.ceil((high - low) / _ROCK_CELL_M))
    reach = 1.6 * scene.rocks[:, 15:16]
    first = np.floor((scene.rocks[:, :2] - reach - low) / _ROCK_CELL_M).astype(np.int64)
    last = np.floor((scene.rocks[:, :2] + reach - low) / _ROCK_CELL_M).astype(np.int64)
    first, last = np.clip(first, 0, [across - 1, deep - 1]), np.clip(last, 0, [across - 1, deep - 1])
    wide = last - first + 1
    counts = wide.prod(axis=1)
    rock = np.repeat(np.arange(len(counts)), counts)
    nth = np.arange(len(rock)) - np.repeat(np.cumsum(counts) - counts, counts)
    cell = (first[rock, 1] + nth // wide[rock, 0]) * across + first[rock, 0] + nth % wide[rock, 0]
    order = np.argsort(cell, kind="stable")
    top = np.full(across * deep, -np.inf)
    np.maximum.at(top, cell, scene.rocks[rock, 12])
    return scene._replace(
        cells=np.searchsorted(cell[order], np.arange(across * deep + 1)),
        cell_rocks=rock[order],
        cell_top_m=top,
        cell_shape=(across, deep),
        rock_top_m=float(top.max()),
    )
