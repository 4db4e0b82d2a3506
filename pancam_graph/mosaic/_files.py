"""Mosaics as files: pictures, pictures with axes, and where their pixels are in the world."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.charts import encoded
from pancam_graph.data import Solution
from pancam_graph.io import MOSAIC_FORMAT, VERSION, same_pictures
from pancam_graph.mosaic._anaglyph import anaglyph, eye_pairs
from pancam_graph.mosaic._draw import close_ups, comparison, with_axes
from pancam_graph.mosaic._make import Mosaic, StopGround, StopMosaics, make_mosaics, stop_ground
from pancam_graph.mosaic._mosaic_options import MosaicOptions
from pancam_graph.mosaic._placed import POINTINGS, Pointing
from pancam_graph.mosaic._polar import goes_half_round, polar_view
from pancam_graph.mosaic._projections import Cylinder
from pancam_graph.mosaic._seam_error import CASES, Case

__all__ = ["MOSAIC_INDEX", "MOSAIC_PAGE", "Blink", "WrittenMosaics", "write_mosaics"]

MOSAIC_INDEX = "mosaics.json"
"""The file in a folder of mosaics that lists the others."""
MOSAIC_PAGE = "mosaics.html"
"""The page of a folder of mosaics, which the index does not list: whoever writes reports writes it."""
_MAX_NAME = 40
_QUALITY = 88
_BLINK_BUDGET = 6_000_000
"""Bytes that the pictures for the report may take together."""
_BLINK_QUALITY = 80
_BLINK_WIDTH_PX = 1500
_BLINK_GROUND_PX = 800
_CLOSE_UPS = 4

Json = dict[str, object]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class Blink:
    """Two pictures of one place, one with each pointing, that the report shows in turn."""

    group: str
    """Names of the stop and the camera; the report lists pictures by them."""
    title: str
    captions: dict[Pointing, str]
    """Text under the picture of each pointing."""
    jpeg: dict[Pointing, bytes]
    width_px: int
    height_px: int


@dataclass(frozen=True, kw_only=True)
class WrittenMosaics:
    """What `write_mosaics` wrote, for the report and for the list of warnings."""

    blinks: tuple[Blink, ...]
    lines: tuple[str, ...]
    """The seam error of each panorama, in words."""
    warnings: tuple[str, ...]
    entries: tuple[Json, ...]
    """What the index says of each mosaic."""
    north_deg: float | None
    """Azimuth of north, anticlockwise from the world's x axis; None: not known."""


def write_mosaics(
    solution: Solution,
    folder: Path,
    options: MosaicOptions = MosaicOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
) -> WrittenMosaics:
    """Write the mosaics of every eye at every stop into a folder, which must exist (docs/files.md).

    An image that cannot be shown, or an eye without any image at a stop, becomes a warning. `progress` is
    called with a stage, how many of its parts are done, and how many there are.
    """
    traverse = solution.traverse
    north_deg = None if traverse.site is None else math.degrees(traverse.site.north_rad)
    pairs = sorted(set(zip(traverse.image_stop.tolist(), traverse.image_eye.tolist(), strict=True)))
    entries: list[Json] = []
    blinks: list[Blink] = []
    lines, warnings = [], []
    ground: tuple[int, StopGround] | None = None
    at_stop: dict[int, tuple[StopMosaics, Json]] = {}
    twice = same_pictures(traverse)
    spent = 0
    for n, (stop, eye) in enumerate(pairs):
        stop_id, camera = traverse.stops[stop].id, traverse.rig.eyes[eye].name
        try:
            if ground is None or ground[0] != stop:
                ground, at_stop = (stop, stop_ground(solution, stop, twice)), {}
            made = make_mosaics(solution, stop_id, camera, options, ground=ground[1])
        except InputError as error:
            warnings.append(str(error))
        else:
            name = f"{stop + 1:03d}-{eye + 1}_{_plain(stop_id)}_{_plain(camera)}"
            title = f"stop {stop_id}, camera {camera}"
            new_entries = _write(made, folder, name, title, north_deg)
            entries += new_entries
            at_stop[eye] = made, new_entries[0]
            _write_stereo(solution, stop, eye, at_stop, ground[1], folder, north_deg)
            lines.append(f"{title}: {_in_words(made)}")
            warnings += made.warnings
            if spent < _BLINK_BUDGET:
                new = _blinks(made, title, north_deg)
                spent += sum(len(data) for blink in new for data in blink.jpeg.values())
                blinks += new
        if progress is not None:
            progress("mosaics", n + 1, len(pairs))
    index = {"format": MOSAIC_FORMAT, "version": VERSION, "mosaics": entries}
    text = json.dumps(index, indent=1, allow_nan=False, ensure_ascii=False)
    (folder / MOSAIC_INDEX).write_text(text + "\n", encoding="utf-8", newline="\n")
    return WrittenMosaics(
        blinks=tuple(blinks),
        lines=tuple(lines),
        warnings=tuple(warnings),
        entries=tuple(entries),
        north_deg=north_deg,
    )


def _plain(name: str) -> str:
    """A name that every file system takes; two ids may get one name, and the numbers before it differ."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-")[:_MAX_NAME] or "x"


def _in_words(made: StopMosaics) -> str:
    seams = made.seams
    if not seams.used:
        return "no overlap with texture enough to measure a seam error"
    own_surface = seams.median_px("telemetry_own_surface")
    return (
        f"seam error {seams.median_px('telemetry'):.2f} px with telemetry ({own_surface:.2f} px on the "
        f"surface that its own landmarks span), {seams.median_px('refined'):.2f} px refined; "
        f"median of {seams.used} windows in {len(seams.overlaps)} overlaps"
    )


def _write(made: StopMosaics, folder: Path, name: str, title: str, north_deg: float | None) -> list[Json]:
    """Write the pictures of one eye at one stop; returns their entries in the index."""
    entries = []
    for kind, mosaic in (("cylinder", made.cylinder), ("ground", made.ground)):
        if mosaic is None:
            continue
        files: Json = {}
        for pointing in POINTINGS:
            plain, drawn = (f"{name}_{kind}_{pointing}{end}" for end in (".png", "_axes.jpg"))
            _save(folder / plain, mosaic.pictures[pointing])
            caption = f"{title}: {_POINTING[pointing]} pointing"
            _save(folder / drawn, with_axes(mosaic, pointing, caption, north_deg=north_deg))
            files |= {pointing: plain, f"{pointing}_axes": drawn}
            if isinstance(mosaic.projection, Cylinder):
                (folder / plain).with_suffix(".pgw").write_text(_world_file(mosaic.projection, north_deg))
                files[f"{pointing}_world_file"] = plain.removesuffix(".png") + ".pgw"
                if goes_half_round(mosaic.projection):
                    polar = f"{name}_polar_{pointing}.jpg"
                    _save(folder / polar, polar_view(mosaic, pointing, caption, north_deg=north_deg))
                    files[f"{pointing}_polar"] = polar
            if mosaic.samples is not None:
                deep = f"{name}_{kind}_{pointing}_16bit.png"
                _save(folder / deep, mosaic.samples[pointing])
                files[f"{pointing}_16bit"] = deep
        if kind == "cylinder":
            files["comparison"] = f"{name}_comparison.jpg"
            _save(folder / f"{name}_comparison.jpg", comparison(made, title, north_deg))
        entry: Json = {"stop": made.stop, "camera": made.camera, "kind": kind, "images": list(made.images)}
        entry |= {"files": files} | _place(mosaic)
        entry |= {"dark": mosaic.dark, "bright": mosaic.bright}
        if kind == "cylinder":
            entry["brightness"] = _brightness(made)
            entry["seam_error"] = _seam_error(made)
        entries.append(entry)
    return entries


def _write_stereo(
    solution: Solution,
    stop: int,
    eye: int,
    at_stop: dict[int, tuple[StopMosaics, Json]],
    ground: StopGround,
    folder: Path,
    north_deg: float | None,
) -> None:
    """Write the stereo panoramas of an eye and those at its stop that were written before it.

    Each is named in the entry of its left eye's panorama.
    """
    for pair in eye_pairs(solution, stop):
        if eye not in (pair.left, pair.right) or not {pair.left, pair.right} <= at_stop.keys():
            continue
        (left, entry), (right, _) = at_stop[pair.left], at_stop[pair.right]
        files = entry["files"]
        assert isinstance(files, dict)  # as `_write` made it
        file = (
            f"{str(files['comparison']).removesuffix('_comparison.jpg')}_{_plain(right.camera)}_anaglyph.jpg"
        )
        title = (
            f"stop {left.stop}, cameras {left.camera} and {right.camera}: refined, for red and cyan glasses"
        )
        surface = ground.surfaces["refined"]
        picture = anaglyph(
            left.cylinder, right.cylinder, surface, pair.baseline_m, "refined", title, north_deg=north_deg
        )
        _save(folder / file, picture)
        files[f"anaglyph_{right.camera}"] = file


_POINTING: dict[Pointing, str] = {"telemetry": "telemetry's", "refined": "refined"}
_WHOLE: dict[Pointing, str] = {p: f"{_POINTING[p]} pointing" for p in POINTINGS}
"""Captions of pictures that show a whole mosaic."""


def _world_file(cylinder: Cylinder, north_deg: float | None) -> str:
    """The six lines of a world file: degrees a pixel, and azimuth and elevation of the first pixel's middle.

    Azimuths count as those of `with_axes`: clockwise from north grow to the right, anticlockwise ones fall.
    """
    step = 1 / cylinder.px_per_degree
    left = cylinder.left_deg if north_deg is None else (north_deg - cylinder.left_deg) % 360
    lines = (-step if north_deg is None else step, 0.0, 0.0, -step, left, cylinder.top_deg)
    return "".join(f"{number:.12g}\n" for number in lines)


def _place(mosaic: Mosaic) -> Json:
    p = mosaic.projection
    place: Json = {"width_px": p.width_px, "height_px": p.height_px, "origin_m": p.origin_m.tolist()}
    if isinstance(p, Cylinder):
        return place | {
            "px_per_degree": p.px_per_degree,
            "left_azimuth_deg": p.left_deg,
            "top_elevation_deg": p.top_deg,
            "closed": p.closed,
        }
    return place | {
        "m_per_px": p.m_per_px,
        "left_x_m": float(p.origin_m[0]) + p.left_m,
        "top_y_m": float(p.origin_m[1]) + p.top_m,
    }


def _brightness(made: StopMosaics) -> Json:
    evening = made.evening
    gains = {name: evening.gain.get(n) for n, name in enumerate(made.images)}
    return {"gain": gains, "vignetting": evening.vignetting.tolist(), "vignetting_sigma": evening.sigma}


def _seam_error(made: StopMosaics) -> Json:
    def medians(median_px: Callable[[Case], float]) -> Json:
        median = {case: median_px(case) for case in CASES}
        return {f"{case}_px": None if math.isnan(px) else px for case, px in median.items()}

    overlaps: list[Json] = []
    for o in made.seams.overlaps:
        counts = {"windows": o.windows, "plain": o.plain, "unlike": o.unlike, "used": len(o.azimuth_deg)}
        overlaps.append({"images": list(o.images), **counts, **medians(o.median_px)})
    return {"used": made.seams.used, **medians(made.seams.median_px), "overlaps": overlaps}


def _save(path: Path, picture: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    path.write_bytes(encoded(picture, path.suffix, _QUALITY))


def _blinks(made: StopMosaics, group: str, north_deg: float | None) -> list[Blink]:
    """The panorama, pieces of its overlaps, and the view from above."""
    blinks = [_blink_of(made.cylinder, group, "panorama", _BLINK_WIDTH_PX, north_deg)]
    for k, pieces in close_ups(made, _CLOSE_UPS):
        overlap = made.seams.overlaps[k]
        captions: dict[Pointing, str] = {
            "telemetry": f"telemetry: displaced by {overlap.median_px('telemetry'):.2f} px (median)",
            "refined": f"refined: displaced by {overlap.median_px('refined'):.2f} px (median)",
        }
        title = f"overlap of {overlap.images[0]} and {overlap.images[1]}"
        blinks.append(_blink(group, title, captions, pieces))
    cylinder = made.cylinder.projection
    if isinstance(cylinder, Cylinder) and goes_half_round(cylinder):
        discs = {
            p: polar_view(made.cylinder, p, "", _BLINK_GROUND_PX, north_deg=north_deg) for p in POINTINGS
        }
        blinks.append(_blink(group, "from above the mast, the horizon a circle", _WHOLE, discs))
    if made.ground is not None:
        blinks.append(_blink_of(made.ground, group, "from above", _BLINK_GROUND_PX, north_deg))
    return blinks


def _blink_of(mosaic: Mosaic, group: str, title: str, width_px: int, north_deg: float | None) -> Blink:
    shown = {p: with_axes(mosaic, p, "", width_px, north_deg=north_deg) for p in POINTINGS}
    return _blink(group, title, _WHOLE, shown)


def _blink(
    group: str, title: str, captions: dict[Pointing, str], pictures: dict[Pointing, NDArray[np.uint8]]
) -> Blink:
    height, width = pictures["refined"].shape[:2]
    jpeg = {p: encoded(pictures[p], ".jpg", _BLINK_QUALITY) for p in POINTINGS}
    return Blink(group=group, title=title, captions=captions, jpeg=jpeg, width_px=width, height_px=height)
