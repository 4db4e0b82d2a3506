"""Arrays of .npz files: nothing is ever unpickled, and nothing is made larger than the file can mean."""

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.base.parsing import PARSING
from pancam_graph.io._json import read_bytes

__all__ = ["NpzFile"]

_SUFFIX = ".npy"
_UNPACKED_BYTES = 1 << 28
"""Bytes that all arrays of a file may take together, however small it is."""
_UNPACKED_SHARE = 4
"""How many times the file's own size they may take where that is more: columns hardly compress."""
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


class NpzFile:
    """An archive of arrays, each read when it is asked for."""

    def __init__(self, path: Path) -> None:
        """Open a file. Raises InputError naming it for what is no archive, or unpacks to too much."""
        content = read_bytes(path)
        expected = f"{path}: expected an .npz archive of arrays"
        if content.startswith(npy.MAGIC_PREFIX):
            raise InputError(f"{expected}, found a single array")
        try:
            self._archive = zipfile.ZipFile(io.BytesIO(content))
            members = self._archive.infolist()
        except Exception as error:  # zipfile raises many kinds at bytes that are no archive
            raise InputError(f"{expected}, found something else") from error
        limit = max(_UNPACKED_BYTES, _UNPACKED_SHARE * len(content))
        unpacked = sum(member.file_size for member in members)
        if unpacked > limit:
            raise InputError(
                f"{expected} of at most {limit} bytes, found {unpacked} packed in {len(content)}"
            )
        self._members = {member.filename.removesuffix(_SUFFIX): member for member in members}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arrays."""
        return tuple(self._members)

    def array(self, name: str) -> NDArray[Any]:
        """An array, of whatever type and shape. Raises InputError naming it, not the file."""
        if name not in self._members:
            found = ", ".join(self.names) or "an empty archive"
            raise InputError(f"{name}: expected an array of this name, found {found}")
        try:
            with self._archive.open(self._members[name]) as member:
                content = member.read()
        except Exception as error:  # zipfile raises many kinds at damaged members
            raise InputError(f"{name}: expected a whole array, found a damaged one ({error})") from error
        if not content.startswith(npy.MAGIC_PREFIX):
            raise InputError(f"{name}: expected an array, found other bytes")
        stream = io.BytesIO(content)
        try:
            with PARSING:
                shape, by_columns, dtype = _HEADERS[npy.read_magic(stream)](stream)
            size = math.prod(shape) * dtype.itemsize
        except Exception as error:  # NumPy raises many kinds at headers that are none
            raise InputError(f"{name}: expected a whole array, found one with a damaged header") from error
        if dtype.hasobject:
            raise InputError(
                f"{name}: expected numbers, found pickled objects (never loaded: they can run code)"
            )
        left = len(content) - stream.tell()
        if min(shape, default=1) < 0 or size != left:
            raise InputError(
                f"{name}: expected a whole array, found {left} bytes for the shape {shape} of {dtype}"
            )
        flat = np.frombuffer(content, dtype=dtype, offset=stream.tell()) if size else np.zeros(0, dtype)
        try:
            return flat.reshape(shape, order="F" if by_columns else "C").copy()
        except ValueError as error:  # no entries, but a side that no array may have
            raise InputError(f"{name}: expected a whole array, found the shape {shape}") from error
