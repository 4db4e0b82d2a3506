"""Pointing corrections of marsnav: `.nav`, XML or text.

Source: what marsnav writes (save_pointing_xml, save_pointing_file). Angles are readings of the mast's joints,
degrees; azimuths count clockwise from above.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn
from xml.sax.saxutils import quoteattr

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHV, CAHVORE
from pancam_graph.io._json import read_bytes, short
from pancam_graph.io._told_numbers import told_number
from pancam_graph.io._xml import XmlElement, read_xml
from pancam_graph.io.vicar._identity import PictureIdentity
from pancam_graph.io.vicar._tie_file import MOST_BYTES, ReferenceFrame

__all__ = ["NavEntry", "NavFile", "nav_text", "nav_xml", "read_nav"]

_HEADER = "marsnav pointing corrections file"
_MAX_ENTRIES = 100_000


@dataclass(frozen=True, kw_only=True)
class NavEntry:
    """The pointing of one image."""

    unique_id: str | None
    """None in text, whose lines follow the order of the images."""
    original_deg: tuple[float, ...]
    """Readings before: azimuth, elevation and, of pointing models with three numbers, twist."""
    pointing_deg: tuple[float, ...]
    """Readings as corrected."""
    solution_id: str = ""
    where: str = ""
    """Its place in the file, for error messages."""
    identity: PictureIdentity | None = None
    """Who the image is; written only."""
    models: tuple[CAHV, CAHV] | None = None
    """Its camera before and after, in `models_in`; written only."""
    models_in: ReferenceFrame | None = None


@dataclass(frozen=True, kw_only=True)
class NavFile:
    """A file of pointing corrections: of each image that of the highest priority."""

    entries: tuple[NavEntry, ...]


def read_nav(path: Path) -> NavFile:
    """Read a `.nav`: XML, text with a header, or the text of mpfnav, which has none.

    Of several solutions of an image that of the highest priority counts (priorities are listed lowest first;
    those that are not listed come before all), of equal ones the last. Raises InputError naming file and
    entry for what is missing or malformed.
    """
    content = read_bytes(path)
    if not content.lstrip().removeprefix(b"\xef\xbb\xbf").startswith(b"<"):
        return _of_text(path, content)
    root = read_xml(path, "an XML file of pointing corrections", MOST_BYTES)
    if root.name != "pointing_correction":
        raise InputError(
            f"{path}: expected a file of pointing corrections (pointing_correction), found {root.name[:60]!r}"
        )
    listed = [entry.attributes.get("solution_id", "") for entry in root.every("entry")]
    rank = {name: place for place, name in enumerate(listed)}
    best: dict[str, NavEntry] = {}
    for number, solution in enumerate(root.every("solution")):
        entry = _entry(solution, f"solution {number}")
        key = str(entry.unique_id).lower()
        if key not in best or rank.get(entry.solution_id, -1) >= rank.get(best[key].solution_id, -1):
            best[key] = entry
        if number >= _MAX_ENTRIES:
            raise InputError(f"{path}: expected at most {_MAX_ENTRIES} solutions, found more")
    if not best:
        raise InputError(f"{path}: expected at least one solution, found none")
    return NavFile(entries=tuple(best.values()))


def _entry(solution: XmlElement, where: str) -> NavEntry:
    image = solution.first("image")
    if image is None:
        raise InputError(f"{solution.file}: {where}: expected an element image, found none")
    unique_id = image.attributes.get("unique_id", "").strip()
    if not unique_id:
        _refuse(solution, where, "image", "a unique_id", "none")
    original = image.first("original_parameters")
    corrected = next((c for c in solution.children if c.name == "pointing_parameters"), None)
    if corrected is None:
        raise InputError(f"{solution.file}: {where}: expected an element pointing_parameters, found none")
    pointing = _readings(corrected, where)
    return NavEntry(
        unique_id=unique_id,
        original_deg=pointing if original is None else _readings(original, where),
        pointing_deg=pointing,
        solution_id=solution.attributes.get("solution_id", ""),
        where=where,
    )


def _readings(parameters: XmlElement, where: str) -> tuple[float, ...]:
    """Azimuth and elevation, by the ends of their names, then the other numbers."""
    numbers: dict[str, float] = {}
    for parameter in parameters.children:
        name = parameter.attributes.get("id", "").strip().lower()
        text = parameter.attributes.get("value", "")
        number = told_number(text)
        if number is None:
            _refuse(
                parameters, where, f"{parameters.name} {name[:30]}", "a number of degrees", repr(text[:60])
            )
        numbers[name] = number
    found = []
    for wanted in ("azimuth", "elevation"):
        key = next((n for n in numbers if n.split()[-1:] == [wanted]), None)
        if key is None:
            _refuse(
                parameters, where, parameters.name, f"a parameter {wanted}", ", ".join(numbers)[:60] or "none"
            )
        found.append(numbers.pop(key))
    return (*found, *numbers.values())


def _refuse(element: XmlElement, where: str, name: str, expected: str, found: object) -> NoReturn:
    raise InputError(f"{element.file}: {where}: {name}: expected {expected}, found {found}")


def _of_text(path: Path, content: bytes) -> NavFile:
    """A header, then a line an image: how many angles, so many before, so many after.

    Without a header four numbers a line.
    """
    try:
        lines = content.decode("ascii").strip().splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected text or XML, found other bytes at {error.start}") from error
    has_header = bool(lines) and lines[0].strip().startswith(_HEADER)
    entries = []
    for n, line in enumerate(lines[has_header:], 1 + has_header):
        told = [told_number(word) for word in line.split()]
        numbers = [number for number in told if number is not None]
        count = numbers.pop(0) if has_header and numbers else 2.0
        if len(numbers) + has_header != len(told) or count not in {2.0, 3.0} or len(numbers) != 2 * count:
            expected = "2 or 3, then so many angles before and after" if has_header else "four angles"
            raise InputError(f"{path}: line {n}: expected {expected}, found {short(line)}")
        half = int(count)
        entries.append(
            NavEntry(
                unique_id=None,
                original_deg=tuple(numbers[:half]),
                pointing_deg=tuple(numbers[half:]),
                where=f"line {n}",
            )
        )
    if not entries or len(entries) > _MAX_ENTRIES:
        raise InputError(f"{path}: expected 1 to {_MAX_ENTRIES} lines of pointing, found {len(entries)}")
    return NavFile(entries=tuple(entries))


def nav_text(entries: Iterable[NavEntry]) -> str:
    """The content of a `.nav` as text. Numbers have nine digits behind the point, a nanodegree."""
    lines = [f"{_HEADER}, version 1"]
    for entry in entries:
        numbers = " ".join(f"{n:.9f}" for n in (*entry.original_deg, *entry.pointing_deg))
        lines.append(f"{len(entry.pointing_deg)} {numbers}")
    return "\n".join([*lines, ""])


def nav_xml(
    entries: Iterable[NavEntry],
    *,
    mission: str,
    solution_id: str,
    ground: FloatArray | None,
    ground_in: ReferenceFrame,
) -> str:
    """The content of a `.nav` as XML, numbers with all their digits.

    `ground` (2, 3) is a point of the ground and its normal, in the frame `ground_in`; None: not known.
    """
    named = quoteattr(solution_id)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f"<pointing_correction mission={quoteattr(mission)}>",
        f'  <origination id={named} institution="" program="pancam_graph">',
        "    <purpose>Pointing and cameras of a bundle adjustment</purpose>",
        "  </origination>",
        "  <priority>",
        f"    <entry solution_id={named}/>",
        "  </priority>",
    ]
    for entry in entries:
        who = entry.identity
        assert who is not None  # a writer knows
        names = (*who.pointing_names, "Twist")
        lines.append(f'  <solution index1="{who.place[0]}" index2="{who.place[1]}" solution_id={named}>')
        lines.append(
            f'    <image filter="0" frame_id={quoteattr(who.frame_id)} image_id={quoteattr(who.image_id)} '
            f"instrument={quoteattr(who.instrument)} unique_id={quoteattr(who.unique_id)}>"
        )
        lines += _parameters("original_parameters", who.pointing_type, names, entry.original_deg, "      ")
        if entry.models is not None and entry.models_in is not None:
            lines += _model("original_camera_model", entry.models[0], entry.models_in, "      ")
        lines.append("    </image>")
        lines += _parameters("pointing_parameters", who.pointing_type, names, entry.pointing_deg, "    ")
        if entry.models is not None and entry.models_in is not None:
            lines += _model("camera_model", entry.models[1], entry.models_in, "    ")
        lines.append("  </solution>")
    if ground is not None:
        keys = ("X", "Y", "Z", "Normal_X", "Normal_Y", "Normal_Z")
        lines.append(f'  <surface_model type="TiltedPlane" solution_id={named}>')
        for key, value in zip(keys, ground.ravel().tolist(), strict=True):
            lines.append(f'    <parameter id="{key}" value="{value!r}"/>')
        lines += [f"    <reference_frame{ground_in.attributes()}/>", "  </surface_model>"]
    return "\n".join([*lines, "</pointing_correction>", ""])


def _parameters(
    element: str, kind: str, names: tuple[str, ...], values: tuple[float, ...], indent: str
) -> list[str]:
    return [
        f"{indent}<{element} type={quoteattr(kind)}>",
        *(
            f'{indent}  <parameter id={quoteattr(n)} value="{v!r}"/>'
            for n, v in zip(names, values, strict=False)
        ),
        f"{indent}</{element}>",
    ]


def _model(element: str, model: CAHV, frame: ReferenceFrame, indent: str) -> list[str]:
    kind = type(model).__name__
    lines = [f'{indent}<{element} type="{kind}">']
    for letter in kind:
        values = " ".join(f'value{n}="{v!r}"' for n, v in enumerate(getattr(model, letter).tolist(), 1))
        lines.append(f'{indent}  <parameter id="{letter}" type="float_3" {values}/>')
    if isinstance(model, CAHVORE):
        # Types 1 and 2 are the general one with a linearity of 1 and of 0.
        lines.append(f'{indent}  <parameter id="T" value="3"/>')
        lines.append(f'{indent}  <parameter id="P" value="{model.linearity!r}"/>')
    return [*lines, f"{indent}  <reference_frame{frame.attributes()}/>", f"{indent}</{element}>"]
