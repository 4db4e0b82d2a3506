"""Values derived from files, kept for as long as the files stay as they were."""

from collections.abc import Iterable
from pathlib import Path
from typing import Generic, TypeVar

__all__ = ["FileMemory"]

ValueT = TypeVar("ValueT")
Stamp = tuple[int, int]
"""Time of the last change, nanoseconds, and size, bytes."""


class FileMemory(Generic[ValueT]):
    """One value for each file, forgotten when any of the files that it was made from changes.

    Threads may share a memory: the worst that can happen is that a value is made twice.
    """

    def __init__(self) -> None:
        self._kept: dict[Path, tuple[dict[Path, Stamp | None], ValueT]] = {}

    def keep(self, file: Path, value: ValueT, made_from: Iterable[Path] = ()) -> None:
        """Keep the value of a file that was made from the file itself and from the others."""
        self._kept[file] = {path: _stamp(path) for path in (file, *made_from)}, value

    def recall(self, file: Path) -> ValueT | None:
        """The value of a file; None if there is none, or if a file has changed since."""
        stamps, value = self._kept.get(file, ({}, None))
        return value if all(_stamp(path) == stamp for path, stamp in stamps.items()) else None


def _stamp(path: Path) -> Stamp | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
