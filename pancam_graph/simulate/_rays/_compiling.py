"""How the modules of this folder are compiled as one, and when what is on disk is stale.

Numba's cache on disk watches the file of a function, not those of the functions that it calls; but it also
tells closures apart by what they close over. So only the entry points are kept on disk, and each closes over
`SOURCES`, a digest of all files here: when one changes, every entry point is compiled anew.
"""

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

__all__ = ["SOURCES", "inlined", "part"]

_F = TypeVar("_F", bound=Callable[..., Any])


def _digest(folder: Path) -> int:
    texts = [path.read_bytes() for path in sorted(folder.glob("*.py"))]
    return int.from_bytes(sha256(b"\0".join(texts)).digest()[:6], "big")


SOURCES = _digest(Path(__file__).parent)
"""Differs whenever a file of this folder does."""


# Numba counts references to arrays wherever a function hands them on. With the thirty arrays of a world, that
# took half of the time of a ray; the caller holds them all, and nothing here makes any.
_HOW: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}, "_nrt": False}


def entry(function: _F) -> _F:
    """Compile and keep on disk: as `kernel.compiled`, for functions that make no arrays."""
    dispatcher: Any = numba.njit(cache=True, **_HOW)(function)
    return cast(_F, dispatcher)


def part(function: _F) -> _F:
    """Compile as part of the entry points."""
    dispatcher: Any = numba.njit(**_HOW)(function)
    return cast(_F, dispatcher)


def inlined(function: _F) -> _F:
    """Compile into its callers: to hand the many arrays of a scene to a call costs as much as its work."""
    dispatcher: Any = numba.njit(inline="always", **_HOW)(function)
    return cast(_F, dispatcher)
