"""Files and folders that appear whole or not at all, also where their writer is killed.

A folder is written under another name beside its place, and renamed. Beside it, while it is written, lies a
file that its writer holds locked: the system lets go of the lock when the process ends, however it ends. What
lies there without a lock was left by a writer that was killed, and `recover` puts it right.
"""

import errno
import fcntl
import logging
import os
import re
import secrets
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from types import FrameType

__all__ = ["recover", "whole_file", "whole_folder"]

_LOG = logging.getLogger(__name__)
_LONGEST_NAME = 200
"""Bytes of a name beside which there is room for more in names of most file systems (255)."""


@dataclass(frozen=True)
class _Beside:
    """What lies beside the place of a folder while it is written."""

    path: Path
    """The place."""
    token: str
    """Eight hexadecimal digits that tell one writer from another."""

    @property
    def lock(self) -> Path:
        """The file that the writer holds locked; there before and after all else."""
        return self._named("lock")

    @property
    def partial(self) -> Path:
        """The new folder."""
        return self._named("partial")

    @property
    def older(self) -> Path:
        """The older folder, between the moment it is moved aside and that at which the new one is there."""
        return self._named("older")

    @property
    def gone(self) -> Path:
        """The older folder while it is deleted."""
        return self._named("gone")

    def _named(self, kind: str) -> Path:
        return self.path.with_name(f".{_stem(self.path)}.{self.token}.{kind}")


def whole_file(path: Path, content: bytes) -> None:
    """Write a file under another name and rename it: a reader sees the old content or the new, whole.

    What a writer that was killed has left under the other name is overwritten.
    """
    partial = path.with_name(f".{_stem(path)}.partial")
    try:
        descriptor = _locked(partial)
    except OSError:  # no locks on this file system, or something else of that name
        descriptor = None
    if descriptor is None:  # another writer is at it
        partial = path.with_name(f".{_stem(path)}.{secrets.token_hex(4)}.partial")
        descriptor = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        with os.fdopen(os.dup(descriptor), "wb") as file:  # some file systems fail when a file is closed
            file.truncate()
            file.write(content)
        partial.replace(path)
    except BaseException as error:  # an interrupt from the keyboard too
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:  # a full disk does not say whose
            error.filename = str(path)
        raise
    finally:
        os.close(descriptor)


@contextmanager
def whole_folder(path: Path, *, keep: str | None = None) -> Iterator[Path]:
    """A new folder beside `path` to write into, renamed to `path` when the block ends.

    What was at `path` is moved aside just before the renaming and deleted just after it, except for its entry
    of the name `keep`, which moves into the new folder. If the block raises or the renaming fails, the new
    folder is deleted and `path` is as before. Missing parents are made. If the process is killed, `recover`
    brings back the older folder; it is called here first. An interrupt during the renaming waits until
    that is done, and its text then says that `path` was written.
    """
    path = path.resolve()  # a link stays, and what it leads to is replaced
    path.parent.mkdir(parents=True, exist_ok=True)
    recover(path, keep=keep)
    is_written = False
    try:
        with _claimed(path) as beside:
            partial, older = beside.partial, beside.older
            try:
                partial.mkdir()
                yield partial
                with _uninterrupted():
                    if path.exists():
                        path.rename(older)
                        if keep is not None and (older / keep).exists():
                            (older / keep).rename(partial / keep)
                    partial.rename(path)
                    is_written = True
                    _delete_older(beside)
            except BaseException:  # an interrupt from the keyboard too
                if not is_written:
                    with _uninterrupted():
                        _undo(beside, keep)
                raise
    except KeyboardInterrupt as interrupt:
        if is_written:
            raise KeyboardInterrupt(f"interrupted; {path} was written whole before") from interrupt
        raise


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Signals to end the program wait while the block runs; then their handlers are called."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread has handlers
        yield
        return
    waiting: list[tuple[int, FrameType | None]] = []
    handlers: dict[int, Callable[[int, FrameType | None], object]] = {}
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        handler = None if number is None else signal.getsignal(number)
        if number is not None and callable(handler):
            handlers[number] = handler
            signal.signal(number, lambda signum, frame: waiting.append((signum, frame)))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number, frame in waiting:
            handlers[number](number, frame)


def recover(path: Path, *, keep: str | None = None) -> None:
    """Put right what writers of a folder left that were killed; what living ones write stays.

    An older folder that was moved aside, and in whose place none had come, is at `path` again, its entry
    `keep` with it. What the writer had made is deleted. Where something else has taken the place since, the
    older folder gets a name beside it, `NAME.older-...`, and a warning is logged. Does nothing where the
    folder beside cannot be read or changed, or is on a file system without locks.
    """
    path = path.resolve()
    ours = re.compile(rf"\.{re.escape(_stem(path))}\.([0-9a-f]{{8}})\.(?:lock|partial|older|gone)")
    try:
        found = [ours.fullmatch(entry.name) for entry in path.parent.iterdir()]
    except OSError:
        return
    for token in sorted({match[1] for match in found if match}):
        beside = _Beside(path, token)
        with suppress(OSError):
            descriptor = _locked(beside.lock)
            if descriptor is not None:
                try:
                    _put_right(beside, keep)
                finally:
                    os.close(descriptor)


def _put_right(beside: _Beside, keep: str | None) -> None:
    """Do for a writer that was killed what it would have done after an exception; its lock is held."""
    path, partial, older = beside.path, beside.partial, beside.older
    if older.exists():
        if partial.exists() or not path.exists():
            _LOG.warning("%s: a run that wrote it was killed; what was there before is there again", path)
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()
        _undo(beside, keep)
    shutil.rmtree(partial, ignore_errors=True)
    shutil.rmtree(beside.gone, ignore_errors=True)
    beside.lock.unlink()


def _undo(beside: _Beside, keep: str | None) -> None:
    """Bring the older folder back, unless the new one has taken its place, and delete the new one."""
    path, partial, older = beside.path, beside.partial, beside.older
    if older.exists():
        if path.exists() and not partial.exists():
            _delete_older(beside)
        else:
            if keep is not None and (partial / keep).exists():
                (partial / keep).rename(older / keep)
            if path.exists():  # somebody else has put something there
                aside = path.with_name(f"{_stem(path)}.older-{beside.token}")
                older.rename(aside)
                _LOG.warning(
                    "%s: what was there before is in %s: something else had taken its place", path, aside
                )
            else:
                older.rename(path)
    shutil.rmtree(partial, ignore_errors=True)


def _delete_older(beside: _Beside) -> None:
    """Delete the older folder, first renamed: one that is half deleted must never come back."""
    with suppress(OSError):
        beside.older.rename(beside.gone)
    shutil.rmtree(beside.gone, ignore_errors=True)


@contextmanager
def _claimed(path: Path) -> Iterator[_Beside]:
    """Names beside a path that are this writer's alone, locked while the block runs."""
    while True:
        beside = _Beside(path, secrets.token_hex(4))
        try:
            descriptor = _locked(beside.lock)
        except OSError as error:
            if not beside.lock.exists():
                raise
            _LOG.debug("%s: no lock (%s): what a killed run leaves here stays", path.parent, error)
            descriptor = os.open(beside.lock, os.O_RDWR)
        if descriptor is not None:
            break
    try:
        yield beside
    finally:
        beside.lock.unlink(missing_ok=True)
        os.close(descriptor)


def _locked(path: Path) -> int | None:
    """Open a file, made if it is missing, and lock it; None where somebody else has it or took it away.

    Raises OSError where it cannot be opened, and on file systems without locks.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(descriptor), os.stat(path)):  # noqa: PTH116  beside fstat
            return descriptor
    except FileNotFoundError:  # its writer has just ended
        pass
    except OSError as error:
        if error.errno not in {errno.EAGAIN, errno.EACCES}:
            os.close(descriptor)
            raise
    os.close(descriptor)
    return None


def _stem(path: Path) -> str:
    """The name of a path, or a digest of a name that is too long to get longer."""
    name = os.fsencode(path.name)
    return path.name if len(name) <= _LONGEST_NAME else sha256(name).hexdigest()[:32]
