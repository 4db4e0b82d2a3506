"""The public feed of raw images of Curiosity and Perseverance: JSON beside PNG or JPEG.

A file is the record of one picture, or a response of the service with many. Names of entries differ between
both and between the rovers by case, underscores and nesting: `mast_az`, `extended.mastAz`. Numbers may be
texts, and a vector a text in brackets. Source: a record of Perseverance (sol 670) and programs that read the
feed.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import unquote, urlsplit

import numpy as np

from pancam_graph.base.errors import CameraError, GeometryError, InputError
from pancam_graph.base.geometry import FloatArray, pose_from_wxyz
from pancam_graph.cameras import CAHV, CAHVORE_TYPES, cahv_of_vectors, cahvore_linearity
from pancam_graph.io._clock import plain_clock
from pancam_graph.io._json import any_json, read_bytes, short
from pancam_graph.io._labelled_image import LabelledImage
from pancam_graph.io._pds_rovers import rover_of
from pancam_graph.io._picture_size import WantedSize, require_size, size_of_file
from pancam_graph.io._template_cameras import pan_tilt_of_camera, template_eye
from pancam_graph.io._told_numbers import told_number
from pancam_graph.rigs import PointingSigma, camera_z_up, pose_z_up

__all__ = ["FeedRecord", "feed_image", "feed_records", "picture_of_record"]

_MODEL = "cameramodelcomponentlist"
_LETTERS = "CAHVORE"
_LISTS = ("images", "items", "photos")
"""Entries of a response that hold its records."""
_NAMES = ("filename", "link", "url", "fullres", "image", "jsonlink", "imageid")
"""Entries that name the picture: by its address, or without its ending."""
_ABOUT = PointingSigma(pan_rad=float(np.deg2rad(1.0)), tilt_rad=float(np.deg2rad(1.0)))
"""Accuracy of mast_az and mast_el, which are about where the head looks: 1 degree."""
_UNKNOWN = {"", "UNK", "NONE", "NULL", "N/A", "NA"}
_CLOCK = re.compile(r"_\d{4}_(\d{10})_(\d{3})")
"""The clock at the start of the exposure in the names of Perseverance's pictures."""
_MARS2020_NAME = re.compile(r"[A-Z0-9]{2,3}_?_\d{4}_\d{10}_\d{3}")
_BY_CAMERA = "pointing by the camera models of the feed; mast_az and mast_el are not used"
_BY_ANGLES = "pointing by mast_az and mast_el of the feed, to about a degree: no template has the camera"
_MSL_CAMERAS = ("NAV_LEFT", "NAV_RIGHT", "MAST_", "FHAZ_", "RHAZ_", "MAHLI", "MARDI", "CHEMCAM")


@dataclass(frozen=True, kw_only=True, eq=False)
class FeedRecord:
    """The record of one picture."""

    file: Path
    """The file with the record."""
    place: str
    """Where it is in the file, for errors: "" or `images[3]`."""
    entries: Mapping[str, Any]
    """Values by their names in small letters without underscores, nested objects opened."""

    @property
    def where(self) -> str:
        """File and place, for errors."""
        return f"{self.file}: {self.place}" if self.place else f"{self.file}"

    def refuse(self, entry: str, expected: str, found: object) -> NoReturn:
        """Raise InputError with file, place and entry."""
        raise InputError(
            f"{self.where}{'.' if self.place else ': '}{entry}: expected {expected}, found {found}"
        )

    def _value(self, entry: str) -> Any:
        """What the record has of an entry; None where it is missing."""
        return self.entries.get(_plain(entry))

    def text(self, entry: str) -> str:
        """An entry as text; "" where it is missing or says that it is unknown."""
        value = self._value(entry)
        text = "" if value is None or isinstance(value, dict | list) else str(value).strip()
        return "" if text.upper() in _UNKNOWN else text

    def number(self, entry: str) -> float | None:
        """An entry as a number; None where it is missing or unknown. Raises InputError for another text."""
        text = self.text(entry)
        if not text:
            return None
        number = None if isinstance(self._value(entry), bool) else told_number(text)
        if number is None:
            self.refuse(entry, "a number", short(text))
        return number

    def numbers(self, entry: str, count: int) -> list[float] | None:
        """An entry as a list of numbers; None where it is missing or unknown.

        Raises InputError for another text, and for another count.
        """
        value = self._value(entry)
        if isinstance(value, str):
            if value.strip().upper() in _UNKNOWN:
                return None
            value = value.strip().strip("()[]").split(",")
        if value is None:
            return None
        numbers = [_number(v) for v in value] if isinstance(value, list) else []
        if len(numbers) != count or None in numbers:
            self.refuse(entry, f"{count} numbers", short(self._value(entry)))
        return [float(v) for v in numbers if v is not None]


def _plain(name: object) -> str:
    """A name in small letters without underscores."""
    return str(name).replace("_", "").lower()


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        return None
    return told_number(value if isinstance(value, str) else repr(value)[:80])


def feed_records(file: Path) -> list[FeedRecord]:
    """The records in a JSON file; none for a file of another kind.

    Raises InputError for a file that is not JSON.
    """
    return list(_records(file, any_json(read_bytes(file), file), ""))


def _records(file: Path, value: object, place: str) -> Iterator[FeedRecord]:
    if isinstance(value, list):
        for row, entry in enumerate(value):
            if isinstance(entry, dict):
                yield from _records(file, entry, f"{place}[{row}]")
    elif isinstance(value, dict):
        entries = _opened(value)
        if _MODEL in entries or {"instrument", "imageid"} <= entries.keys():
            yield FeedRecord(file=file, place=place, entries=entries)
        else:
            for name in _LISTS:
                if isinstance(value.get(name), list):
                    yield from _records(file, value[name], name)


def _opened(value: Mapping[str, Any]) -> dict[str, Any]:
    """Entries by their plain names; those of nested objects, but for ones that are there already."""
    out = {_plain(key): entry for key, entry in value.items() if not isinstance(entry, dict)}
    for entry in value.values():
        if isinstance(entry, dict):
            for key, inner in entry.items():
                out.setdefault(_plain(key), inner)
    return out


def picture_of_record(record: FeedRecord, names: Mapping[str, Path]) -> Path | None:
    """The picture of a record among those of its folder, by their names in small letters; None without one.

    It is named by the record's addresses or by the file with the record, or begins with the image's id.
    """
    stems = {Path(name).stem: file for name, file in names.items()}
    told = [unquote(urlsplit(record.text(name)).path).rpartition("/")[2].lower() for name in _NAMES]
    if not record.place:
        told.append(record.file.name.lower().removesuffix(".json").removesuffix("-metadata"))
    for name in told:
        found = names.get(name) or stems.get(name) or stems.get(Path(name).stem)
        if name and found is not None:
            return found
    start = record.text("imageid").lower()
    begun = [file for stem, file in stems.items() if start and stem.startswith(start)]
    return begun[0] if len(begun) == 1 else None


def feed_image(record: FeedRecord, picture: Path) -> LabelledImage:
    """The image that a record describes.

    Its pointing is the camera model's; `mast_az` and `mast_el`, which are within about a degree, only tell
    which images were taken at one pointing. Raises InputError naming file and entry for what is missing,
    malformed or not of a mast camera, and ImageError for a picture of another size than the record says.
    """
    instrument = record.text("instrument").upper()
    host = _host(record, instrument)
    rover = rover_of(host, instrument, where=record.file, host_entry="imageid", instrument_entry="instrument")
    host = rover.named.split(",")[0]
    width_px, height_px = size_of_file(picture)
    told = record.numbers("dimension", 2)
    if told is not None:
        width, height = (int(side) for side in told)
        words = f"{width} x {height} pixels as of {record.file.name}"
        require_size(
            picture, (width_px, height_px), WantedSize(width_px=width, height_px=height, words=words)
        )
    site, drive = record.number("site"), record.number("drive")
    if site is None or drive is None or site != int(site) or drive != int(drive):
        record.refuse(
            "site, drive", "two whole numbers", f"{record.text('site')!r}, {record.text('drive')!r}"
        )
    attitude = record.numbers("attitude", 4)
    place = record.numbers("xyz", 3)
    if place is None:
        record.refuse("xyz", "the rover's place in its site, three numbers", "none")
    try:
        site_T_rover = pose_from_wxyz(attitude or [1.0, 0.0, 0.0, 0.0], place)
        model = camera_z_up(_camera_model(record, width_px, height_px))
    except (CameraError, GeometryError) as error:
        raise InputError(f"{record.where}: {error}") from error
    angles = record.number("mast_az"), record.number("mast_el")
    eye, rover_R_mast = template_eye(host, instrument), rover.mast.chain()[0].rotation().matrix()
    subframe = record.numbers("subframe_rect", 4)
    return LabelledImage(
        file=picture,
        label_file=record.file,
        host=host,
        instrument=instrument,
        serial="",
        stop=(int(site), int(drive)),
        mast=rover.mast,
        uncertainty_of=rover.uncertainty_of,
        mast_counter=None,
        clock_start=_clock(record, picture),
        first_line_sample=(1, 1) if subframe is None else (int(subframe[1]), int(subframe[0])),
        sample_bits=8,
        pan_tilt_rad=_mast_angles(record) if eye is None else pan_tilt_of_camera(model, eye, rover_R_mast),
        pointing_sigma=_ABOUT if eye is None else None,
        told_angles=() if None in angles else tuple(float(np.deg2rad(a)) for a in angles if a is not None),
        world_T_rover=pose_z_up(site_T_rover),
        model=model,
        levelled=attitude is not None,
        remark=_BY_ANGLES if eye is None else _BY_CAMERA,
    )


def _host(record: FeedRecord, instrument: str) -> str:
    told = " ".join(record.text(name) for name in _NAMES).lower()
    if instrument in {"IDC", "ICC"} or "insight" in told:
        return "INSIGHT"
    if _MARS2020_NAME.search(record.text("imageid").upper()) or "mars2020" in told:
        return "M20"
    return "MSL" if instrument.startswith(_MSL_CAMERAS) else "M20"


def _clock(record: FeedRecord, picture: Path) -> str | None:
    """The clock at the start of the exposure by the name; `sclk` is later, but the same for one exposure."""
    found = _CLOCK.search(picture.name)
    return plain_clock(
        f"{found[1]}.{found[2]}" if found else record.text("sclk") or record.text("spacecraft_clock")
    )


def _mast_angles(record: FeedRecord) -> tuple[float, float]:
    """Pan and tilt by mast_az, which is clockwise, and mast_el."""
    azimuth, elevation = record.number("mast_az"), record.number("mast_el")
    if azimuth is None or elevation is None:
        record.refuse("mast_az, mast_el", f"numbers, for no template has {record.text('instrument')}", "none")
    return float(-np.deg2rad(azimuth)), float(np.deg2rad(elevation))


def _camera_model(record: FeedRecord, width_px: int, height_px: int) -> CAHV:
    """The camera of a record, rover frame, z down: vectors, ; between them, then type and linearity."""
    entry = "camera_model_component_list"
    text = record.text(entry)
    parts = [part.strip() for part in text.split(";")] if len(text) < 4000 else []
    vectors = [_vector(part) for part in parts[:7]]
    kind = record.text("camera_model_type").upper() or {4: "CAHV", 6: "CAHVOR", 9: "CAHVORE"}.get(
        len(parts), ""
    )
    if kind not in {"CAHV", "CAHVOR", "CAHVORE"}:
        record.refuse("camera_model_type", "CAHV, CAHVOR or CAHVORE", short(kind))
    known = {letter: vector for letter, vector in zip(_LETTERS, vectors, strict=False) if vector is not None}
    if not set(kind) <= known.keys():
        record.refuse(entry, f"the vectors {';'.join(kind)}, each of three numbers in brackets", short(text))
    linearity = 1.0
    if kind == "CAHVORE":
        told = [told_number(part.strip("()")) for part in parts[7:9]]
        number, parameter = (*told, None, None)[:2]
        if number is None or number not in CAHVORE_TYPES or parameter is None:
            record.refuse(
                entry, "behind C;A;H;V;O;R;E a type of 1, 2 or 3 and a linearity", short(parts[7:9])
            )
        linearity = cahvore_linearity(int(number), parameter)
    return cahv_of_vectors(width_px, height_px, {letter: known[letter] for letter in kind}, linearity)


def _vector(part: str) -> FloatArray | None:
    numbers = [told_number(v) for v in part.strip("()[]").split(",")]
    return None if len(numbers) != 3 or None in numbers else np.array([v for v in numbers if v is not None])
