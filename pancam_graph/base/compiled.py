"""How loops are compiled to machine code, and how the compiled code is kept on disk.

Three decorators: `entry` for functions that Python calls, `part` and `inlined` for functions that only other
compiled functions call. Only entry points are kept on disk; each holds the code of its parts.

Numba notices when the file of a function on disk has changed, but not when the file of a part has. An entry
point is therefore kept under a name that ends in a digest of all source files of its folder: after an edit of
any of them it is looked for under another name, and compiled anew. A folder whose entry points take parts
from another one names that: `Compiling(parts_from=...)`.

`uncounted` has the same three decorators for functions that make no arrays. Numba counts references to arrays
wherever a function hands them on, which costs half the time of a loop that hands on thirty of them; without
counting, the caller must keep all arrays alive.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

from pancam_graph.base.kept_code import KeptCode, kept_code

__all__ = ["Compiling", "entry", "folder_digest", "inlined", "is_on_disk", "part", "uncounted"]

_F = TypeVar("_F", bound=Callable[..., Any])


@cache
def folder_digest(folder: Path) -> str:
    """A digest, 12 digits, of the names and contents of the Python files of a folder.

    Folders within are left out. The files are read once per process.
    """
    running = sha256()
    for path in sorted(folder.glob("*.py")):
        running.update(f"{path.name}\0".encode())
        running.update(path.read_bytes() + b"\0")
    return running.hexdigest()[:12]


@dataclass(frozen=True)
class Compiling:
    """A way to compile functions: for this machine, without the interpreter's lock, dividing as NumPy does.

    A product and a sum may be fused into one operation, which rounds once instead of twice; no operations are
    reordered.
    """

    counts_references: bool = True
    """Whether Numba counts references to arrays: needed where a function makes arrays."""
    parts_from: tuple[Path, ...] = ()
    """Other folders that have parts of the entry points: their sources are in the digest too."""

    def entry(self, function: _F) -> _F:
        """Compile a function that Python calls, and keep the machine code on disk."""
        folders = (Path(function.__code__.co_filename).parent, *self.parts_from)
        digest = "-".join(folder_digest(folder) for folder in folders)
        function.__qualname__ = f"{function.__qualname__}-{digest}"  # Numba names files after it
        compiled: Any = self._compile(function)
        kept = kept_code(function) if hasattr(compiled, "stats") else None  # without: compilation is off
        if kept is not None:
            compiled._cache = kept  # as cache=True sets one that fails where no folder can be written to
        return cast(_F, compiled)

    def part(self, function: _F) -> _F:
        """Compile a function that only compiled functions call."""
        return self._compile(function)

    def inlined(self, function: _F) -> _F:
        """Copy the body of a function into each compiled function that calls it.

        For functions with so many arguments that a call would cost as much as their work.
        """
        return self._compile(function, inline="always")

    def merged(self, function: _F) -> _F:
        """Copy a function as `inlined` does, but not before LLVM: what is copied is not typed again.

        For functions that other functions of this kind call, and that take many arrays: a call hands on each
        array as a dozen numbers.
        """
        return self._compile(function, forceinline=True)

    def _compile(self, function: _F, **options: Any) -> _F:
        if not self.counts_references:
            options["_nrt"] = False
        compiling = numba.njit(nogil=True, error_model="numpy", fastmath={"contract"}, **options)
        return cast(_F, compiling(function))


_counted = Compiling()
entry, part, inlined = _counted.entry, _counted.part, _counted.inlined
uncounted = Compiling(counts_references=False)


def is_on_disk(function: Callable[..., Any]) -> bool:
    """Whether an entry point was compiled before, from the present sources: its first call then is quick.

    True where compilation is switched off (NUMBA_DISABLE_JIT).
    """
    if not hasattr(function, "stats"):
        return True
    kept = cast(Any, function)._cache
    return isinstance(kept, KeptCode) and kept.is_there
