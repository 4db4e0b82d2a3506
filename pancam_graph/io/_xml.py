"""XML of labels, as a tree of elements without their namespaces.

A document type is refused before it is read, so no entity is ever defined, expanded or fetched: labels have
none, and entities are how XML is made to grow without end or to read other files.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.base.regular_files import instead_of_file
from pancam_graph.io._told_numbers import told_number

__all__ = ["XmlElement", "read_xml"]

_MAX_BYTES = 1 << 23
_MAX_DEPTH = 64
_MAX_QUOTED = 60
_ANGLES = {"": 1.0, "rad": 1.0, "radian": 1.0, "deg": np.pi / 180, "degree": np.pi / 180}
"""Radians in a unit; a label that names none means radians, as the dictionary of geometry does."""


@dataclass(eq=False)
class XmlElement:
    """An element of a label, with errors that name file and entry."""

    file: Path
    name: str
    attributes: dict[str, str] = field(default_factory=dict)
    text: str = ""
    """Its text without blanks around it; that of its children is theirs."""
    children: list["XmlElement"] = field(default_factory=list)

    @property
    def unit(self) -> str:
        """Its unit, as the label writes it; "" without one."""
        return self.attributes.get("unit", "").strip()

    def every(self, name: str) -> Iterator["XmlElement"]:
        """All elements of a name within it, at any depth, in their order."""
        for child in self.children:
            if child.name == name:
                yield child
            yield from child.every(name)

    def first(self, name: str) -> "XmlElement | None":
        """The first element of a name within it; None without one."""
        return next(self.every(name), None)

    def required(self, name: str) -> "XmlElement":
        """The first element of a name within it. Raises InputError if there is none."""
        found = self.first(name)
        if found is None:
            raise InputError(f"{self.file}: {self.name}: expected an element {name}, found none")
        return found

    def said(self, name: str, default: str | None = None) -> str:
        """Text of the first element of a name. Raises InputError if there is none and no default."""
        found = self.first(name)
        if found is not None and found.text:
            return found.text
        return default if default is not None else self.required(name).words()

    def words(self) -> str:
        """Its text. Raises InputError for an empty one."""
        if not self.text:
            self.refuse("a text", "none")
        return self.text

    def number(self, unit: str = "") -> float:
        """Its number, in a unit or without one. Raises InputError for another unit, and for none."""
        if self.unit and self.unit.lower() != unit:
            self.refuse(f"the unit {unit}" if unit else "no unit", repr(self.unit[:_MAX_QUOTED]))
        return self._number()

    def angle_rad(self) -> float:
        """Its angle, told in radians or degrees. Raises InputError for another unit, and for no number."""
        scale = _ANGLES.get(self.unit.lower())
        if scale is None:
            self.refuse("radians or degrees", repr(self.unit[:_MAX_QUOTED]))
        return self._number() * scale

    def _number(self) -> float:
        number = told_number(self.text)
        if number is None:
            self.refuse("a number", repr(self.text[:_MAX_QUOTED]))
        return number

    def whole(self, name: str, default: int | None = None, *, least: int = 0) -> int:
        """The first element of a name as an integer, `least` or above, written with a point or without."""
        found = self.first(name)
        if found is None and default is not None:
            return default
        found = self.required(name) if found is None else found
        number = told_number(found.text)
        if number is None or number != int(number) or not least <= number < 1 << 53:
            found.refuse(f"an integer of {least} or above", repr(found.text[:_MAX_QUOTED]))
        return int(number)

    def vector(self, name: str, parts: tuple[str, ...], unit: str = "") -> FloatArray:
        """Numbers of the named children of the first element of a name."""
        holder = self.required(name)
        return np.array([holder.required(part).number(unit) for part in parts])

    def refuse(self, expected: str, found: object) -> NoReturn:
        """Raise InputError with file and entry."""
        raise InputError(f"{self.file}: {self.name}: expected {expected}, found {found}")


class _RefusedError(Exception):
    """What the parser meets and must not go on with, in the words of the sentence."""


def read_xml(file: Path, what: str = "an XML label", most_bytes: int = _MAX_BYTES) -> XmlElement:
    """The outermost element of an XML file; `what` it is, for error messages.

    Raises InputError for a file that is no regular one, of more than `most_bytes` (8 MB), not XML, with a
    document type (and so with entities), or nested deeper than any label.
    """
    other = instead_of_file(file)
    if other is not None:
        raise InputError(f"{file}: expected {what}, found {other}")
    try:
        with file.open("rb") as stream:
            content = stream.read(most_bytes + 1)
    except OSError as error:
        raise InputError(f"{file}: expected {what}, could not read it: {error.strerror}") from error
    if len(content) > most_bytes:
        raise InputError(f"{file}: expected {what} of at most {most_bytes} bytes, found more")
    builder = _Builder(file)
    try:
        return builder.tree(content)
    except _RefusedError as error:
        raise InputError(f"{file}: expected {what}, found {error}") from error
    except (expat.ExpatError, ValueError, LookupError) as error:  # the last: an encoding that does not exist
        raise InputError(f"{file}: expected {what}, found text that is none ({error})") from error


class _Builder:
    """A tree made of the events of a parser that knows no entities but the five of XML itself."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._root = XmlElement(file, "")
        self._open = [self._root]
        self._texts: list[list[str]] = [[]]

    def tree(self, content: bytes) -> XmlElement:
        parser = expat.ParserCreate()
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._data
        parser.StartDoctypeDeclHandler = self._doctype
        parser.Parse(content, True)
        return self._root.children[0]

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if len(self._open) > _MAX_DEPTH:
            raise _RefusedError(f"elements nested deeper than {_MAX_DEPTH}")
        element = XmlElement(self._file, name.rpartition(":")[2], attributes)
        self._open[-1].children.append(element)
        self._open.append(element)
        self._texts.append([])

    def _end(self, name: str) -> None:
        self._open.pop().text = "".join(self._texts.pop()).strip()

    def _data(self, data: str) -> None:
        self._texts[-1].append(data)

    def _doctype(self, *_: object) -> None:
        raise _RefusedError("a document type, which labels do not have: entities are never followed")
