"""The mosaics of a stop as contents of files: pictures, pictures with axes, where their pixels are."""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.charts import encoded
from pancam_graph.data import Solution
from pancam_graph.mosaic._anaglyph import anaglyph, eye_pairs
from pancam_graph.mosaic._draw import close_ups, comparison, with_axes
from pancam_graph.mosaic._make import Mosaic, StopGround, StopMosaics, make_mosaics, stop_ground
from pancam_graph.mosaic._mosaic_options import MosaicOptions
from pancam_graph.mosaic._placed import POINTINGS, Pointing
from pancam_graph.mosaic._polar import goes_half_round, polar_view
from pancam_graph.mosaic._projections import Cylinder
from pancam_graph.mosaic._seam_error import CASES, Case

__all__ = ["Blink", "EyeFiles", "Json", "eye_of_arrays", "files_of_stop"]

_MAX_NAME = 40
_QUALITY = 88
_BLINK_QUALITY = 80
_BLINK_WIDTH_PX = 1500
_BLINK_GROUND_PX = 800
_CLOSE_UPS = 4

Json = dict[str, object]


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


@dataclass(kw_only=True)
class EyeFiles:
    """What the mosaics of an eye at a stop come to; without any, `warnings` say why."""

    files: dict[str, bytes] = field(default_factory=dict)
    """Contents by name."""
    entries: list[Json] = field(default_factory=list)
    """What the index says of each mosaic."""
    lines: list[str] = field(default_factory=list)
    """The seam error of the panorama, in words."""
    warnings: list[str] = field(default_factory=list)
    blinks: list[Blink] = field(default_factory=list)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything as arrays, for a cache."""
        about = [{n: v for n, v in vars(blink).items() if n != "jpeg"} for blink in self.blinks]
        said = {"entries": self.entries, "lines": self.lines, "warnings": self.warnings, "blinks": about}
        jpeg = {f"blink {k} {p}": b.jpeg[p] for k, b in enumerate(self.blinks) for p in POINTINGS}
        contents = {**{f"file {name}": content for name, content in self.files.items()}, **jpeg}
        return {
            "said": np.array(json.dumps(said)),
            "names": np.array(list(contents)),
            **{f"content_{k}": np.frombuffer(c, dtype=np.uint8) for k, c in enumerate(contents.values())},
        }


def eye_of_arrays(arrays: Mapping[str, NDArray[Any]]) -> EyeFiles:
    """The inverse of `EyeFiles.arrays`."""
    names = arrays["names"].tolist()
    contents = {name: arrays[f"content_{k}"].tobytes() for k, name in enumerate(names)}
    said = json.loads(str(arrays["said"]))
    blinks = [
        Blink(**about, jpeg={p: contents[f"blink {k} {p}"] for p in POINTINGS})
        for k, about in enumerate(said.pop("blinks"))
    ]
    files = {n.removeprefix("file "): c for n, c in contents.items() if n.startswith("file ")}
    return EyeFiles(**said, files=files, blinks=blinks)


def files_of_stop(
    solution: Solution,
    stop: int,
    eyes: Sequence[int],
    options: MosaicOptions,
    twice: Mapping[int, int],
    *,
    blinks: Callable[[Sequence[EyeFiles]], bool],
    done: Callable[[], None] | None = None,
) -> list[EyeFiles]:
    """What the mosaics of eyes at a stop come to, by row and number; `twice` is what `same_pictures` gives.

    `blinks` says, of the eyes before, whether pictures for the report are made of the next one. `done` is
    called after each eye.
    """
    traverse = solution.traverse
    north_deg = None if traverse.site is None else math.degrees(traverse.site.north_rad)
    stop_id, found = traverse.stops[stop].id, list[EyeFiles]()
    ground: StopGround | None = None
    at_stop: dict[int, tuple[StopMosaics, Json, EyeFiles]] = {}
    for eye in eyes:
        camera, own = traverse.rig.eyes[eye].name, EyeFiles()
        try:
            if ground is None:
                ground = stop_ground(solution, stop, twice)
            made = make_mosaics(solution, stop_id, camera, options, ground=ground)
        except InputError as error:
            own.warnings.append(str(error))
        else:
            name = f"{stop + 1:03d}-{eye + 1}_{_plain(stop_id)}_{_plain(camera)}"
            title = f"stop {stop_id}, camera {camera}"
            own.entries += _write(made, own.files, name, title, north_deg)
            at_stop[eye] = made, own.entries[0], own
            _write_stereo(solution, stop, eye, at_stop, ground, north_deg)
            own.lines.append(f"{title}: {_in_words(made)}")
            own.warnings += made.warnings
            if blinks(found):
                own.blinks += _blinks(made, title, north_deg)
        found.append(own)
        if done is not None:
            done()
    return found


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


def _write(
    made: StopMosaics, contents: dict[str, bytes], name: str, title: str, north_deg: float | None
) -> list[Json]:
    """Add the pictures of one eye at one stop to contents of files; returns their entries in the index."""
    entries = []
    for kind, mosaic in (("cylinder", made.cylinder), ("ground", made.ground)):
        if mosaic is None:
            continue
        files: Json = {}
        for pointing in POINTINGS:
            plain, drawn = (f"{name}_{kind}_{pointing}{end}" for end in (".png", "_axes.jpg"))
            _save(contents, plain, mosaic.pictures[pointing])
            caption = f"{title}: {_POINTING[pointing]} pointing"
            _save(contents, drawn, with_axes(mosaic, pointing, caption, north_deg=north_deg))
            files |= {pointing: plain, f"{pointing}_axes": drawn}
            if isinstance(mosaic.projection, Cylinder):
                world_file = plain.removesuffix(".png") + ".pgw"
                contents[world_file] = _world_file(mosaic.projection, north_deg).encode()
                files[f"{pointing}_world_file"] = world_file
                if goes_half_round(mosaic.projection):
                    polar = f"{name}_polar_{pointing}.jpg"
                    _save(contents, polar, polar_view(mosaic, pointing, caption, north_deg=north_deg))
                    files[f"{pointing}_polar"] = polar
            if mosaic.samples is not None:
                deep = f"{name}_{kind}_{pointing}_16bit.png"
                _save(contents, deep, mosaic.samples[pointing])
                files[f"{pointing}_16bit"] = deep
        if kind == "cylinder":
            files["comparison"] = f"{name}_comparison.jpg"
            _save(contents, f"{name}_comparison.jpg", comparison(made, title, north_deg))
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
    at_stop: dict[int, tuple[StopMosaics, Json, EyeFiles]],
    ground: StopGround,
    north_deg: float | None,
) -> None:
    """Add the stereo panoramas of an eye and those at its stop that came before it to the files of the eye.

    Each is named in the entry of its left eye's panorama.
    """
    for pair in eye_pairs(solution, stop):
        if eye not in (pair.left, pair.right) or not {pair.left, pair.right} <= at_stop.keys():
            continue
        (left, entry, _), (right, _, _) = at_stop[pair.left], at_stop[pair.right]
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
        _save(at_stop[eye][2].files, file, picture)
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


def _save(contents: dict[str, bytes], name: str, picture: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    contents[name] = encoded(picture, name[name.rindex(".") :], _QUALITY)


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
