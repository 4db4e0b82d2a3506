"""Arrays in a file without a name: memory holds what was touched of them since they were last let go."""

import mmap
import tempfile
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from pancam_graph.base.errors import InputError

__all__ = ["Scratch"]

_APART = 64
"""Bytes that each array begins at a multiple of, as lines of a cache do."""
_AT_ONCE = 1 << 24
"""Bytes written by one call."""


class Scratch:
    """Arrays on disk that read and write as those in memory do.

    The file is in Python's folder of temporary files (TMPDIR) and vanishes with the last of its arrays,
    however the process ends. In a folder that is memory itself, it saves none.
    """

    def __init__(self, kinds: Sequence[tuple[tuple[int, ...], DTypeLike]]) -> None:
        """Arrays of zeros of these shapes and types. Raises InputError where the disk has no room."""
        sizes = [int(np.prod(shape)) for shape, _ in kinds]
        begins, end = [], 0
        for (_, kind), size in zip(kinds, sizes, strict=True):
            begins.append(end)
            end += -(-size * np.dtype(kind).itemsize // _APART) * _APART
        self._map = _on_disk(max(end, _APART))
        self.arrays: list[NDArray[Any]] = [
            np.frombuffer(self._map, kind, size, begin).reshape(shape)
            for (shape, kind), size, begin in zip(kinds, sizes, begins, strict=True)
        ]
        """The arrays, in the order given."""

    @staticmethod
    def of(arrays: Sequence[NDArray[Any]]) -> "Scratch":
        """Copies of arrays. Raises InputError where the disk has no room."""
        out = Scratch([(array.shape, array.dtype) for array in arrays])
        for stored, array in zip(out.arrays, arrays, strict=True):
            stored[...] = array
        return out

    def let_go(self) -> None:
        """Take the arrays out of this process's memory; they keep their contents."""
        if hasattr(mmap, "MADV_DONTNEED"):
            self._map.madvise(mmap.MADV_DONTNEED)


def _on_disk(n_bytes: int) -> mmap.mmap:
    """A mapped file of zeros that the disk has room for."""
    try:
        with tempfile.TemporaryFile(prefix="pancam-graph-") as file:
            # Written, not sparse: a full disk then is an error here, and no fault of memory later.
            zeros = bytes(min(n_bytes, _AT_ONCE))
            for begin in range(0, n_bytes, _AT_ONCE):
                file.write(zeros[: n_bytes - begin])
            file.flush()
            return mmap.mmap(file.fileno(), n_bytes)
    except OSError as error:
        raise InputError(
            f"{tempfile.gettempdir()}: expected room for {n_bytes / 1e6:.0f} MB of temporary files "
            f"(another folder: TMPDIR), found {error.strerror or error}"
        ) from error
