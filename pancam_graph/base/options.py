"""Options that a function was given, or its usual ones."""

from collections.abc import Mapping
from typing import TypeVar

from pancam_graph.base.errors import InputError

__all__ = ["options_of"]

_Options = TypeVar("_Options")


def options_of(kind: type[_Options], given: _Options | None, where: str) -> _Options:
    """The options of a function, which `where` names; the usual ones of the kind where none are given.

    Raises InputError for anything that is not of the kind, such as a dictionary.
    """
    if given is None:
        return kind()
    if isinstance(given, kind):
        return given
    name = kind.__name__
    advice = f"; {name}(**options) makes them of it" if isinstance(given, Mapping) else ""
    raise InputError(f"{where}: options: expected {name}(...), found a {type(given).__name__}{advice}")
