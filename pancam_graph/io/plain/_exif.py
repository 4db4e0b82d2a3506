"""EXIF of a picture: which camera took it, with which focal length, and how it was held.

Sources: EXIF 2.32 (CIPA DC-008), sections 4.5 and 4.6; APP1 of JPEG there, section 4.5.4; chunk eXIf of PNG
(W3C, third edition, 11.3.4.7).
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from pancam_graph.io._tiff_entries import ORIENTATION, TIFF_STARTS, TiffEntry, entries_at, first_entries

__all__ = ["Exif", "read_exif"]

_MAKE, _MODEL, _EXIF_DIRECTORY = 0x010F, 0x0110, 0x8769
_FOCAL_MM, _FOCAL_35MM, _PLANE_X, _PLANE_UNIT = 0x920A, 0xA405, 0xA20E, 0xA210
_WIDTH, _HEIGHT, _SERIAL = 0xA002, 0xA003, 0xA431
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""Millimetres of the unit of the focal plane's resolution."""
_MOST_ENTRIES = 1000
"""Entries of a directory beyond which it is none."""
_LARGEST = 1e6
"""Largest number that a focal length, in mm, or a resolution, per mm, may be."""


@dataclass(frozen=True, kw_only=True)
class Exif:
    """What EXIF says of a picture; None or "" where it does not, or says nonsense."""

    make: str = ""
    model: str = ""
    serial: str = ""
    """Of the camera's body."""
    orientation: int = 1
    """How the stored rows lie on a screen, 1 to 8: 1 as they are, 3 upside down, 6 to be turned clockwise by
    90 degrees, 8 anticlockwise; the others are mirrored."""
    focal_mm: float | None = None
    focal_35mm: float | None = None
    """Focal length with the same view on 36 x 24 mm, rounded to whole millimetres by cameras."""
    pixels_per_mm: float | None = None
    """On the sensor, along the rows of a picture of `size_px`."""
    size_px: tuple[int, int] | None = None
    """Width and height of the picture as the camera made it."""
    problem: str = ""
    """What is wrong with it, for a warning; "": nothing."""

    @property
    def camera(self) -> tuple[str, str, str, float | None, float | None]:
        """What pictures of one camera at one zoom have in common."""
        focal_mm = None if self.focal_mm is None else round(self.focal_mm, 3)
        return self.make, self.model, self.serial, focal_mm, self.focal_35mm


def read_exif(data: bytes) -> Exif:
    """The EXIF of a JPEG, TIFF or PNG file; an empty one of other files and where there is none.

    Nonsense is in `problem`, and never raised; no more than two directories are read.
    """
    tiff = data if data.startswith(TIFF_STARTS) else _embedded(data)
    if not tiff:
        return Exif()
    entries: dict[int, TiffEntry] = {}
    problem = ""
    try:
        entries.update(_directory(first_entries(tiff)))
        if _EXIF_DIRECTORY in entries:
            below = entries[_EXIF_DIRECTORY].numbers(tiff)
            if len(below) == 1:
                order = entries[_EXIF_DIRECTORY].order
                entries |= _directory(entries_at(tiff, below[0], order))
    except (struct.error, ValueError):
        problem = "a directory of it lies beyond the end, or has too many entries"
    return _Reader(tiff, entries, problem).exif()


def _directory(entries: Iterator[TiffEntry]) -> dict[int, TiffEntry]:
    found: dict[int, TiffEntry] = {}
    for number, entry in enumerate(entries):
        if number == _MOST_ENTRIES:
            raise ValueError
        found.setdefault(entry.tag, entry)
    return found


class _Reader:
    """Values of entries that are checked; what is wrong is collected."""

    def __init__(self, tiff: bytes, entries: dict[int, TiffEntry], problem: str) -> None:
        self._tiff = tiff
        self._entries = entries
        self._problems = [problem] if problem else []

    def exif(self) -> Exif:
        orientation = int(self._number(ORIENTATION, "Orientation", 0) or 1)
        if not 1 <= orientation <= 8:
            self._problems.append(f"Orientation is {orientation}")
            orientation = 1
        per_unit = self._number(_PLANE_X, "FocalPlaneXResolution", 0)
        unit_mm = _UNIT_MM.get(int(self._number(_PLANE_UNIT, "FocalPlaneResolutionUnit", 0) or 2))
        size = [int(self._number(tag, "the size of the picture", 0) or 0) for tag in (_WIDTH, _HEIGHT)]
        return Exif(
            make=self._text(_MAKE),
            model=self._text(_MODEL),
            serial=self._text(_SERIAL),
            orientation=orientation,
            focal_mm=self._number(_FOCAL_MM, "FocalLength", 1e-3),
            focal_35mm=self._number(_FOCAL_35MM, "FocalLengthIn35mmFilm", 1e-3),
            pixels_per_mm=None if per_unit is None or unit_mm is None else per_unit / unit_mm,
            size_px=(size[0], size[1]) if all(size) else None,
            problem="; ".join(self._problems),
        )

    def _number(self, tag: int, name: str, least: float) -> float | None:
        """A number above 0, or None: where it is missing, and where it is 0, which says "not known"."""
        entry = self._entries.get(tag)
        if entry is None:
            return None
        try:
            parts = entry.numbers(self._tiff)
        except struct.error:
            self._problems.append(f"{name} lies beyond the end")
            return None
        if len(parts) == 2 and parts[0] != 0:
            value = parts[0] / parts[1] if parts[1] else math.inf
        elif len(parts) >= 1:
            value = float(parts[0])
        else:
            self._problems.append(f"{name} is no number")
            return None
        if value == 0:
            return None
        if not least <= value <= _LARGEST:
            self._problems.append(f"{name} is {value:g}")
            return None
        return value

    def _text(self, tag: int) -> str:
        entry = self._entries.get(tag)
        try:
            return "" if entry is None else entry.text(self._tiff)
        except struct.error:
            self._problems.append("a name lies beyond the end")
            return ""


def _embedded(data: bytes) -> bytes:
    """The TIFF that EXIF of a JPEG or PNG is; b"" where there is none."""
    try:
        if data.startswith(b"\xff\xd8\xff"):
            return _in_jpeg(data)
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return _in_png(data)
    except struct.error:  # the file ends within a header
        pass
    return b""


def _in_jpeg(data: bytes) -> bytes:
    at = 2
    while data[at : at + 1] == b"\xff":
        marker, length = struct.unpack_from(">BH", data, at + 1)
        if marker in {0xDA, 0xD9}:  # pixels, end
            return b""
        content = data[at + 4 : at + 2 + length]
        if marker == 0xE1 and content.startswith(b"Exif\0") and content[6:8] in TIFF_STARTS:
            return content[6:]
        at += 2 + max(2, length)
    return b""


def _in_png(data: bytes) -> bytes:
    at = 8
    while at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if kind in {b"IDAT", b"IEND"}:  # EXIF may also come after the pixels; cameras write no PNG
            return b""
        content = data[at + 8 : at + 8 + length]
        if kind == b"eXIf" and content[:2] in TIFF_STARTS:
            return content
        at += 12 + length
    return b""
