"""The surface of a drive: frames matched one by one, drawn on one grid, and fused."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.base.options import options_of
from pancam_graph.base.threads import in_order
from pancam_graph.images import ImageMask, Small, even_out, find_masks
from pancam_graph.terrain import kernel
from pancam_graph.terrain._agreement import Agreement, agreement_of
from pancam_graph.terrain._drive import Drive, Pair, stereo_pairs
from pancam_graph.terrain._grid import Grid, Layer, grid_around
from pancam_graph.terrain._section import Section, section_of
from pancam_graph.terrain._surface import Points, ground_spacing_m, surface_of
from pancam_graph.terrain._terrain_options import TerrainOptions

__all__ = ["Cloud", "Fused", "Terrain", "make_terrain"]

_CELL_AT_M = 6.0
"""Distance from the mast at which the cell is as wide as points lie apart."""
_SHRINK = 4
"""One cell of so many along each axis is looked at for gains of brightness."""
_BRIGHTEST = 250.0
"""Brightness that the gains are estimated at: that of 8 bits."""
_ROWS = 64
"""Rows of a grid that are fused at a time."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Fused:
    """The surfaces of some frames as one, on the part of a grid that they cover; NaN where all is hidden."""

    grid: Grid
    height_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    count: NDArray[np.float32]
    """How many frames see each cell."""
    disagreement_m: NDArray[np.float32]
    """Standard deviation between frames; NaN where fewer than two see the cell."""
    grey: NDArray[np.float32]
    """Brightness in samples of the pictures."""
    telemetry_m: NDArray[np.float32]
    """Height with telemetry's pointing; NaN where that is not known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Points of some frames."""

    points: Points
    frame: NDArray[np.int64]
    """(n,) row of each point's frame."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """The surface of a drive and of each of its stops."""

    drive: Fused
    stops: dict[str, Fused]
    clouds: dict[str, Cloud]
    """By stop."""
    agreement: Agreement
    section: Section | None
    """Two frames that telemetry puts far apart, in section; None where no two see the same ground."""
    pairs: tuple[Pair, ...]
    warnings: tuple[str, ...]

    def says(self) -> list[str]:
        """What was found, in sentences."""
        sigma_mm = 1e3 * float(np.nanmedian(self.drive.sigma_m))
        lines = [
            f"{len(self.pairs)} stereo frames of {len(self.stops)} stops, cells of "
            f"{self.drive.grid.cell_m:g} m, heights known to {sigma_mm:.1f} mm (median of formal sigmas)"
        ]
        before, after = (self.agreement.median_m(p) for p in ("telemetry", "refined"))
        if np.isfinite([before, after]).all():
            lines.append(
                f"surfaces of frames differ by {100 * before:.1f} cm with telemetry, {100 * after:.1f} cm "
                f"refined (median of {len(self.agreement.pairs)} pairs of frames)"
            )
        return lines


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """What one frame gave: its layer with each pointing, and its points."""

    pair: Pair
    refined: Layer
    telemetry: Layer | None
    points: Points


def make_terrain(
    drive: Drive,
    options: TerrainOptions = TerrainOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
    cache: Path | None = None,
) -> Terrain:
    """Match every stereo frame of a drive and fuse what they see, for each stop and for all.

    Where two frames see the same cells, `Terrain.agreement` has by how much their surfaces differ, with
    telemetry's pointing and with the refined one. Pictures are read from the traverse's folder, and masks of
    sky, rover and saturated pixels are found in them (`cache`: where these are kept). Raises InputError where
    no frame has two pictures that see in stereo, for a cell that is too small for memory, and where no ground
    is found.
    """
    options = options_of(TerrainOptions, options, "make_terrain")
    traverse = drive.traverse
    pairs, warnings = stereo_pairs(drive)
    if not pairs:
        raise InputError(_no_stereo(drive))
    rows = np.array([p.left for p in pairs])
    centres = drive.world_t_camera[rows]
    focal_px = float(np.median([drive.cameras[r].pinhole.fx_px for r in rows]))
    spacing = float(ground_spacing_m(np.array(_CELL_AT_M), traverse.rig.mast_height_m, focal_px))
    cell_m = options.cell_m or _round(spacing)
    grid = grid_around(centres, options.reach_m, cell_m)
    masks = find_masks(traverse, progress=progress, cache=cache)
    telemetry = drive.telemetry()
    most = sum(drive.cameras[pair.left].width_px * drive.cameras[pair.left].height_px for pair in pairs)
    every = max(1, int(np.ceil(most / options.most_cloud_points)))

    def seen(pair: Pair) -> _Seen | str | None:
        left, right = _usable(masks[pair.left]), _usable(masks[pair.right])
        if left is None or right is None:
            return f"terrain: frame {traverse.frames[pair.frame].id} is left out: a picture cannot be used"
        try:
            surface = surface_of(drive, pair, (left, right), options.reach_m)
        except ImageError as error:
            return f"terrain: frame {traverse.frames[pair.frame].id} is left out: {error}"
        layer = surface.layer(grid, options.reach_m)
        return (
            None
            if layer is None
            else _Seen(
                pair=pair,
                refined=layer,
                telemetry=surface.layer(grid, options.reach_m, _to_telemetry(drive, telemetry, pair)),
                points=surface.points(options.reach_m, every),
            )
        )

    def tell(number: int, _: _Seen | str | None) -> None:
        if progress is not None:
            progress("terrain", number + 1, len(pairs))

    found = in_order(seen, pairs, tell)
    warnings += [each for each in found if isinstance(each, str)]
    frames = [each for each in found if isinstance(each, _Seen)]
    if not frames:
        raise InputError(
            "terrain: expected ground that two eyes see, found none: see the masks of the images"
        )
    frames = _evened(frames)
    layers, before = [each.refined for each in frames], _telemetry_layers(frames)
    stop_of = [traverse.frames[each.pair.frame].stop for each in frames]
    of_stop = {
        stop.id: [each for each, own in zip(frames, stop_of, strict=True) if own == stop.id]
        for stop in traverse.stops
        if stop.id in stop_of
    }
    agreement = agreement_of(layers, before, traverse.frame_stop)
    return Terrain(
        drive=fuse(grid, layers, before),
        stops={n: fuse(grid, [e.refined for e in of], _telemetry_layers(of)) for n, of in of_stop.items()},
        clouds={n: _cloud(of) for n, of in of_stop.items()},
        agreement=agreement,
        section=section_of(agreement, layers, before, grid),
        pairs=tuple(e.pair for e in frames),
        warnings=tuple(warnings),
    )


def _evened(frames: Sequence[_Seen]) -> list[_Seen]:
    """Frames of equal brightness: a gain of each, from what they show of the same cells."""
    layers = [each.refined for each in frames]
    brightest = max(float(np.nanmax(layer.grey)) for layer in layers)
    scale, small = np.float32(_BRIGHTEST / max(brightest, 1e-6)), []
    for k, layer in enumerate(layers):
        # Every n-th cell of the grid, the same ones of all layers.
        top, left = -layer.first_row % _SHRINK, -layer.first_column % _SHRINK
        grey = layer.grey[top::_SHRINK, left::_SHRINK] * scale
        small.append(
            Small(
                number=k,
                left_px=(layer.first_column + left) // _SHRINK,
                top_px=(layer.first_row + top) // _SHRINK,
                grey=np.nan_to_num(grey),
                chosen=np.isfinite(grey),
                radius_squared=np.zeros(grey.shape, dtype=np.float32),
            )
        )
    gain, evened = even_out(small).gain, []
    for k, each in enumerate(frames):
        own, points = each.refined, each.points
        factor = np.float32(gain[k])
        evened.append(
            replace(
                each,
                refined=replace(own, grey=own.grey * factor),
                points=replace(points, grey=points.grey * factor),
            )
        )
    return evened


def _no_stereo(drive: Drive) -> str:
    """Why there is no terrain, as one sentence."""
    traverse = drive.traverse
    if all(image.file is None for image in traverse.images):
        return f"traverse {traverse.name}: terrain: expected image files, found none"
    frames, counts = np.unique(traverse.image_frame, return_counts=True)
    if len(frames) and counts.max() < 2:
        return (
            f"traverse {traverse.name}: terrain: expected frames with pictures of two eyes, found one eye in "
            "each: what a single eye shows of the ground is drawn by refine --mosaic, on the surface of its "
            "landmarks"
        )
    return (
        f"traverse {traverse.name}: terrain: expected two eyes apart, alike in focal length and looking the "
        "same way, with pictures and poses of one frame, found no such frame"
    )


def _round(cell_m: float) -> float:
    """A cell of one significant digit, 1, 2 or 5."""
    power = 10.0 ** np.floor(np.log10(cell_m))
    return float(power * min((1.0, 2.0, 5.0, 10.0), key=lambda k: abs(np.log(k * power / cell_m))))


def _usable(mask: ImageMask | None) -> BoolArray | None:
    return None if mask is None else mask.usable(between_stops=True)


def _to_telemetry(
    drive: Drive, telemetry: tuple[FloatArray, FloatArray], pair: Pair
) -> tuple[FloatArray, FloatArray]:
    """From the refined world to telemetry's: where the left camera of a frame would have put its points."""
    i = pair.left
    turn = telemetry[0][i] @ drive.world_R_camera[i].T
    return turn, telemetry[1][i] - turn @ drive.world_t_camera[i]


def _cloud(frames: Sequence[_Seen]) -> Cloud:
    parts = [each.points for each in frames]
    joined = {
        name: np.concatenate([getattr(p, name) for p in parts])
        for name in ("xyz_m", "sigma_m", "covariance_m2", "grey")
    }
    frame = np.repeat([each.pair.frame for each in frames], [len(p.sigma_m) for p in parts])
    return Cloud(points=Points(**joined), frame=frame)


def _telemetry_layers(frames: Sequence[_Seen]) -> list[Layer]:
    return [each.telemetry for each in frames if each.telemetry is not None]


def fuse(grid: Grid, layers: Sequence[Layer], telemetry: Sequence[Layer] = ()) -> Fused:
    """Fuse the layers of some frames on the part of the grid that they cover, and there telemetry's too."""
    boxes = [layer.box for layer in layers]
    box = tuple(
        slice(min(s.start for s in along), max(s.stop for s in along)) for along in zip(*boxes, strict=True)
    )
    rows, columns = box
    height, variance, count, disagreement, grey = _fused_bands(layers, (rows, columns), 5)
    (before,) = _fused_bands(telemetry, (rows, columns), 1)
    return Fused(
        grid=grid.part(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start),
        height_m=height,
        sigma_m=np.sqrt(variance),
        count=count,
        disagreement_m=disagreement,
        grey=grey,
        telemetry_m=before,
    )


def _fused_bands(layers: Sequence[Layer], box: tuple[slice, slice], bands: int) -> NDArray[np.float32]:
    """The first bands (bands, rows, columns) of what layers are as one, in some rows and columns of the grid.

    The bands are height, variance, count, disagreement, and grey. What layers have beyond is cut off.
    """
    (top, bottom), (left, right) = ((s.start, s.stop) for s in box)
    fused = np.empty((bands, bottom - top, right - left), dtype=np.float32)
    for begin in range(top, bottom, _ROWS):
        end = min(begin + _ROWS, bottom)
        here = [lay for lay in layers if lay.first_row < end and lay.box[0].stop > begin]
        stack = np.full((3, max(len(here), 1), end - begin, right - left), np.nan, dtype=np.float32)
        for k, layer in enumerate(here):
            r, c = layer.box
            first, last = max(r.start, begin), min(r.stop, end)
            west, east = max(c.start, left), min(c.stop, right)
            if west >= east:
                continue
            to = slice(first - begin, last - begin), slice(west - left, east - left)
            part = slice(first - r.start, last - r.start), slice(west - c.start, east - c.start)
            for band, values in enumerate((layer.height_m, layer.variance_m2, layer.grey)):
                stack[(band, k, *to)] = values[part]
        flat = stack.reshape(3, stack.shape[1], -1)
        out = np.empty((5, flat.shape[2]), dtype=np.float32)
        kernel.fuse_cells(flat[0], flat[1], flat[2], out)
        fused[:, begin - top : end - top] = out[:bands].reshape(bands, end - begin, right - left)
    return fused
