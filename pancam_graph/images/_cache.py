"""Results of the front end's steps, kept in files under digests of everything that they depend on."""

import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO
from pathlib import Path
from shutil import rmtree
from socket import gethostname
from tempfile import mkdtemp
from threading import Lock
from typing import Any
from weakref import finalize

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import ClusterError, InputError
from pancam_graph.base.regular_files import is_missing
from pancam_graph.base.sources import source_digest
from pancam_graph.base.whole_files import whole_file
from pancam_graph.images._cache_folder import begin_cache
from pancam_graph.images._held import Held
from pancam_graph.io import NpzFile, prefixed

__all__ = ["Arrays", "Cache", "digest", "key_of", "libraries"]

_LOG = logging.getLogger(__name__)
_SUFFIX = ".npz"
_KEY = "key"
_HELD_BYTES = 128 << 20

Arrays = dict[str, NDArray[Any]]


class Cache:
    """Named arrays by kind and key. A key is a digest of everything that the arrays depend on.

    Nothing in the cache can therefore be out of date: after a change of an image, of the rig, of an option,
    of a module that makes the arrays, of a library's version or of the kind of processor, they are asked for
    by another key. With the arrays a file keeps a digest of them: files that cannot be read, or have other
    content than was written, are logged and made anew. Several threads may ask at once.

    The latest arrays are held in memory. Of those that memory has no room for, what has no file in the folder
    goes into a temporary one, which is deleted with this object.
    """

    def __init__(self, folder: Path | None, most_bytes: int | None = None, must_keep: bool = False) -> None:
        """Keep files in `folder`, which is made when the first is written; None: there is no such folder.

        Where a file cannot be written, a warning is logged; with `must_keep`, `recall` raises ClusterError.
        """
        self._folder = folder
        self._must_keep = must_keep
        self._used: set[Path] = set()
        self._begun = False
        self._beginning = Lock()
        self._aside = _Aside(folder)
        self._held = Held[str, Arrays](most_bytes or _HELD_BYTES, _n_bytes, self._aside.put)

    def recall(self, kind: str, key: str, make: Callable[[], Mapping[str, NDArray[Any]]]) -> Arrays:
        """The arrays kept under a key, or else those that `make` returns, which then are kept.

        They are not to be written to.
        """
        if self._folder is not None:
            self._used.add(self._folder / _file_name(kind, key))

        def find_or_make() -> Arrays:
            found = self._found(kind, key)
            return self._made(kind, key, make) if found is None else found

        return dict(self._held.get(f"{kind} {key}", find_or_make))

    def __reduce__(self) -> tuple[type["Cache"], tuple[Path | None, None, bool]]:
        """Another process gets the folder, in which it must keep all, and nothing of what memory holds."""
        folder = None if self._folder is None else self._folder.resolve()
        return Cache, (folder, None, True)

    def _found(self, kind: str, key: str) -> Arrays | None:
        """The arrays of a file, if there is any."""
        arrays = None if self._folder is None else _read(self._folder / _file_name(kind, key), key)
        return self._aside.get(f"{kind} {key}") if arrays is None else arrays

    def _made(self, kind: str, key: str, make: Callable[[], Mapping[str, NDArray[Any]]]) -> Arrays:
        arrays = dict(make())
        if self._folder is not None:
            path = self._folder / _file_name(kind, key)
            try:
                with self._beginning:
                    if not self._begun:
                        begin_cache(self._folder)
                        self._begun = True
                _write(path, key, arrays)
            except OSError as error:
                if self._must_keep:
                    raise ClusterError(
                        f"{path}: expected room for what a worker on {gethostname()} has found, found none: "
                        f"{error.strerror}"
                    ) from error
                _LOG.warning("%s: not kept: %s", path, error)  # the step works without a cache too
        return arrays

    def forget_others(self) -> None:
        """Delete the cache's files whose keys were not asked for since this object was made."""
        if self._folder is not None and self._folder.is_dir():
            for path in self._folder.glob(f"*-*{_SUFFIX}"):
                if path not in self._used:
                    with suppress(OSError):  # a folder of such a name, or no right to delete
                        path.unlink()

    def forget(self, kind: str) -> None:
        """Delete the cache's files of a kind."""
        if self._folder is not None:
            for path in self._folder.glob(f"{kind}-*{_SUFFIX}"):
                with suppress(OSError):  # as above
                    path.unlink()


class _Aside:
    """Arrays that memory has no room for and no other folder has: in a temporary folder, gone with this."""

    def __init__(self, kept: Path | None) -> None:
        """What has a file in the folder `kept` needs none here."""
        self._kept = kept
        self._folder: Path | None = None
        self._no_room: dict[str, Arrays] = {}
        """What could not be written."""

    def put(self, name: str, arrays: Arrays) -> None:
        """Take arrays by kind and key; memory holds on to what cannot be written."""
        kind, key = name.split(" ")
        file = _file_name(kind, key)
        if any(folder is not None and (folder / file).is_file() for folder in (self._kept, self._folder)):
            return
        try:
            if self._folder is None:
                self._folder = Path(mkdtemp(prefix="pancam-graph-"))
                finalize(self, rmtree, self._folder, ignore_errors=True)
            _write(self._folder / file, key, arrays)
        except OSError as error:
            if not self._no_room:
                _LOG.warning("memory holds what has no room in a temporary folder: %s", error)
            self._no_room[name] = arrays

    def get(self, name: str) -> Arrays | None:
        """The arrays of a kind and key, if they were put here."""
        kind, key = name.split(" ")
        if self._folder is None or name in self._no_room:
            return self._no_room.get(name)
        return _read(self._folder / _file_name(kind, key), key)


def _file_name(kind: str, key: str) -> str:
    return f"{kind}-{key[:40]}{_SUFFIX}"


def _n_bytes(arrays: Arrays) -> int:
    return sum(array.nbytes for array in arrays.values())


def _write(path: Path, key: str, arrays: Arrays) -> None:
    content = BytesIO()
    np.savez(content, **{_KEY: np.array(_mark(key, arrays))}, **arrays)  # type: ignore[arg-type]  # names of ours, none of its options
    whole_file(path, content.getvalue())


def _read(path: Path, key: str) -> Arrays | None:
    if is_missing(path):
        return None
    try:
        file = NpzFile(path)
        with prefixed(path):
            arrays = {name: file.array(name) for name in file.names}
    except InputError as error:
        _LOG.warning("made anew, as it cannot be read: %s", error)
        return None
    stored = arrays.pop(_KEY, None)
    if stored is None or str(stored) != _mark(key, arrays):
        _LOG.warning("%s: belongs to something else, or was changed, and is made anew", path)
        return None
    return arrays


def _mark(key: str, arrays: Mapping[str, NDArray[Any]]) -> str:
    """What a file keeps beside its arrays: their key, and a digest of them."""
    running = hashlib.sha256()
    _feed(running, arrays)
    return f"{key} {running.hexdigest()}"


def digest(*parts: Any) -> str:
    """A digest of values of any depth, of the libraries' versions and of the kind of processor: 64 digits.

    Takes arrays, numbers, text, None, poses, dataclasses, and lists and dictionaries of them; all bits count.
    """
    running = hashlib.sha256(json.dumps(libraries()).encode())
    _feed(running, parts)
    return running.hexdigest()


def key_of(kind: str, calls: Iterable[Callable[..., Any]], alone: Iterable[str], *inputs: Any) -> str:
    """The key of a kind of result: a digest of its inputs and of all modules that its calls run through.

    Of the modules that `alone` names, and of this one, only the own text counts, not what they import.
    """
    return digest(kind, source_digest(*calls, alone=(*alone, __name__)), *inputs)


def _feed(running: Any, value: Any) -> None:
    def put(tag: str, content: bytes = b"") -> None:
        running.update(f"{tag}:{len(content)}:".encode())
        running.update(content)

    if value is None or isinstance(value, bool | int | float | str | complex):
        put(type(value).__name__, repr(value).encode())
    elif isinstance(value, bytes):
        put("bytes", value)
    elif isinstance(value, np.ndarray | np.generic):
        array = np.ascontiguousarray(value)
        put(f"array {array.dtype.str} {array.shape}", array.tobytes())
    elif isinstance(value, gtsam.Pose3):
        put("pose", np.ascontiguousarray(value.matrix()).tobytes())
    elif is_dataclass(value) and not isinstance(value, type):
        put(type(value).__qualname__)
        for field in fields(value):
            put("field", field.name.encode())
            _feed(running, getattr(value, field.name))
    elif isinstance(value, Mapping):
        put("mapping", str(len(value)).encode())
        for name, entry in value.items():
            _feed(running, name)
            _feed(running, entry)
    elif isinstance(value, Sequence):
        put("sequence", str(len(value)).encode())
        for entry in value:
            _feed(running, entry)
    else:
        raise TypeError(f"no digest of {type(value).__name__}")


@cache
def libraries() -> Mapping[str, str]:
    """The versions of the libraries that steps run through, and what the processor can do."""
    versions = {name: _version(name) for name in ("gtsam", "numba", "numpy", "scipy")}
    return {**versions, "OpenCV": cv2.__version__, "features of the processor": cv2.getCPUFeaturesLine()}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:  # built from source, without a record of its version
        return "unknown"
