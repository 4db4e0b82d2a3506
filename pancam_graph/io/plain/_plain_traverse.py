"""From a folder of plain pictures to a traverse."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.text import visible
from pancam_graph.data import VAGUE_RAD, Traverse
from pancam_graph.io.plain._eyes import RiggedPictures, told_rig
from pancam_graph.io.plain._find_pictures import find_pictures
from pancam_graph.io.plain._frames import frames_of
from pancam_graph.io.plain._made_rig import made_rig
from pancam_graph.io.plain._options import PlainOptions
from pancam_graph.io.plain._pointing import Pointed, read_pointing, unpointed
from pancam_graph.io.plain._stops import stops_of
from pancam_graph.rigs import PointingSigma

__all__ = ["PlainTraverse", "plain_traverse"]

_FEWEST_PANS = 4
"""Different pans from which a small span of them is odd."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlainTraverse:
    """A traverse of plain pictures, and where its numbers come from."""

    traverse: Traverse
    """Without observations; its warnings say what was left out."""
    sources: tuple[str, ...]
    """A sentence about the source of each kind of numbers, for who wants to change them."""


def plain_traverse(folder: Path | str, options: PlainOptions) -> PlainTraverse:
    """The traverse of plain pictures in a folder, or in folders below it, with what is told of them.

    Only headers of pictures are read. Pointing that is not told is 0, with sigmas of `data.UNKNOWN_RAD`. Pan
    and tilt of the table become those of the package's conventions; a single stop is the world's origin.
    Pictures that do not fit are left out with a warning.

    Raises InputError with one sentence naming file, line or option: for tables and rigs that are malformed,
    and if no picture is left.
    """
    folder = Path(folder)
    _require_sense(options)
    told = [path for path in (options.pointing, options.stops) if path is not None]
    if options.rig is not None:
        told.append(Path(options.rig))
    pictures, warnings = find_pictures(folder, told)
    table = options.pointing or folder
    if options.pointing is None:
        pointed = unpointed(pictures)
    else:
        pointed, more = read_pointing(table, folder, pictures, clockwise=options.clockwise)
        warnings += more
    if options.rig is None:
        rigged = made_rig(pointed, options, table, guessed=all(_is_vague(row, options) for row in pointed))
    else:
        rigged = told_rig(pointed, options.rig, table)
    usual = rigged.rig.pointing_sigma
    if options.sigma_rad is not None:
        usual = replace(usual, pan_rad=options.sigma_rad, tilt_rad=options.sigma_rad)
    frames, images = frames_of(rigged.pictures, usual, table)
    names = list(dict.fromkeys(frame.stop for frame in frames))
    stops, more = stops_of(names, options.stops, folder, clockwise=options.clockwise)
    traverse = Traverse(
        name=visible(folder.resolve().name),
        rig=rigged.rig,
        stops=stops,
        frames=frames,
        images=images,
        folder=folder,
        warnings=(*warnings, *rigged.warnings, *more, *_small_turns(rigged, table)),
    )
    return PlainTraverse(traverse=traverse, sources=(*rigged.sources, *_pointing_sources(options, usual)))


def _is_vague(row: Pointed, options: PlainOptions) -> bool:
    """Whether a picture is pointed so badly that pictures are to tell it."""
    if row.pan_rad is None:
        return True
    sigmas = [row.sigma_pan_rad, row.sigma_tilt_rad]
    return max(options.sigma_rad or 0.0 if sigma is None else sigma for sigma in sigmas) > VAGUE_RAD


def _require_sense(options: PlainOptions) -> None:
    """Raise InputError for options that contradict each other, and for numbers that make no sense."""
    made = {
        "--focal-px": options.focal_px,
        "--field-deg": options.field_rad,
        "--focal-sigma": options.focal_sigma,
        "--arms": options.arms_m,
        "--arms-sigma": options.arms_sigma_m,
    }
    given = [name for name, value in made.items() if value is not None]
    if options.rig is not None and given:
        raise InputError(f"expected --rig or {given[0]}, found both: a rig has its own numbers")
    if options.focal_px is not None and options.field_rad is not None:
        raise InputError("expected --focal-px or --field-deg, found both")
    sigmas = {
        "--sigma-deg": options.sigma_rad,
        "--focal-sigma": options.focal_sigma,
        "--arms-sigma": options.arms_sigma_m,
    }
    for name, sigma in sigmas.items():
        if sigma is not None and not (np.isfinite(sigma) and sigma >= 0):
            raise InputError(f"{name}: expected 0 (exact) or a positive number, found {sigma:g}")


def _small_turns(rigged: RiggedPictures, table: Path) -> tuple[str, ...]:
    """A warning where the pans of a table look like radians: many, and all within a bit of one picture."""
    pans_rad = [row.pan_rad for row, _ in rigged.pictures if row.pan_rad is not None]
    if len(set(pans_rad)) < _FEWEST_PANS:
        return ()
    camera = rigged.rig.eyes[0].camera.pinhole
    field_rad = 2 * np.arctan(0.5 * camera.width_px / camera.fx_px)
    span_rad = max(pans_rad) - min(pans_rad)
    if np.rad2deg(span_rad) > 2 * np.pi or span_rad > field_rad / 4:
        return ()
    return (
        f"{table}: pans span {np.rad2deg(span_rad):.3g} degrees, where a picture has "
        f"{np.rad2deg(field_rad):.3g}; degrees are expected: are these radians?",
    )


def _pointing_sources(options: PlainOptions, usual: PointingSigma) -> tuple[str, ...]:
    sense = "clockwise seen from above, turned to anticlockwise" if options.clockwise else "anticlockwise"
    pan_deg, tilt_deg = np.rad2deg([usual.pan_rad, usual.tilt_rad])
    places = "the single stop is the origin of the world"
    if options.stops is not None:
        places = f"places of stops by {options.stops}, the first held unless its sigmas are told"
    if options.pointing is None:
        return (places,)
    return (
        f"pointing: by {options.pointing}, pans {sense}; where it tells no sigmas, {pan_deg:.3g} degrees of "
        f"pan and {tilt_deg:.3g} of tilt",
        places,
    )
