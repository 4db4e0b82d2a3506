"""What must be the same on two machines for the same work to give the same bytes."""

import os
import platform
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path

__all__ = ["PACKAGE", "difference", "machine", "package_version"]

PACKAGE = "pancam_graph"
_DIGITS = 12
"""Of a digest, as a sentence shows it."""


@cache
def machine() -> Mapping[str, str]:
    """Names and values: version and sources of this package, Python's version, the kind of processor."""
    return {
        PACKAGE: package_version(),
        "sources of pancam_graph": _package_digest()[:_DIGITS],
        "Python": ".".join(platform.python_version_tuple()[:2]),
        "processor": platform.machine(),
    }


def package_version() -> str:
    """The version of this package, which the rooms below its top do not import."""
    return str(sys.modules[PACKAGE].__version__)


def difference(here: Mapping[str, str], there: Mapping[str, str]) -> str | None:
    """The first thing that differs, as the end of a sentence; None where all is the same."""
    for name, value in here.items():
        found = there.get(name, "none")
        if found != value:
            return f"expected {name} {value} as on the machine that asks, found {found}"
    return None


def _package_digest() -> str:
    """A digest of all modules of the package: names and texts."""
    running = sha256()
    for name, path in sorted(_modules()):
        running.update(f"{name}\0".encode() + path.read_bytes() + b"\0")
    return running.hexdigest()


def _modules() -> Iterator[tuple[str, Path]]:
    # In a checkout the room of factors is another folder, and perhaps a link to it.
    for room, skipped in ((PACKAGE, {"factors"}), (f"{PACKAGE}.factors", set[str]())):
        spec = find_spec(room)
        assert spec is not None  # it is this package
        assert spec.origin is not None  # it has a door
        root = Path(spec.origin).parent
        for folder, folders, files in os.walk(root):
            folders[:] = [name for name in folders if name not in skipped]
            for file in files:
                if file.endswith(".py"):
                    path = Path(folder) / file
                    yield f"{room}/{path.relative_to(root).as_posix()}", path
