"""PDS3 labels (ODL text) of rover images, in front of the image or in a .LBL beside it; also VICAR labels.

Only what this package needs is read: the groups of the camera model, the rover and the mast, and
the layout of the pixels. Names differ between missions; the accessors take all spellings.
Sources: PDS Standards Reference 3.8, chapters 5 and 12 (labels, pointers) and appendix C (sample
types); the camera SIS of MER, MSL and Mars 2020 (groups).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, get_args

import numpy as np

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.base.regular_files import instead_of_file, is_missing
from pancam_graph.io._image_layout import ImageLayout, Storage, require_sides
from pancam_graph.io._vicar_label import VICAR_START, vicar_entries

__all__ = ["LabelGroup", "PdsLabel", "may_have_label", "read_label"]

_MAX_LABEL_BYTES = 1 << 20
_MAX_QUOTED = 120
_STARTS = (b"PDS_VERSION_ID", b"ODL_VERSION_ID", b"CCSD3ZF")
_END = re.compile(rb"^[ \t]*END[ \t]*(?:\r|\n|\x00|\Z)", re.MULTILINE)
_MAX_PARSED = 1 << 17
"""Characters of the longest text that is parsed, which takes some seconds; labels have a quarter of it."""
_BLOCK = re.compile(r"[ \t]*(?P<end>BEGIN_|END_)?(?P<kind>GROUP|OBJECT)[ \t]*=(?P<rest>.*)")
_WANTED = re.compile(
    r"IMAGE|GEOMETRIC_CAMERA_MODEL(_PARMS)?|(ROVER|PMA|RSM|SITE)_(COORD_|COORDINATE_)SYSTEM(_PARMS)?"
    r"|(PMA|RSM)_ARTICULATION_STATE(_PARMS)?"
)
_NO_VALUE = 1e29
"""Numbers above this mean none: labels have 1e30 where telemetry has no value."""
_MAX_INTEGER = 2**63 - 1

_SAMPLE_KINDS = {
    "INTEGER": ">i",
    "MSB_INTEGER": ">i",
    "MAC_INTEGER": ">i",
    "SUN_INTEGER": ">i",
    "UNSIGNED_INTEGER": ">u",
    "MSB_UNSIGNED_INTEGER": ">u",
    "MAC_UNSIGNED_INTEGER": ">u",
    "SUN_UNSIGNED_INTEGER": ">u",
    "LSB_INTEGER": "<i",
    "PC_INTEGER": "<i",
    "VAX_INTEGER": "<i",
    "LSB_UNSIGNED_INTEGER": "<u",
    "PC_UNSIGNED_INTEGER": "<u",
    "VAX_UNSIGNED_INTEGER": "<u",
    "IEEE_REAL": ">f",
    "FLOAT": ">f",
    "REAL": ">f",
    "MAC_REAL": ">f",
    "SUN_REAL": ">f",
    "PC_REAL": "<f",
}
_BITS = {"i": (8, 16, 32), "u": (8, 16, 32), "f": (32, 64)}
"""Bits of a sample, by the kind of its type."""


@dataclass(frozen=True)
class LabelGroup:
    """A group of a label, or its top level, with errors that name file and entry."""

    where: str
    """File and group, for errors."""
    items: Mapping[str, Any]

    def _fail(self, key: str, expected: str, found: object) -> NoReturn:
        raise InputError(f"{self.where}: {key}: expected {expected}, found {found}")

    def value(self, key: str) -> Any:
        """The entry as pvl gives it. Raises InputError if it is missing."""
        if key not in self.items:
            self._fail(key, "an entry of the label", "none")
        return self.items[key]

    def text(self, key: str) -> str:
        """An entry as text, blanks stripped."""
        return self._text(key, self.value(key))

    def integer(self, key: str, default: int | None = None) -> int:
        """An integer of 0 or above."""
        if default is not None and key not in self.items:
            return default
        number = _plain(self.value(key))
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= _MAX_INTEGER:
            self._fail(key, "an integer of 0 or above", _quoted(number))
        return number

    def names(self, key: str) -> list[str]:
        """A list of words."""
        return [self._text(key, v) for v in _as_list(self.value(key))]

    def _text(self, key: str, value: Any) -> str:
        try:
            return str(_plain(value)).strip()
        except ValueError:  # Python's limit on the length of integers
            self._fail(key, "a text", _quoted(value))

    def numbers(self, key: str, count: int | None = None) -> FloatArray:
        """Finite numbers, (count,) if a count is given, units dropped (angles: see `angles_rad`)."""
        values = [_plain(v) for v in _as_list(self.value(key))]
        if count is not None and len(values) != count:
            self._fail(key, f"{count} numbers", f"{len(values)}")
        return np.array([self._number(key, v) for v in values])

    def _number(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self._fail(key, "a number", _quoted(value))
        if not abs(value) <= _NO_VALUE:  # not a number neither
            self._fail(key, "a finite number", _quoted(value))
        return float(value)

    def angles_rad(self, key: str = "ARTICULATION_DEVICE_ANGLE") -> dict[str, float]:
        """Angles by the name that the entry's _NAME list gives them; those without a value are left out.

        Raises InputError where names and angles differ in number or a unit is not one of angles.
        """
        names, entries = self.names(f"{key}_NAME"), _as_list(self.value(key))
        if len(names) != len(entries):
            self._fail(key, f"{len(names)} angles, as many as {key}_NAME has", len(entries))
        out: dict[str, float] = {}
        for name, entry in zip(names, entries, strict=True):
            unit = str(getattr(entry, "units", "rad")).lower()
            if unit not in {"rad", "radian", "radians", "deg", "degree", "degrees"}:
                self._fail(key, "radians or degrees", f"{unit!r}")
            number = _plain(entry)
            if isinstance(number, int | float) and abs(number) < _NO_VALUE:
                out[name.upper()] = float(np.deg2rad(number)) if unit.startswith("deg") else float(number)
        return out


@dataclass(frozen=True, kw_only=True)
class PdsLabel:
    """The label of one image."""

    file: Path
    """The image file."""
    label_file: Path
    """The file that the label was read from: the same, or a detached label."""
    top: LabelGroup
    """Entries outside any group."""

    def group(self, *names: str) -> LabelGroup:
        """The first group that exists of these names. Raises InputError if there is none."""
        for name in names:
            items = self.top.items.get(name)
            if isinstance(items, Mapping):
                return LabelGroup(f"{self.label_file}: {name}", items)
        raise InputError(f"{self.label_file}: expected a group {' or '.join(names)}, found none")

    def counter(self, key: str = "ROVER_MOTION_COUNTER") -> dict[str, int]:
        """The rover's motion counter by name (SITE, DRIVE, ...), names in capitals."""
        names, values = self.top.names(f"{key}_NAME"), self.top.numbers(key)
        if len(names) != len(values):
            raise InputError(f"{self.label_file}: {key}: expected {len(names)} numbers, found {len(values)}")
        return {n.upper(): int(v) for n, v in zip(names, values, strict=True)}

    def image_layout(self) -> ImageLayout:
        """Where the pixels are.

        Raises ImageError for a label without an image, or with samples that are not integers of 8, 16 or
        32 bits or reals of 32 or 64.
        """
        try:
            return self._image_layout()
        except ImageError:
            raise
        except InputError as error:
            raise ImageError(str(error)) from error

    def _image_layout(self) -> ImageLayout:
        image = self.group("IMAGE")
        file, offset = self._image_pointer()
        kind, bits = image.text("SAMPLE_TYPE").upper(), image.integer("SAMPLE_BITS")
        if kind not in _SAMPLE_KINDS or bits not in _BITS[_SAMPLE_KINDS[kind][1]]:
            raise ImageError(
                f"{image.where}: SAMPLE_TYPE, SAMPLE_BITS: expected integers of 8, 16 or 32 bits or "
                f"reals of 32 or 64, found {kind} of {bits}"
            )
        width, height, bands = (
            image.integer("LINE_SAMPLES"),
            image.integer("LINES"),
            image.integer("BANDS", 1),
        )
        require_sides(image.where, "LINES, LINE_SAMPLES, BANDS", height, width, bands)
        told = "BAND_SEQUENTIAL"
        if bands > 1 and "BAND_STORAGE_TYPE" in image.items:
            told = image.text("BAND_STORAGE_TYPE").upper().replace(" ", "_")
        storage: Storage | None = next((kind for kind in get_args(Storage) if kind == told), None)
        if storage is None:
            raise ImageError(f"{image.where}: BAND_STORAGE_TYPE: expected BAND_SEQUENTIAL, found {told}")
        return ImageLayout(
            file=file,
            offset_bytes=offset,
            width_px=width,
            height_px=height,
            bands=bands,
            # Bytes of rovers are never below 0, whatever the label calls them.
            dtype=np.dtype(f"{_SAMPLE_KINDS[kind]}{bits // 8}") if bits > 8 else np.dtype(np.uint8),
            line_prefix_bytes=image.integer("LINE_PREFIX_BYTES", 0),
            line_suffix_bytes=image.integer("LINE_SUFFIX_BYTES", 0),
            storage=storage,
        )

    def _image_pointer(self) -> tuple[Path, int]:
        # A pointer is a record (from 1), a byte (from 1, <BYTES>), a file, or a file and one of the two.
        pointer = _as_list(self.top.value("^IMAGE"))
        file = self.file
        if not pointer:
            raise ImageError(f"{self.label_file}: ^IMAGE: expected a record or a byte, found an empty list")
        if isinstance(pointer[0], str):
            file = _sibling(self.label_file, str(pointer.pop(0)))
        if not pointer:
            return file, 0
        place = _plain(pointer[0])
        whole = isinstance(place, int) and not isinstance(place, bool) and 1 <= place <= _MAX_INTEGER
        if len(pointer) > 1 or not whole:
            raise ImageError(
                f"{self.label_file}: ^IMAGE: expected a record or a byte, 1 or above, found {_quoted(place)}"
            )
        if str(getattr(pointer[0], "units", "")).upper().startswith("BYTE"):
            return file, place - 1
        return file, (place - 1) * self.top.integer("RECORD_BYTES")


def may_have_label(file: Path) -> bool:
    """Whether an image begins like one with a PDS3 label, or has a .LBL beside it."""
    if any(not is_missing(label) for label in _detached(file)):
        return True
    try:
        return _looks_like_label(_head(file))
    except InputError:
        return False


def _detached(file: Path) -> list[Path]:
    """Where the label of an image may be beside it."""
    return [file.with_suffix(s) for s in (".LBL", ".lbl", ".Lbl")]


def read_label(file: Path) -> PdsLabel:
    """Read the PDS3 label of an image: attached to it, or in a .LBL of the same name beside it.

    Raises InputError if the file is missing or neither has a label that can be parsed.
    """
    head = _head(file)
    label_file = file
    if not _looks_like_label(head):
        label_file = next((f for f in _detached(file) if not is_missing(f)), file)
        if label_file != file:
            head = _head(label_file)
        if not _looks_like_label(head):
            raise InputError(
                f"{label_file}: expected a label that starts with PDS_VERSION_ID, ODL_VERSION_ID or "
                f"LBLSIZE, found {_shown(head)}"
            )
    if head.startswith(VICAR_START):
        return PdsLabel(
            file=file, label_file=file, top=LabelGroup(str(label_file), vicar_entries(file, head))
        )
    end = _END.search(head)
    if end is None:
        raise InputError(
            f"{label_file}: expected a label that closes with the line END, found none in {len(head)} bytes"
        )
    top, groups = _split_groups(label_file, head[: end.start()].decode("latin-1"))
    items = _parsed(label_file, top)
    items |= {name: _parsed(f"{label_file}: {name}", text) for name, text in groups.items()}
    return PdsLabel(file=file, label_file=label_file, top=LabelGroup(str(label_file), items))


def _split_groups(label_file: Path, text: str) -> tuple[str, dict[str, str]]:
    """Text outside all groups and objects, and the text of each one that is used, nested ones apart.

    The parser of pvl never returns on some broken groups, and takes 0.4 s for a whole label.
    """
    top: list[str] = []
    used: dict[str, list[str]] = {}
    lines = top
    stack: list[tuple[str, list[str]]] = []
    for line in text.replace("\r", "").split("\n"):
        block = _BLOCK.fullmatch(line)
        if block is None:
            lines.append(line)
        elif block["end"] == "END_":
            name, outer = stack.pop() if stack else ("none open", top)
            if _block_name(block).upper() != name:
                found = f"END_{block['kind']} = {_block_name(block)}"
                raise InputError(f"{label_file}: expected the end of group {name}, found {found}")
            lines = outer
        else:
            name = _block_name(block).upper()
            stack.append((name, lines))
            lines = []
            if _WANTED.fullmatch(name):
                lines = used.setdefault(name, lines)
    if stack:
        raise InputError(
            f"{label_file}: expected the end of group {stack[-1][0]}, found the end of the label"
        )
    return "\n".join(top), {name: "\n".join(body) for name, body in used.items()}


def _block_name(block: re.Match[str]) -> str:
    """Name of a group or an object, without the comment behind it."""
    rest = block["rest"].strip(" \t")
    begin = rest.find("/*")
    commented = begin >= 0 and len(rest) >= begin + 4 and rest.endswith("*/")
    return rest[:begin].rstrip(" \t") if commented else rest


def _parsed(where: Path | str, text: str) -> dict[str, Any]:
    """Entries of a text without groups; the first of two entries of one name."""
    expected = f"{where}: expected entries of a PDS3 label"
    if len(text) > _MAX_PARSED:
        raise InputError(f"{expected} of at most {_MAX_PARSED} characters, found {len(text)}")
    try:
        module = _parser().parse(text + "\nEND\n")
    except RecursionError as error:
        raise InputError(f"{expected}, found brackets nested too deeply") from error
    except Exception as error:  # PVL raises many kinds at text that is no label
        first_line = _cut((str(error).strip() or type(error).__name__).splitlines()[0])
        raise InputError(f"{expected}, found text that is none: {first_line}") from error
    return dict(reversed(list(module.items())))


def _parser() -> Any:
    """A parser that accepts all dialects, but raises where the lenient parser of pvl would loop for ever.

    It leaves dates as text, as trying all formats of dates takes most of the time.
    """
    from pvl.decoder import OmniDecoder  # noqa: PLC0415  only labels need PVL
    from pvl.grammar import OmniGrammar  # noqa: PLC0415
    from pvl.parser import PVLParser  # noqa: PLC0415

    def no_date(value: str) -> NoReturn:
        raise ValueError(value)

    decoder = OmniDecoder()
    decoder.decode_datetime = no_date
    return PVLParser(grammar=OmniGrammar(), decoder=decoder)


def _head(file: Path) -> bytes:
    other = instead_of_file(file)
    if other is not None:
        raise InputError(f"{file}: expected an image file, found {other}")
    try:
        with file.open("rb") as stream:
            return stream.read(_MAX_LABEL_BYTES)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{file}: expected an image file, could not read it: {reason}") from error


def _looks_like_label(head: bytes) -> bool:
    text = re.sub(rb"\A(?:\s|/\*.*?\*/)*", b"", head[:4096], flags=re.DOTALL)
    return text.startswith(_STARTS) or head.startswith(VICAR_START)


def _shown(head: bytes) -> str:
    return repr(head[:16].decode("latin-1")) if head else "an empty file"


def _sibling(label_file: Path, name: str) -> Path:
    # A pointer names a file in the label's own folder; archives disagree about the case of its name.
    if Path(name).name != name or name in {"", ".", ".."}:
        raise ImageError(f"{label_file}: ^IMAGE: expected a file beside the label, found {_quoted(name)}")
    file = label_file.with_name(name)
    if is_missing(file):
        for other in label_file.parent.iterdir():
            if other.name.lower() == name.lower():
                return other
    return file


def _quoted(value: Any) -> str:
    """A value as error messages quote it."""
    try:
        return _cut(repr(value))
    except ValueError:  # Python's limit on the length of integers
        return "an integer of too many digits"


def _cut(text: str) -> str:
    return text if len(text) <= _MAX_QUOTED else f"{text[:_MAX_QUOTED]}..."


def _plain(value: Any) -> Any:
    return getattr(value, "value", value) if hasattr(value, "units") else value


def _as_list(value: Any) -> list[Any]:
    if isinstance(value, Sequence) and not isinstance(value, str) and not hasattr(value, "units"):
        return list(value)
    return [value]
