"""Tie points of marsnav: `.tpt`, XML or the older text.

Source: what VICAR's programs write and read (mars_save_tiepoints, mars_load_tiepoints). Pixels count from 0
at the centre of the first; line is the row, samp the column.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from xml.sax.saxutils import quoteattr

from pancam_graph.base.errors import InputError
from pancam_graph.io._json import read_bytes, short
from pancam_graph.io._told_numbers import told_number
from pancam_graph.io._xml import XmlElement, read_xml

__all__ = [
    "MOST_BYTES",
    "PAIR_TYPES",
    "TIE_TYPES",
    "AdjustedTie",
    "ReferenceFrame",
    "Tie",
    "TieFile",
    "read_ties",
    "tie_text",
    "tie_xml",
]

TIE_TYPES = {
    0: "picture to picture",
    1: "fiducial",
    2: "one-dimensional",
    3: "infinity",
    4: "orbital XY",
    5: "orbital XYZ",
    6: "azimuth",
    7: "elevation",
    8: "Z surface",
    9: "dynamic XYZ",
    10: "miss distance",
}
"""Types of ties, by marsnav's numbers."""
PAIR_TYPES = frozenset({0, 2, 3, 8, 9, 10})
"""Types that join two pictures; the others have the left one alone."""
_XYZ = {1: "xyz", 4: "xy", 5: "xyz", 8: "z"}
"""The coordinates of a type, which are also the name of its element."""
_ANGLE = {2: "angle", 6: "azimuth", 7: "elevation"}
_TEXT_V2, _TEXT_V1 = "mars_tiepoint_list v2", "mpfnav_tiepoints_list"
_MAX_TIES = 500_000
MOST_BYTES = 1 << 28
"""Largest file that is read."""
_RESIDUALS = ("left_init_residual", "left_final_residual", "right_init_residual", "right_final_residual")


@dataclass(frozen=True, kw_only=True)
class ReferenceFrame:
    """A coordinate frame of VICAR: its name, and the counters that say which one of this name."""

    name: str
    index: tuple[int, ...] = ()

    def attributes(self) -> str:
        """The attributes of an element, with a blank in front of each."""
        indices = "".join(f' index{n}="{i}"' for n, i in enumerate(self.index, 1))
        return f" name={quoteattr(self.name)}{indices}"


@dataclass(frozen=True, kw_only=True)
class AdjustedTie:
    """A tie before and after an adjustment."""

    residuals: tuple[tuple[float, float], ...]
    """Samples and lines by which projections miss the marks: left before, left after, right before, right
    after."""
    init_miss_m: float
    """Distance at which the lines of sight pass each other before."""
    final_miss_m: float
    init_xyz: tuple[float, float, float]
    """Where they are nearest to each other before; in the set's frame, metres."""
    final_xyz: tuple[float, float, float]
    """The adjusted point."""


@dataclass(frozen=True, kw_only=True)
class Tie:
    """One tie point."""

    type: int
    left: int
    """Key of the left image."""
    left_uv: tuple[float, float]
    """Sample and line in the left image."""
    right: int | None = None
    """Key of the right image; None for types of one image."""
    right_uv: tuple[float, float] | None = None
    """Sample and line where the point was found in the right image."""
    projected_uv: tuple[float, float] | None = None
    """Sample and line where the program had expected it."""
    xyz: tuple[float | None, float | None, float | None] | None = None
    """Coordinates in the set's frame, metres, as far as the type has them."""
    angle_deg: float | None = None
    """Of types 2 (of the line on which it may slide, anticlockwise from samples), 6 and 7."""
    quality: float = 1.0
    """0 to 1; a correlation where a program found the tie."""
    interactive: bool = False
    """Whether a person made it."""
    track: int | None = None
    """Number that ties of one point share; None: not told."""
    adjusted: AdjustedTie | None = None
    """What an adjustment made of it; written only."""
    frame: ReferenceFrame | None = None
    """Frame of coordinates and angles; None: the file names none."""
    where: str = ""
    """Its place in the file, for error messages."""


@dataclass(frozen=True, kw_only=True)
class TieFile:
    """A file of tie points."""

    images: dict[int, str | None]
    """Unique id of each image by its key; None in the older text, which counts images only."""
    ties: tuple[Tie, ...]
    frames: tuple[ReferenceFrame, ...] = field(default=())
    """Frames that sets of the file are in."""


def read_ties(path: Path) -> TieFile:
    """Read a `.tpt`. Raises InputError naming file, tie and entry for what is missing or malformed."""
    start = read_bytes(path)[:200].lstrip()
    if start.startswith((_TEXT_V2.encode(), _TEXT_V1.encode())):
        return _of_text(path)
    root = read_xml(path, "an XML file of tie points", MOST_BYTES)
    if root.name != "tiepoint_file":
        raise InputError(f"{path}: expected a file of tie points (tiepoint_file), found {root.name[:60]!r}")
    keys: dict[str, int] = {}
    images: dict[int, str | None] = {}
    ties: list[Tie] = []
    frames: list[ReferenceFrame] = []
    for number, group in enumerate(root.every("tiepoint_set")):
        frame = _frame(group)
        if frame is not None and frame not in frames:
            frames.append(frame)
        of_set: dict[int, int] = {}
        for image in group.required("images").every("image"):
            unique_id = image.attributes.get("unique_id", "").strip()
            if not unique_id:
                image.refuse("a unique_id", "none")
            # A second set may number the same images otherwise; one number serves all of an image.
            key = keys.setdefault(unique_id.lower(), len(keys))
            images.setdefault(key, unique_id)
            told = _whole(image, "key", "image")
            if of_set.setdefault(told, key) != key:
                image.refuse("a key of its own", f"{told}, which another image has")
        for n, element in enumerate(group.required("tiepoints").every("tie")):
            where = f"tie {n}" if number == 0 else f"set {number}, tie {n}"
            ties.append(_tie(element, of_set, frame, where))
            if len(ties) > _MAX_TIES:
                raise InputError(f"{path}: expected at most {_MAX_TIES} ties, found more")
    if not ties:
        raise InputError(f"{path}: expected at least one tie, found none")
    return TieFile(images=images, ties=tuple(ties), frames=tuple(frames))


def _frame(group: XmlElement) -> ReferenceFrame | None:
    found = next((c for c in group.children if c.name == "reference_frame"), None)
    name = "" if found is None else found.attributes.get("name", "").strip()
    if found is None or not name:
        return None
    index: list[int] = []
    while f"index{len(index) + 1}" in found.attributes:
        index.append(_whole(found, f"index{len(index) + 1}", "reference_frame"))
    return ReferenceFrame(name=name, index=tuple(index))


def _tie(element: XmlElement, of_set: dict[int, int], frame: ReferenceFrame | None, where: str) -> Tie:
    kind = _whole(element, "type", where)
    if kind not in TIE_TYPES:
        _refuse(element, where, "type", f"0 to {max(TIE_TYPES)}", kind)
    is_pair = kind in PAIR_TYPES
    flags = element.first("flags")
    track = element.first("track")
    return Tie(
        type=kind,
        left=_key(element, "left_key", of_set, where),
        left_uv=_pixel(element, "left", where),
        right=_key(element, "right_key", of_set, where) if is_pair else None,
        right_uv=_pixel(element, "right", where) if is_pair else None,
        projected_uv=_pixel(element, "projected", where) if element.first("projected") is not None else None,
        xyz=_coordinates(element, _XYZ[kind], where) if kind in _XYZ else None,
        angle_deg=_number(_child(element, _ANGLE[kind], where), "degrees", where) if kind in _ANGLE else None,
        quality=1.0 if flags is None else _number(flags, "quality", where, 1.0),
        interactive=False if flags is None else _number(flags, "interactive", where, 0.0) != 0,
        track=None if track is None else _whole(track, "id", where),
        frame=frame,
        where=where,
    )


def _key(element: XmlElement, name: str, of_set: dict[int, int], where: str) -> int:
    key = _whole(element, name, where)
    if key not in of_set:
        _refuse(element, where, name, "the key of an image", key)
    return of_set[key]


def _pixel(element: XmlElement, name: str, where: str) -> tuple[float, float]:
    child = _child(element, name, where)
    return _number(child, "samp", where), _number(child, "line", where)


def _coordinates(
    element: XmlElement, name: str, where: str
) -> tuple[float | None, float | None, float | None]:
    child = _child(element, name, where)
    x, y, z = (_number(child, axis, where) if axis in name else None for axis in "xyz")
    return x, y, z


def _child(element: XmlElement, name: str, where: str) -> XmlElement:
    found = next((c for c in element.children if c.name == name), None)
    if found is None:
        raise InputError(f"{element.file}: {where}: expected an element {name}, found none")
    return found


def _number(element: XmlElement, name: str, where: str, default: float | None = None) -> float:
    text = element.attributes.get(name, "")
    if not text.strip() and default is not None:
        return default
    number = told_number(text)
    if number is None:
        _refuse(element, where, f"{element.name} {name}", "a number", repr(text[:60]))
    return number


def _whole(element: XmlElement, name: str, where: str) -> int:
    text = element.attributes.get(name, "")
    number = told_number(text)
    if number is None or number != int(number) or not -(1 << 31) <= number < 1 << 53:
        _refuse(element, where, name, "a whole number", repr(text[:60]))
    return int(number)


def _refuse(element: XmlElement, where: str, name: str, expected: str, found: object) -> NoReturn:
    raise InputError(f"{element.file}: {where}: {name}: expected {expected}, found {found}")


def _of_text(path: Path) -> TieFile:
    """The older text: a header, a count, a line a tie; version 1 has a reference image before the count."""
    try:
        lines = read_bytes(path).decode("ascii").strip().splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected text, found other bytes at {error.start}") from error
    is_old = lines[0].strip().startswith(_TEXT_V1)
    head = 3 if is_old else 2
    count = told_number(lines[head - 1]) if len(lines) >= head else None
    if count is None or count != len(lines) - head or not 0 < count <= _MAX_TIES:
        raise InputError(
            f"{path}: line {head}: expected the number of ties, {max(len(lines) - head, 0)} of them, "
            f"found {short(lines[head - 1]) if len(lines) >= head else 'none'}"
        )
    width = 9 if is_old else 10
    ties, images = [], dict[int, str | None]()
    for n, line in enumerate(lines[head:]):
        words = [told_number(word) for word in line.split()]
        numbers = [word for word in words if word is not None]
        keys = [int(k) for k in numbers[:2] if k == int(k) and 0 <= k < 1 << 31]
        if len(numbers) != len(words) or len(words) != width or len(keys) != 2:
            raise InputError(
                f"{path}: line {n + head + 1}: expected two images from 0 on and {width - 2} numbers, "
                f"found {short(line)}"
            )
        images |= dict.fromkeys(keys)
        _, _, left_s, left_l, projected_s, projected_l, right_s, right_l, quality = numbers[:9]
        ties.append(
            Tie(
                type=0,
                left=keys[0],
                left_uv=(left_s, left_l),
                right=keys[1],
                right_uv=(right_s, right_l),
                projected_uv=(projected_s, projected_l),
                quality=quality,
                interactive=quality == 1.0 if is_old else numbers[9] != 0,
                where=f"line {n + head + 1}",
            )
        )
    return TieFile(images=images, ties=tuple(ties))


def tie_xml(file: TieFile) -> str:
    """The content of a `.tpt`: one set a frame. Numbers have all their digits."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<tiepoint_file version="1.0">']
    for frame in file.frames or (None,):
        ties = [tie for tie in file.ties if tie.frame == frame]
        lines.append("<tiepoint_set>")
        if frame is not None:
            lines.append(f"  <reference_frame{frame.attributes()}/>")
        lines.append("  <images>")
        lines += [
            f'    <image unique_id={quoteattr(str(name))} key="{key}"/>' for key, name in file.images.items()
        ]
        lines += ["  </images>", "  <tiepoints>"]
        for tie in ties:
            lines += _tie_lines(tie)
        lines += ["  </tiepoints>", "</tiepoint_set>"]
    return "\n".join([*lines, "</tiepoint_file>", ""])


def _tie_lines(tie: Tie) -> list[str]:
    right = f' right_key="{tie.right}"' if tie.right is not None else ""
    lines = [f'    <tie type="{tie.type}" left_key="{tie.left}"{right}>', _pixel_line("left", tie.left_uv)]
    if tie.right_uv is not None:
        lines.append(_pixel_line("projected", tie.projected_uv or tie.right_uv))
        lines.append(_pixel_line("right", tie.right_uv))
    if tie.type in _XYZ and tie.xyz is not None:
        name = _XYZ[tie.type]
        told = [(a, v) for a, v in zip("xyz", tie.xyz, strict=True) if a in name and v is not None]
        lines.append(f"      <{name}{_attributes(told)}/>")
    if tie.type in _ANGLE:
        lines.append(f'      <{_ANGLE[tie.type]} degrees="{float(tie.angle_deg or 0.0)!r}"/>')
    if tie.adjusted is not None:
        found = tie.adjusted
        lines += [_pixel_line(n, uv) for n, uv in zip(_RESIDUALS, found.residuals, strict=True)]
        lines.append(f'      <init_miss dist="{found.init_miss_m!r}"/>')
        lines.append(f'      <final_miss dist="{found.final_miss_m!r}"/>')
        for name, xyz in (("init_xyz", found.init_xyz), ("final_xyz", found.final_xyz)):
            lines.append(f"      <{name}{_attributes(zip('xyz', xyz, strict=True))}/>")
    if tie.track is not None:
        lines.append(f'      <track id="{tie.track}"/>')
    lines.append(f'      <flags quality="{tie.quality!r}" interactive="{int(tie.interactive)}"/>')
    return [*lines, "    </tie>"]


def _attributes(numbers: Iterable[tuple[str, float]]) -> str:
    return "".join(f' {name}="{float(value)!r}"' for name, value in numbers)


def _pixel_line(name: str, uv: tuple[float, float]) -> str:
    return f'      <{name} line="{float(uv[1])!r}" samp="{float(uv[0])!r}"/>'


def tie_text(ties: Sequence[Tie]) -> str:
    """The content of an older `.tpt`; keys are numbers of images from 0 on. Of pairs of pictures only."""
    lines = [_TEXT_V2, str(len(ties))]
    for tie in ties:
        assert tie.right_uv is not None  # ties of pairs
        words = [*tie.left_uv, *(tie.projected_uv or tie.right_uv), *tie.right_uv, tie.quality]
        numbers = " ".join(repr(float(w)) for w in words)
        lines.append(f"{tie.left} {tie.right} {numbers} {int(tie.interactive)}")
    return "\n".join([*lines, ""])
