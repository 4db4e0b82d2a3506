"""Strict JSON: one sentence for any fault of a file, naming the entry."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pydantic

from pancam_graph.base.choices import nearest
from pancam_graph.base.errors import InputError, PancamGraphError
from pancam_graph.base.regular_files import instead_of_file

__all__ = [
    "any_json",
    "any_json_object",
    "entry_name",
    "json_object",
    "prefixed",
    "read_bytes",
    "read_json",
    "refused_by_schema",
    "require_format",
    "short",
    "validated",
]

_MAX_QUOTED = 60
_UNION_TAGS = {"constrained-int", "constrained-str"}
"""Pieces of a location that are no entry, but the type that pydantic tried."""
_EXPECTED = {
    "bool_parsing": "true or false",
    "bool_type": "true or false",
    "finite_number": "a finite number",
    "float_type": "a number",
    "int_type": "an integer",
    "list_type": "a list",
    "model_type": "an object",
    "string_pattern_mismatch": "a string of one line that is not empty",
    "string_type": "a string",
    "string_unicode": "a string of valid Unicode",
}
"""What pydantic's error types mean to somebody who wrote JSON."""

_Model = TypeVar("_Model", bound=pydantic.BaseModel)


def short(value: object) -> str:
    """A JSON value as an error message quotes it: in JSON's own words, on one line, not too long."""
    if isinstance(value, dict):
        return "an object" if value else "an empty object"
    if isinstance(value, list):
        return f"a list of {len(value)}" if value else "an empty list"
    if isinstance(value, int) and abs(value) >= 10**_MAX_QUOTED:
        return "an integer of too many digits"
    text = json.dumps(value)
    return text if len(text) <= _MAX_QUOTED else f"{text[:_MAX_QUOTED]}..."


def entry_name(location: Sequence[int | str]) -> str:
    """Path of an entry as an error message names it: `frames[3].pan_rad`.

    Pieces in angle brackets are left out: they are the tags by which a schema tells the members of a union
    apart.
    """
    name = ""
    for piece in location:
        if isinstance(piece, int):
            name += f"[{piece}]"
        elif piece not in _UNION_TAGS and not (piece.startswith("<") and piece.endswith(">")):
            name += f".{piece}" if name else piece
    return name


@contextmanager
def prefixed(where: object) -> Iterator[None]:
    """Put `where` (a file, an entry) before the sentence of any error of ours that leaves the block.

    The error that leaves is an InputError, or the subclass of it that was raised, with a text of one line.
    """
    try:
        yield
    except PancamGraphError as error:
        kind = type(error) if isinstance(error, InputError) else InputError
        raise kind(" ".join(f"{where}: {error}".splitlines())) from error


def read_bytes(path: Path) -> bytes:
    """Content of a file. Raises InputError saying why it cannot be read."""
    other = instead_of_file(path)
    if other is not None:
        raise InputError(f"{path}: expected a file, found {other}")
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: expected a readable file, found: {reason}") from error


def _doubled_key(value: object, doubled: dict[int, str], location: tuple[int | str, ...] = ()) -> str | None:
    """Path of the first doubled key; `doubled` maps identities of objects with one to that key."""
    if isinstance(value, dict):
        if id(value) in doubled:
            return entry_name((*location, doubled[id(value)]))
        children: list[tuple[int | str, object]] = list(value.items())
    else:
        children = list(enumerate(value)) if isinstance(value, list) else []
    for key, child in children:
        doubled_in_child = _doubled_key(child, doubled, (*location, key))
        if doubled_in_child is not None:
            return doubled_in_child
    return None


def read_json(path: Path, format_name: str, version: int) -> dict[str, Any]:
    """The object in a JSON file of one of our formats; see `json_object`.

    Raises InputError for a file that cannot be read, and as `json_object` does.
    """
    return json_object(read_bytes(path), path, format_name, version)


def json_object(content: bytes, path: Path, format_name: str, version: int) -> dict[str, Any]:
    """The object in JSON text of one of our formats; `path` is the file that errors name.

    Raises InputError as `any_json_object` does, and for another format or version.
    """
    data = any_json_object(content, path)
    require_format(data, path, format_name, version)
    return data


def require_format(data: dict[str, Any], path: Path, format_name: str, version: int) -> None:
    """Raise InputError unless an object of JSON says that it is of this format and version."""
    for key, expected in (("format", format_name), ("version", version)):
        if key not in data:
            raise InputError(f"{path}: {key}: expected {short(expected)}, found no such key")
        if data[key] != expected or type(data[key]) is not type(expected):
            raise InputError(f"{path}: {key}: expected {short(expected)}, found {short(data[key])}")


def any_json_object(content: bytes, path: Path) -> dict[str, Any]:
    """The object in JSON text of any format; `path` is the file that errors name.

    Raises InputError as `any_json` does, and for anything else than an object.
    """
    data = any_json(content, path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a JSON object, found {short(data)}")
    return data


def any_json(content: bytes, path: Path) -> Any:
    """The value in JSON text of any format; `path` is the file that errors name.

    NaN and infinite numbers are let through: the schema refuses them and names the entry.

    Raises InputError for what is not JSON, and for a key that stands twice in an object.
    """
    doubled: dict[int, str] = {}
    kept: list[
        dict[str, Any]
    ] = []  # keeps every object with a doubled key alive, so that its id stays its own

    def pairs(items: list[tuple[str, Any]]) -> dict[str, Any]:
        value = dict(items)
        if len(value) < len(items):
            keys = Counter(key for key, _ in items)
            doubled[id(value)] = keys.most_common(1)[0][0]
            kept.append(value)
        return value

    if not content.strip():
        raise InputError(f"{path}: expected a JSON object, found an empty file")
    try:
        data = json.loads(content.decode("utf-8-sig"), object_pairs_hook=pairs)
        entry = _doubled_key(data, doubled) if doubled else None
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise InputError(f"{path}: {where}: expected JSON, found an error: {error.msg}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected JSON in UTF-8, found other bytes at {error.start}") from error
    except RecursionError as error:
        raise InputError(f"{path}: expected JSON, found brackets nested too deeply") from error
    except ValueError as error:  # Python's limit on the length of integers
        raise InputError(f"{path}: expected JSON, found an integer of too many digits") from error
    if entry is not None:
        raise InputError(f"{path}: {entry}: expected each key once in an object, found it twice")
    return data


def validated(model: type[_Model], data: dict[str, Any], path: Path) -> _Model:
    """The data as a model. Raises InputError about the first thing that does not fit the schema."""
    with refused_by_schema(path):
        return model.model_validate(data)


@contextmanager
def refused_by_schema(path: Path) -> Iterator[None]:
    """Turn what a schema says about an entry into our sentence about `path`, on reading and on writing."""
    try:
        yield
    except pydantic.ValidationError as error:
        first, *others = error.errors(include_url=False)
        more = f" (and {len(others)} more such error{'s' if len(others) > 1 else ''})" if others else ""
        with prefixed(path):
            raise InputError(f"{_sentence(first)}{more}") from error


def _sentence(error: Any) -> str:
    where, kind, context = entry_name(error["loc"]), error["type"], error.get("ctx", {})
    if kind == "missing":
        return f"{where}: expected this key, found an object without it"
    if kind == "extra_forbidden":
        return f"{where}: expected only keys of the format, found the unknown key {short(error['loc'][-1])}"
    if kind in {"too_short", "too_long"}:
        length = context["min_length" if kind == "too_short" else "max_length"]  # the same in every schema
        return f"{where}: expected {length} numbers, found {context['actual_length']}"
    if kind in {"union_tag_invalid", "union_tag_not_found"} and isinstance(error["input"], dict):
        if "expected_tags" not in context:
            return f"{where}.kind: expected this key, found an object without it"
        tags = context["expected_tags"].translate(str.maketrans("", "", "'<>"))
        key = "kind" if "kind" in context["discriminator"] else "model"
        found = error["input"].get(key)
        near = nearest(found, tags.split(", ")) if isinstance(found, str) else ""
        return f"{where}.{key}: expected one of {tags}; found {short(found)}{near}"
    if kind == "literal_error":
        return f"{where}: expected {context['expected']}, found {short(error['input'])}"
    expected = "an object" if kind.startswith("union_tag") else _EXPECTED.get(kind, error["msg"])
    return f"{where}: expected {expected}, found {short(error['input'])}"
