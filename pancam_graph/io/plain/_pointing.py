"""The table of pointing: where the head pointed in each picture."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pancam_graph.base.choices import nearest, some_of
from pancam_graph.base.errors import InputError
from pancam_graph.io._json import prefixed, short
from pancam_graph.io.plain._find_pictures import PlainPicture
from pancam_graph.io.plain._options import POINTING_COLUMNS
from pancam_graph.io.plain._table_cells import Row, read_rows

__all__ = ["Pointed", "read_pointing", "unpointed"]

_POINTING = ("pan_deg", "tilt_deg")
_OPTIONAL = "sigma_pan_deg, sigma_tilt_deg, camera, frame, stop"
_MOST_PAN_DEG = 3600.0
_MOST_TILT_DEG = 180.0
_NAMED = 5
SINGLE_STOP = "stop"
"""Id of the stop of pictures that lie in the folder itself."""


@dataclass(frozen=True, kw_only=True)
class Pointed:
    """A picture with its pointing."""

    picture: PlainPicture
    line: int
    """Of the table; without one, a number."""
    pan_rad: float | None
    """Anticlockwise seen from above; None: not known."""
    tilt_rad: float | None
    sigma_pan_rad: float | None
    """None: not told."""
    sigma_tilt_rad: float | None
    camera: str | None
    """Name of the eye, if it is told."""
    frame: str | None
    """Name of the pointing, if it is told."""
    stop: str


def read_pointing(
    path: Path, folder: Path, pictures: Mapping[str, PlainPicture], *, clockwise: bool
) -> tuple[list[Pointed], list[str]]:
    """Pictures in the order of the table, and warnings.

    Columns or cells of pan and tilt that are empty together are of a pointing that is not known. Files of
    which there is no picture, and pictures without a row, are warned of and left out.

    Raises InputError naming file, column and line for what is no table of pointing, a file that stands
    twice, and if no picture is left.
    """
    rows, warnings = read_rows(path, POINTING_COLUMNS, _OPTIONAL, none_or_all=_POINTING)
    pointed: dict[str, Pointed] = {}
    unknown: list[str] = []
    with prefixed(path):
        for row in rows:
            name = _picture_named(row, folder, pictures)
            if name not in pictures:
                near = nearest(name, pictures)
                unknown.append(f"{row.place('file')}: {folder} has no picture {name!r}{near}")
                continue
            if name in pointed:
                raise InputError(
                    f"{row.place('file')}: expected each file once, found {name!r} in line "
                    f"{pointed[name].line} too"
                )
            pointed[name] = _pointed(row, pictures[name], clockwise=clockwise)
        if not pointed:
            raise InputError(f"expected the pictures of the folder, found others; {unknown[0]}")
    warnings += [f"{path}: {sentence}; left out" for sentence in unknown[:_NAMED]]
    if len(unknown) > _NAMED:
        warnings.append(f"{path}: {len(unknown) - _NAMED} more lines of which there is no picture")
    missing = [name for name in pictures if name not in pointed]
    if missing:
        warnings.append(f"pictures without a line in {path} are left out: {some_of(missing)}")
    return list(pointed.values()), warnings


def _picture_named(row: Row, folder: Path, pictures: Mapping[str, PlainPicture]) -> str:
    """The picture that a row means: by its path in the folder, else by its name where that is one's alone."""
    text = row.text("file")
    if text is None:
        raise InputError(f"{row.place('file')}: expected the name of a picture, found an empty cell")
    name = text.replace("\\", "/").removeprefix("./")
    if name in pictures:
        return name
    alike = [other for other in pictures if other.endswith(f"/{name}")]
    if len(alike) > 1:
        raise InputError(
            f"{row.place('file')}: expected a path inside {folder}, found {short(text)}, which may be "
            f"{some_of(alike)}"
        )
    return alike[0] if alike else name


def _pointed(row: Row, picture: PlainPicture, *, clockwise: bool) -> Pointed:
    pan_rad = tilt_rad = None
    if any(name in row.cells for name in _POINTING):
        pan_rad = float(np.deg2rad(row.number("pan_deg", -_MOST_PAN_DEG, _MOST_PAN_DEG)))
        tilt_rad = float(np.deg2rad(row.number("tilt_deg", -_MOST_TILT_DEG, _MOST_TILT_DEG)))
    sigmas = [row.number_or_none(f"sigma_{joint}_deg", 0, _MOST_TILT_DEG) for joint in ("pan", "tilt")]
    sigma_pan_rad, sigma_tilt_rad = (None if s is None else float(np.deg2rad(s)) for s in sigmas)
    return Pointed(
        picture=picture,
        line=row.line,
        pan_rad=-pan_rad if clockwise and pan_rad is not None else pan_rad,
        tilt_rad=tilt_rad,
        sigma_pan_rad=sigma_pan_rad,
        sigma_tilt_rad=sigma_tilt_rad,
        camera=row.text("camera"),
        frame=row.text("frame"),
        stop=row.text("stop") or _folder_stop(picture),
    )


def _folder_stop(picture: PlainPicture) -> str:
    above, _, below = picture.file.partition("/")
    return above if below else SINGLE_STOP


def unpointed(pictures: Mapping[str, PlainPicture]) -> list[Pointed]:
    """All pictures of a folder, of which no pointing is known."""
    return [
        Pointed(
            picture=picture,
            line=number,
            pan_rad=None,
            tilt_rad=None,
            sigma_pan_rad=None,
            sigma_tilt_rad=None,
            camera=None,
            frame=None,
            stop=_folder_stop(picture),
        )
        for number, picture in enumerate(pictures.values(), 1)
    ]
