"""Files of options: TOML with a table for each subcommand, checked against the subcommand's parser."""

import argparse
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from pancam_graph.base.choices import nearest
from pancam_graph.base.errors import InputError
from pancam_graph.cli._parser import COMMON_OPTIONS, Flag, Parser, Several, degrees

__all__ = ["read_config"]

_NOT_IN_FILES = {"help", "config"}
_KINDS: Mapping[Any, tuple[str, tuple[type, ...]]] = {
    int: ("a whole number", (int,)),
    float: ("a number", (int, float)),
    degrees: ("a number of degrees", (int, float)),
}
"""What a value of TOML must be for options of these types, in words and as types; for others it is text."""


def read_config(path: Path, parser: Parser, command: str, commands: Collection[str]) -> dict[str, Any]:
    """Values of a subcommand's options by the names that the parser stores them under.

    Raises InputError for a file that cannot be read or is no TOML, for an unknown key or table, and for a
    value that its option cannot have. Tables of the other subcommands are not looked at.
    """
    content = _read(path)
    options = {k: a for k, a in parser.long_options().items() if k not in _NOT_IN_FILES}
    entries: list[tuple[str, str, object]] = []
    for key, value in content.items():
        if key in COMMON_OPTIONS:
            entries.append((f"{path}: {key}", key, value))
        elif key not in commands:
            hint = f"; {key} belongs into [{command}]" if key in options else None
            known = [*commands, *COMMON_OPTIONS]
            raise InputError(
                f"{path}: {_quoted(key)}: expected a table of a subcommand ({', '.join(commands)}) or one of "
                f"{', '.join(COMMON_OPTIONS)}, found another key{hint or nearest(key, known)}"
            )
        elif not isinstance(value, dict):
            raise InputError(f"{path}: {key}: expected a table [{key}], found {_described(value)}")
        elif key == command:
            entries += [(f"{path}: [{key}] {_quoted(k)}", k, v) for k, v in value.items()]
    values: dict[str, Any] = {}
    names: dict[str, str] = {}
    for where, key, value in entries:
        if key not in options:
            raise InputError(
                f"{where}: expected the long name of an option of {command}, found an unknown key"
                f"{nearest(key, options)}"
            )
        action = options[key]
        if names.get(action.dest, key) != key:
            raise InputError(f"{where}: expected {names[action.dest]} or {key}, found both")
        names[action.dest] = key
        values[action.dest] = _converted(where, key, action, value)
    return values


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))  # editors of Windows write a mark first
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: expected a file of options, found none to read ({reason})") from error
    except (ValueError, RecursionError) as error:  # no UTF-8, no TOML, numbers or nesting without end
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: expected a file of options in TOML, found an error: {reason}") from error


def _converted(where: str, key: str, action: argparse.Action, value: object) -> Any:
    """The value as the command line would have given it."""
    if isinstance(action, Flag):
        if not isinstance(value, bool):
            raise InputError(f"{where}: expected true or false, found {_described(value)}")
        return value != key.startswith("no-")
    if isinstance(action, Several) or action.nargs == "+" or isinstance(action.nargs, int):
        items = value if isinstance(value, list) else [value]
        if isinstance(action.nargs, int) and len(items) != action.nargs:
            raise InputError(f"{where}: expected a list of {action.nargs}, found {_described(value)}")
        if not items:
            raise InputError(f"{where}: expected one entry or more, found an empty list")
        return tuple(_single(where, action, item) for item in items)
    return _single(where, action, value)


def _single(where: str, action: argparse.Action, value: object) -> Any:
    """One value as the command line would have given it."""
    expected, types = _KINDS.get(action.type, ("text", (str,)))
    if isinstance(value, bool) or not isinstance(value, types):
        raise InputError(f"{where}: expected {expected}, found {_described(value)}")
    try:
        text = value if isinstance(value, str) else repr(value)
        if "\0" in text:
            raise InputError(f"{where}: expected text without a NUL character, found {_described(value)}")
        made = action.type(text) if callable(action.type) else text
    except argparse.ArgumentTypeError as error:
        raise InputError(f"{where}: {error}") from error
    except ValueError as error:  # numbers of thousands of digits
        raise InputError(f"{where}: expected {expected}, found one too long") from error
    if action.choices is not None and made not in action.choices:
        names = [str(c) for c in action.choices]
        raise InputError(
            f"{where}: expected one of {', '.join(names)}; found {_described(value)}{nearest(text, names)}"
        )
    return made


def _quoted(key: str) -> str:
    """A key in one short line, quoted where it is no plain word."""
    return key if key.replace("-", "").replace("_", "").isalnum() and len(key) < 40 else _described(key)


def _described(value: object) -> str:
    """A value of TOML in one short line."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, bool):
        return "true" if value else "false"
    try:
        text = ascii(value) if isinstance(value, str) else str(value)
    except ValueError:
        return "a number too long"
    return text if len(text) <= 60 else f"{text[:57]}..."
