"""VICAR labels of rover images, in the entries of a PDS3 label: properties are its groups.

Source: the VICAR file format (system label, property labels, label at the end of the file); tried on the
VICAR labels that images of Opportunity and Curiosity have behind their PDS3 labels.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pancam_graph.base.errors import InputError

__all__ = ["VICAR_START", "vicar_entries"]

VICAR_START = b"LBLSIZE="
_MAX_LABEL_BYTES = 1 << 20
_ENTRY = re.compile(r"\s*([A-Za-z][A-Za-z0-9_]*)\s*=\s*")
_TEXT = re.compile(r"'((?:[^']|'')*)'")
_WORD = re.compile(r"[^\s,()']+")
_SAMPLES = {
    "BYTE": ("INTEGER", 8),
    "HALF": ("INTEGER", 16),
    "FULL": ("INTEGER", 32),
    "REAL": ("REAL", 32),
    "DOUB": ("REAL", 64),
}
_STORAGES = {"BSQ": "BAND_SEQUENTIAL", "BIL": "LINE_INTERLEAVED", "BIP": "SAMPLE_INTERLEAVED"}
_OPEN = frozenset({"IDENTIFICATION", "TELEMETRY"})
"""Properties whose entries a PDS3 label has outside any group."""
_UNIT = "__UNIT"


@dataclass(frozen=True)
class _Quantity:
    """A number with a unit, as the accessors of labels know it."""

    value: Any
    units: str


def vicar_entries(file: Path, head: bytes) -> dict[str, Any]:
    """The entries of a file that begins with a VICAR label, by group; `head` is its first megabyte.

    Raises InputError naming the file for a label that is none, or of more than a megabyte.
    """
    told = re.match(rb"LBLSIZE=\s*(\d{1,9})", head)
    size = 0 if told is None else int(told[1])
    if not 0 < size <= _MAX_LABEL_BYTES:
        raise InputError(f"{file}: LBLSIZE: expected 1 to {_MAX_LABEL_BYTES} bytes, found {size}")
    if len(head) < size:
        raise InputError(f"{file}: LBLSIZE: expected a label of {size} bytes, found {len(head)}")
    system, properties = _sections(file, head[:size])
    begin = _place(file, system, size)
    if system.get("EOL") == 1:
        more, others = _sections(file, _end_label(file, begin, system))
        system, properties = {**more, **system}, {**properties, **others}
    out: dict[str, Any] = {}
    for name, entries in properties.items():
        if name in _OPEN:
            out |= {key: value for key, value in entries.items() if key not in out}
    out |= {name: entries for name, entries in properties.items() if name not in _OPEN}
    image = {**properties.get("IMAGE_DATA", {}), **_image(file, system)}
    return {**out, "IMAGE": image, "^IMAGE": _Quantity(begin + 1, "BYTES")}


def _whole(file: Path, system: dict[str, Any], key: str, default: int = 0) -> int:
    value = system.get(key, default)
    if not isinstance(value, int) or not 0 <= value < 1 << 40:
        raise InputError(f"{file}: {key}: expected a whole number, found {str(value)[:60]!r}")
    return value


def _place(file: Path, system: dict[str, Any], label_bytes: int) -> int:
    """Offset of the first line: behind the label and binary header records."""
    return label_bytes + _whole(file, system, "NLB") * _whole(file, system, "RECSIZE")


def _end_label(file: Path, begin: int, system: dict[str, Any]) -> bytes:
    """The second part of a label, behind the samples; nothing where the file ends before it."""
    lines = _whole(file, system, "N2", 1) * _whole(file, system, "N3", 1)
    try:
        with file.open("rb") as stream:
            stream.seek(begin + lines * _whole(file, system, "RECSIZE"))
            part = stream.read(_MAX_LABEL_BYTES)
    except OSError as error:
        raise InputError(f"{file}: expected a VICAR image, could not read it: {error.strerror}") from error
    told = re.match(rb"LBLSIZE=\s*(\d{1,7})", part)
    return b"" if told is None else part[: int(told[1])]


def _image(file: Path, system: dict[str, Any]) -> dict[str, Any]:
    kind, bits = _SAMPLES.get(str(system.get("FORMAT", "")).upper(), ("", 0))
    storage = _STORAGES.get(str(system.get("ORG", "BSQ")).upper(), str(system.get("ORG")))
    if not kind:
        raise InputError(
            f"{file}: FORMAT: expected {', '.join(_SAMPLES)}, found {str(system.get('FORMAT'))[:60]!r}"
        )
    if str(system.get("COMPRESS", "NONE")).upper() != "NONE":
        raise InputError(f"{file}: COMPRESS: expected NONE, found {str(system['COMPRESS'])[:60]!r}")
    if kind == "INTEGER":
        kind = "LSB_INTEGER" if str(system.get("INTFMT", "LOW")).upper() == "LOW" else "MSB_INTEGER"
    else:
        order = str(system.get("REALFMT", "VAX")).upper()
        if order not in {"IEEE", "RIEEE"}:
            raise InputError(f"{file}: REALFMT: expected IEEE or RIEEE, found {order[:60]!r}")
        kind = "IEEE_REAL" if order == "IEEE" else "PC_REAL"
    return {
        "LINES": _whole(file, system, "NL"),
        "LINE_SAMPLES": _whole(file, system, "NS"),
        "BANDS": _whole(file, system, "NB", 1),
        "SAMPLE_TYPE": kind,
        "SAMPLE_BITS": bits,
        "BAND_STORAGE_TYPE": storage,
        "LINE_PREFIX_BYTES": _whole(file, system, "NBB"),
    }


def _sections(file: Path, label: bytes) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The system label, and properties by name; the history behind them is left out."""
    text = label.partition(b"\0")[0].decode("latin-1")
    system: dict[str, Any] = {}
    properties: dict[str, dict[str, Any]] = {}
    entries, at = system, 0
    while match := _ENTRY.match(text, at):
        key = match[1].upper()
        value, at = _value(file, text, match.end(), key)
        if key == "TASK":
            break
        if key == "PROPERTY":
            entries = properties.setdefault(str(value).upper(), {})
        else:
            entries.setdefault(key, value)
    for section in properties.values():
        for key in [k for k in section if k.endswith(_UNIT) and k.removesuffix(_UNIT) in section]:
            section[key.removesuffix(_UNIT)] = _with_units(section[key.removesuffix(_UNIT)], section.pop(key))
    return system, properties


def _with_units(value: Any, units: Any) -> Any:
    if isinstance(value, list):
        told = units if isinstance(units, list) else [units] * len(value)
        if len(told) == len(value):
            return [_Quantity(v, str(unit)) for v, unit in zip(value, told, strict=True)]
        return value
    return value if isinstance(units, list) else _Quantity(value, str(units))


def _value(file: Path, text: str, at: int, key: str) -> tuple[Any, int]:
    """The value that begins at a place of the text, and where it ends."""
    if not text.startswith("(", at):
        return _one(file, text, at, key)
    values: list[Any] = []
    at += 1
    while True:
        value, at = _one(file, text, at, key)
        values.append(value)
        at = _past_blanks(text, at)
        mark = text[at : at + 1]
        at = _past_blanks(text, at + 1)
        if mark == ")":
            return values, at
        if mark != ",":
            raise InputError(f"{file}: {key}: expected a list in brackets, found no end of it")


def _one(file: Path, text: str, at: int, key: str) -> tuple[Any, int]:
    if quoted := _TEXT.match(text, at):
        return quoted[1].replace("''", "'"), quoted.end()
    if word := _WORD.match(text, at):
        return _number(word[0]), word.end()
    raise InputError(f"{file}: {key}: expected a value of a VICAR label, found {text[at : at + 20]!r}")


def _past_blanks(text: str, at: int) -> int:
    while text[at : at + 1].isspace():
        at += 1
    return at


def _number(word: str) -> Any:
    for kind in (int, float):
        try:
            return kind(word) if len(word) < 40 else word
        except ValueError:
            continue
    return word
