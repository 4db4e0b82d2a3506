"""Where compiled code is kept on disk, and that trouble there is no trouble elsewhere.

Numba keeps code beside the source, or in the user's folder of caches. In a container neither may be writable:
then it goes into a folder of the user's among the temporary ones, or is not kept. Files that are empty, cut
off, changed or of something else are made anew. Numba itself fails in both cases, at every start.
"""

import logging
import os
import pickle
import stat
import tempfile
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
import numba.core.caching

__all__ = ["KeptCode", "kept_code"]

_NUMBA: Any = numba
_LOG = logging.getLogger(__name__)
_DIGEST = 32
"""Bytes of a digest, with which a file of code begins."""


class _CheckedFiles(_NUMBA.core.caching.IndexDataCacheFile):  # type: ignore[misc]  # Numba has no types
    """The index and the files of code of a function, each whole or as if it were not there."""

    def __init__(self, **place: Any) -> None:
        super().__init__(**place)
        self._version = f"{numba.__version__} checked"  # an index of Numba's own is one of another version

    def save(self, key: Any, data: Any) -> None:
        """Keep code with its key: two processes at once may give two keys one file."""
        super().save(key, (key, data))

    def load(self, key: Any) -> Any:
        """The code of a key; None where there is none, or none that is whole."""
        try:
            kept_key, data = super().load(key) or (key, None)
        except Exception as error:  # whatever unpickling makes of other bytes
            _say_damaged(self._cache_path, self._index_name, error)
            return None
        return data if kept_key == key else None

    def _load_index(self) -> dict[Any, str]:
        try:
            return dict(super()._load_index())
        except Exception as error:  # as above
            _say_damaged(self._cache_path, self._index_name, error)
            return {}

    def _load_data(self, name: str) -> Any:
        content = Path(self._data_path(name)).read_bytes()
        if sha256(content[_DIGEST:]).digest() != content[:_DIGEST]:
            raise ValueError(f"{name} is not whole")
        return pickle.loads(content[_DIGEST:])

    def _save_data(self, name: str, data: Any) -> None:
        content = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(sha256(content).digest() + content)


class KeptCode(_NUMBA.core.caching.FunctionCache):  # type: ignore[misc]  # as above
    """The code of a function on disk; what cannot be read or written there is compiled anew."""

    def __init__(self, function: Callable[..., Any]) -> None:
        """Raises RuntimeError where no folder can be written to."""
        super().__init__(function)
        self._cache_file = _CheckedFiles(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=self._impl.locator.get_source_stamp(),
        )

    @property
    def is_there(self) -> bool:
        """Whether any code of the function's present source is on disk."""
        return bool(self._cache_file._load_index())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The code for types of arguments; None where there is none."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # code that this process cannot link
            _say_damaged(self._cache_path, self._name, error)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for types of arguments, if there is room."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _LOG.debug("%s: %s", self._name, error)
            _say_lost(f"cannot be written to {self._cache_path}")


def kept_code(function: Callable[..., Any]) -> KeptCode | None:
    """Where the code of a function is kept; None where no folder can be written to."""
    try:
        return KeptCode(function)
    except RuntimeError:
        folder = _temporary_folder()
    if folder is None:
        return None
    before, _NUMBA.config.CACHE_DIR = _NUMBA.config.CACHE_DIR, str(folder)
    try:
        return KeptCode(function)
    except RuntimeError:
        _say_lost(f"cannot be written to {folder}")
        return None
    finally:
        _NUMBA.config.CACHE_DIR = before


@cache
def _temporary_folder() -> Path | None:
    """A folder that nobody else can write to, for what is unpickled from there is run; None without one."""
    try:
        folder = Path(tempfile.gettempdir()) / f"pancam-graph-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        _say_lost(f"has no folder that can be written to ({error})")
        return None
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        _say_lost(f"has no folder that is the user's alone ({folder} is not)")
        return None
    _LOG.warning("compiled code is kept in %s: no other folder for it can be written to", folder)
    return folder


@cache
def _say_lost(why: str) -> None:
    _LOG.warning("compiled code %s: every run compiles anew; NUMBA_CACHE_DIR names another folder", why)


def _say_damaged(folder: str, name: str, error: Exception) -> None:
    _say_folder_damaged(folder)
    _LOG.debug("%s: %s: %s", name, type(error).__name__, error)


@cache
def _say_folder_damaged(folder: str) -> None:
    _LOG.warning("%s: compiled code that cannot be read is made anew", folder)
