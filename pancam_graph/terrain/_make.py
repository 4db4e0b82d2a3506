"""The surface of a drive: frames matched one by one, drawn on one grid, and fused."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.choices import some_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.options import options_of
from pancam_graph.base.threads import in_order
from pancam_graph.cluster import Job
from pancam_graph.images import Cache, Small, crew_at_work, even_out, find_masks
from pancam_graph.terrain._agreement import Agreement, agreement_of, finest_agreement
from pancam_graph.terrain._drive import Drive, Pair, stereo_pairs
from pancam_graph.terrain._fill import filled
from pancam_graph.terrain._frames import SURFACE, Frames, Seen
from pancam_graph.terrain._fused import Fused, fuse
from pancam_graph.terrain._grid import Layer
from pancam_graph.terrain._levels import Level, levels_around
from pancam_graph.terrain._section import Section, section_of
from pancam_graph.terrain._surface import Points
from pancam_graph.terrain._terrain_options import TerrainOptions

__all__ = ["Cloud", "Terrain", "make_terrain"]

_SHRINK = 4
"""One cell of so many along each axis is looked at for gains of brightness."""
_BRIGHTEST = 250.0
"""Brightness that the gains are estimated at: that of 8 bits."""

Progress = Callable[[str, int, int], None]


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
        first, last = (level.grid.cell_m for level in (self.drive.levels[0], self.drive.levels[-1]))
        cells = f"{first:g} to {last:g}" if self.drive.coarser else f"{first:g}"
        sigma_mm = 1e3 * float(np.nanmedian(self.drive.sigma_m))
        lines = [
            f"{len(self.pairs)} stereo frames of {len(self.stops)} stops, cells of {cells} m, heights known "
            f"to {sigma_mm:.1f} mm near the masts (median of formal sigmas)"
        ]
        before, after = (self.agreement.median_m(p) for p in ("telemetry", "refined"))
        if np.isfinite([before, after]).all():
            lines.append(
                f"surfaces of frames differ by {100 * before:.1f} cm with telemetry, {100 * after:.1f} cm "
                f"refined (median of {len(self.agreement.pairs)} pairs of frames)"
            )
        return lines


def make_terrain(
    drive: Drive,
    options: TerrainOptions = TerrainOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
    cache: Path | None = None,
    client: Any = None,
) -> Terrain:
    """Match every stereo frame of a drive and fuse what they see, for each stop and for all.

    Where two frames see the same cells, `Terrain.agreement` has by how much their surfaces differ, with
    telemetry's pointing and with the refined one. Pictures are read from the traverse's folder, and masks of
    sky, rover and saturated pixels are found in them (`cache`: where these are kept). `client`, a
    distributed.Client, shares frames among the workers of a Dask cluster, with the same result; they need the
    cache, and raise ClusterError, as those of `find_observations` do. Raises InputError where
    no frame has two pictures that see in stereo, for a cell that is too small for memory, and where no ground
    is found.
    """
    options = options_of(TerrainOptions, options, "make_terrain")
    traverse = drive.traverse
    pairs, warnings = stereo_pairs(drive)
    if not pairs:
        raise InputError(_no_stereo(drive))
    if drive.stereo is not None:
        unknown = [traverse.frames[p.frame].id for p in pairs if drive.stereo.of(p.left, p.right) is None]
        if unknown:
            warnings.append(
                f"terrain: sigmas of {some_of(unknown)} lack the errors of pose, angles and rig: the results "
                "have none of these pairs (stereo.npz)"
            )
    rows = np.array([p.left for p in pairs])
    centres = drive.world_t_camera[rows]
    focal_px = float(np.median([drive.cameras[r].pinhole.fx_px for r in rows]))
    levels = levels_around(centres, options.reach_m, options.cell_m, traverse.rig.mast_height_m, focal_px)
    masks = find_masks(traverse, progress=progress, cache=cache, client=client)
    most = sum(drive.cameras[pair.left].width_px * drive.cameras[pair.left].height_px for pair in pairs)
    frames_of = Frames(
        drive=drive,
        levels=levels,
        reach_m=options.reach_m,
        every=max(1, int(np.ceil(most / options.most_cloud_points))),
        masks=masks,
    )
    found = _found(frames_of, pairs, progress, cache, client)
    warnings += [each for each in found if isinstance(each, str)]
    frames = [each for each in found if isinstance(each, Seen)]
    if not frames:
        raise InputError(
            "terrain: expected ground that two eyes see, found none: see the masks of the images"
        )
    frames = _evened(frames)
    stop_of = [traverse.frames[each.pair.frame].stop for each in frames]
    of_stop = {
        stop.id: [each for each, own in zip(frames, stop_of, strict=True) if own == stop.id]
        for stop in traverse.stops
        if stop.id in stop_of
    }
    by_level = [_layers(frames, k) for k in range(len(levels))]
    agreements = [agreement_of(*layers, traverse.frame_stop) for layers in by_level]
    finest = next(k for k, (refined, _) in enumerate(by_level) if refined)
    return Terrain(
        drive=_surface(levels, frames, options),
        stops={name: _surface(levels, of, options) for name, of in of_stop.items()},
        clouds={n: _cloud(of) for n, of in of_stop.items()},
        agreement=finest_agreement(agreements),
        section=section_of(agreements[finest], *by_level[finest], levels[finest].grid),
        pairs=tuple(e.pair for e in frames),
        warnings=tuple(warnings),
    )


def _found(
    frames: Frames, pairs: Sequence[Pair], progress: Progress | None, cache: Path | None, client: Any
) -> list[Seen | str | None]:
    """What each frame sees; workers leave it in the cache, which forgets it once it was taken from there."""

    def tell(stage: str, done: int, total: int) -> None:
        if progress is not None:
            progress(stage, done, total)

    def told(number: int, _: Seen | str | None) -> None:
        tell("terrain", number + 1, len(pairs))

    with crew_at_work(client, frames.drive.traverse, cache) as crew:
        if crew is None:
            return in_order(frames.seen, pairs, told)
        kept = Cache(cache)
        entries = frames.drive.traverse.frames
        job = Job(
            function=_keep,
            shared=(frames, kept),
            name=lambda pair: f"the surface of frame {entries[pair.frame].id}",
        )
        crew.share(job, pairs, done=partial(tell, "terrain on workers"))
        found = in_order(lambda pair: frames.kept(pair, kept), pairs, told)
        kept.forget(SURFACE)
    return found


def _keep(shared: tuple[Frames, Cache], pair: Pair) -> None:
    """Have the surface of a frame in the cache; runs on a worker."""
    frames, cache = shared
    frames.kept(pair, cache)


def _layers(frames: Sequence[Seen], level: int) -> tuple[list[Layer], list[Layer]]:
    """Layers of frames on one level, with the refined pointing and with telemetry's."""
    return _known(e.refined[level] for e in frames), _known(e.telemetry[level] for e in frames)


def _surface(levels: Sequence[Level], frames: Sequence[Seen], options: TerrainOptions) -> Fused:
    """The surface of some frames, its coarser levels with it; levels that none of them sees are left out."""
    surfaces = list[Fused]()
    for k, level in enumerate(levels):
        refined, before = _layers(frames, k)
        if refined:
            fused = fuse(level.grid, refined, before)
            surfaces.append(filled(fused, options.fill_m) if options.fill_m else fused)
    return replace(surfaces[0], coarser=tuple(surfaces[1:]))


def _known(layers: Iterable[Layer | None]) -> list[Layer]:
    return [layer for layer in layers if layer is not None]


def _evened(frames: Sequence[Seen]) -> list[Seen]:
    """Frames of equal brightness: a gain of each, from what they show of the same cells.

    Cells are of the finest level that every frame sees, else of the coarsest; a frame that does not see that
    one keeps its brightness.
    """
    number = len(frames[0].refined)
    level = next((k for k in range(number) if all(e.refined[k] is not None for e in frames)), number - 1)
    shrink = max(1, _SHRINK >> level)
    layers = {k: layer for k, e in enumerate(frames) if (layer := e.refined[level]) is not None}
    brightest = max((float(np.nanmax(layer.grey)) for layer in layers.values()), default=0.0)
    scale, small = np.float32(_BRIGHTEST / max(brightest, 1e-6)), []
    for k, layer in layers.items():
        # Every n-th cell of the grid, the same ones of all layers.
        top, left = -layer.first_row % shrink, -layer.first_column % shrink
        grey = layer.grey[top::shrink, left::shrink] * scale
        small.append(
            Small(
                number=k,
                left_px=(layer.first_column + left) // shrink,
                top_px=(layer.first_row + top) // shrink,
                grey=np.nan_to_num(grey),
                chosen=np.isfinite(grey),
                radius_squared=np.zeros(grey.shape, dtype=np.float32),
            )
        )
    gain, evened = even_out(small).gain if small else {}, []
    for k, each in enumerate(frames):
        factor = np.float32(gain.get(k, 1.0))
        refined = tuple(
            None if layer is None else replace(layer, grey=layer.grey * factor) for layer in each.refined
        )
        points = replace(each.points, grey=each.points.grey * factor)
        evened.append(replace(each, refined=refined, points=points))
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


def _cloud(frames: Sequence[Seen]) -> Cloud:
    parts = [each.points for each in frames]
    joined = {
        name: np.concatenate([getattr(p, name) for p in parts])
        for name in ("xyz_m", "sigma_m", "covariance_m2", "grey")
    }
    frame = np.repeat([each.pair.frame for each in frames], [len(p.sigma_m) for p in parts])
    return Cloud(points=Points(**joined), frame=frame)
