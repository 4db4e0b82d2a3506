"""Where compiled code is kept on disk, and that trouble there is no trouble elsewhere.

Code lies beside the source, in the user's folder of caches, or in NUMBA_CACHE_DIR. In a container neither of
the first two may be writable: then it goes into a folder of the user's among the temporary ones, or is not
kept.
Files that are empty, cut off, changed or of something else are made anew: each begins with a digest of the
rest, and says for which function, arguments, sources, processor and versions it was made.
"""

import json
import logging
import os
import secrets
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path

from pancam_graph.base.native_code import NativeCode, environment

__all__ = ["KeptCode"]

_LOG = logging.getLogger(__name__)
_DIGEST = 32
"""Bytes of a digest, with which a file begins; then come the label's length, the label, and the objects."""
_ENDING = ".native"


@dataclass(frozen=True, kw_only=True)
class KeptCode:
    """The code of an entry point on disk; what cannot be read or written there is compiled anew."""

    folder: Path
    """Folder of its source."""
    name: str
    """Module and qualified name."""
    sources: Callable[[], str]
    """Returns the digest of the sources that it depends on."""

    @property
    def is_there(self) -> bool:
        """Whether any code of the present sources is on disk, for this processor and these versions."""
        for folder in _folders(self.folder):
            with suppress(OSError):
                if any(self._read(p, None) is not None for p in folder.glob(f"{self._begin}-*{_ENDING}")):
                    return True
        return False

    def found(self, kinds: str) -> Iterator[NativeCode]:
        """The code for types of arguments, in each folder that has it whole."""
        for folder in _folders(self.folder):
            code = self._read(folder / self._file(kinds), kinds)
            if code is not None:
                yield code

    def keep(self, kinds: str, code: NativeCode) -> None:
        """Keep code for types of arguments, in the first folder that takes it."""
        label = json.dumps(
            {
                **self._what(kinds),
                "outside": code.outside,
                "returns": code.returns,
                "sizes": [len(content) for content in code.objects],
            }
        ).encode()
        content = b"".join((len(label).to_bytes(4), label, *code.objects))
        content = sha256(content).digest() + content
        folder = _place(self.folder)
        if folder is None:
            return
        try:
            _write(folder, self._file(kinds), content)
        except OSError as error:
            _LOG.debug("%s: %s", self.name, error)
            _say_lost(f"cannot be written to {folder}")

    def say_damaged(self, error: Exception) -> None:
        """Say, once for all functions, that code on disk cannot be used."""
        _say_damaged(self.folder, self.name, error)

    def say_lost(self, why: str) -> None:
        """Say, once for all functions, that code is not kept."""
        _say_lost(why)

    @property
    def _begin(self) -> str:
        return f"{self.name}-{self.sources()}"

    def _file(self, kinds: str) -> str:
        return f"{self._begin}-{sha256(f'{kinds} {environment()}'.encode()).hexdigest()[:16]}{_ENDING}"

    def _what(self, kinds: str) -> dict[str, str]:
        """What tells this code from all other."""
        return {
            "name": self.name,
            "sources": self.sources(),
            "environment": environment(),
            "kinds": kinds,
        }

    def _read(self, path: Path, kinds: str | None) -> NativeCode | None:
        """The code in a file, for types of arguments or for any; None where there is none, or not this."""
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            _say_damaged(path.parent, path.name, error)
            return None
        try:
            return self._taken(content, kinds)
        except (ValueError, TypeError, KeyError, AttributeError) as error:  # a label of something else
            _say_damaged(path.parent, path.name, error)
            return None

    def _taken(self, content: bytes, kinds: str | None) -> NativeCode | None:
        """As `_read`. Raises ValueError for content that is not whole."""
        rest = memoryview(content)[_DIGEST:]
        if len(rest) < 4 or sha256(rest).digest() != content[:_DIGEST]:
            raise ValueError("is not whole")
        length = int.from_bytes(rest[:4])
        label = json.loads(bytes(rest[4 : 4 + length]))
        if any(label.get(k) != v for k, v in self._what(kinds or label.get("kinds")).items()):
            return None
        objects, begin = list[bytes](), 4 + length
        for size in label["sizes"]:
            objects.append(bytes(rest[begin : begin + size]))
            begin += size
        return NativeCode(objects=tuple(objects), outside=tuple(label["outside"]), returns=label["returns"])


def _write(folder: Path, name: str, content: bytes) -> None:
    """Write a file whole, or raise OSError; several processes may write it at once."""
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f"{name}.{secrets.token_hex(4)}"
    try:
        partial.write_bytes(content)
        partial.replace(folder / name)
    except OSError:
        with suppress(OSError):
            partial.unlink()
        raise


def _folders(source: Path) -> list[Path]:
    """Where code of a folder of sources may lie, the best place first."""
    folders, place = _usual(source), _place(source)
    return folders if place is None or place in folders else [*folders, place]


def _usual(source: Path) -> list[Path]:
    named, caches = os.environ.get("NUMBA_CACHE_DIR", ""), os.environ.get("XDG_CACHE_HOME", "")
    if named:
        return [Path(named)]
    try:
        home = Path(caches) if caches else Path.home() / ".cache"
    except RuntimeError:  # a user without a home
        return [source / "__pycache__"]
    return [source / "__pycache__", home / "pancam-graph" / "compiled"]


def _place(source: Path) -> Path | None:
    """Where code of a folder of sources is written; None where no folder can be written to."""
    return next((f for f in _usual(source) if _is_writable(f)), None) or _temporary_folder()


def _is_writable(folder: Path) -> bool:
    """Whether a folder, or the first one above it that there is, can be written to."""
    there = next((f for f in (folder, *folder.parents) if f.exists()), folder)
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


@cache
def _temporary_folder() -> Path | None:
    """A folder that nobody else can write to, for the code in it is run; None without one."""
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


def _say_damaged(folder: Path, name: str, error: Exception) -> None:
    _say_folder_damaged(folder)
    _LOG.debug("%s: %s: %s", name, type(error).__name__, error)


@cache
def _say_folder_damaged(folder: Path) -> None:
    _LOG.warning("%s: compiled code that cannot be read is made anew", folder)
