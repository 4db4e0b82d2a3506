"""Which modules of this package a function runs through, found in their sources, and a digest of these.

A module runs through another if it imports it, anywhere in its text, or if a module that it imports does. An
import from the door of a room (the `__init__.py` of a folder) leads to the module that the door takes the
name from, and not to all others that the door names.
"""

import ast
import importlib.util
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from pancam_graph.base.parsing import PARSING

__all__ = ["modules_behind", "source_digest", "source_of"]

_DOOR = "__init__.py"


def source_digest(*functions: Callable[..., Any], alone: Iterable[str] = ()) -> str:
    """A digest of the sources of all modules that functions run through: 64 digits.

    `alone` names modules of which only the own text counts, not what they import.
    """
    names = frozenset(function.__module__ for function in functions)
    return _digest(modules_behind(names) | frozenset(alone))


@cache
def _digest(modules: frozenset[str]) -> str:
    running = sha256()
    for name in sorted(modules):
        running.update(f"{name}\0{source_of(name)[1]}\0".encode())
    return running.hexdigest()


@cache
def modules_behind(names: frozenset[str]) -> frozenset[str]:
    """Modules of their own top-level package that modules run through, these included."""
    reached: set[str] = set()
    waiting = set(names)
    while waiting:
        name = waiting.pop()
        reached.add(name)
        waiting |= _imported(name) - reached
    return frozenset(reached)


@cache
def source_of(name: str) -> tuple[Path, str]:
    """File and text of a module, read once per process; no text for one without a Python file."""
    file = getattr(sys.modules.get(name), "__file__", None)
    if file is None:
        spec = importlib.util.find_spec(name) if name not in sys.modules else None
        file = None if spec is None else spec.origin
    if file is None or not file.endswith(".py"):
        return Path(name), ""
    return Path(file), Path(file).read_text(encoding="utf-8")


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # what should be the folder is a module
        return False


@cache
def _from_statements(name: str) -> tuple[tuple[str, str, str], ...]:
    """Each import of a module as (module, name or "" for the module itself, its name here)."""
    path, text = source_of(name)
    package = name if path.name == _DOOR else name.rpartition(".")[0]
    imports: list[tuple[str, str, str]] = []
    with PARSING:
        tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports += [(alias.name, "", alias.asname or alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            module = importlib.util.resolve_name(base, package)
            imports += [(module, alias.name, alias.asname or alias.name) for alias in node.names]
    return tuple(imports)


@cache
def _imported(name: str) -> frozenset[str]:
    """Modules of the same top-level package that a module imports."""
    top = name.partition(".")[0]
    return frozenset(
        behind
        for module, imported, _ in _from_statements(name)
        if module.partition(".")[0] == top
        for behind in _behind_name(module, imported)
    )


def _behind_name(module: str, name: str) -> Iterator[str]:
    """The modules that an import of a name from a module leads to."""
    if not name or name == "*" or source_of(module)[0].name != _DOOR:
        yield module
        return
    origins = [(m, n) for m, n, here in _from_statements(module) if here == name and m != module]
    for origin, imported in origins:
        yield from _behind_name(origin, imported)
    if not origins:
        # The name is a module in the folder, or the door makes it itself.
        inner = f"{module}.{name}"
        yield inner if _is_module(inner) else module
