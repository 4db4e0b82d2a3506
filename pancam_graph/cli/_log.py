"""The log of a run: on standard error, and in a file."""

import logging
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from pancam_graph import __version__
from pancam_graph.base.errors import InputError
from pancam_graph.base.text import shortened, visible
from pancam_graph.cli._streams import is_terminal, write

__all__ = ["check_log_outside", "logged", "show_log"]

_LOG = logging.getLogger(__name__)
_FIRST_LINE = "# log of pancam-graph"


class _Lines(logging.Formatter):
    """Messages as one line each that prints; a traceback has lines of its own."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The line of a message."""
        return visible(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:
        """The lines of a traceback."""
        return visible(super().formatException(ei), lines=True)


class _ToStandardError(logging.Handler):
    """Messages as lines on standard error, each with its level in front."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a message."""
        write("stderr", f"{record.levelname:<8}{record.getMessage()}")


class _Warnings(logging.Handler):
    """Warnings as lines on standard error, as those of a solution stand there."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a message."""
        write("stderr", shortened(f"warning: {record.getMessage()}"))


class _File(logging.FileHandler):
    """Messages in a file; where it can take no more, one warning says so, and the work goes on."""

    _is_full = False

    def handleError(self, record: logging.LogRecord) -> None:
        """Say once that the log is not whole."""
        if not self._is_full:
            self._is_full = True
            write("stderr", f"warning: {self.baseFilename}: the log is not whole: {sys.exc_info()[1]}")

    def close(self) -> None:
        """Close the file; what it could not take before it cannot take now."""
        with suppress(OSError):
            super().close()


@contextmanager
def logged(*, verbose: bool, file: Path | None) -> Iterator[None]:
    """While the block runs, the package's log goes to standard error if `verbose`, and to a file if given.

    If not `verbose`, its warnings alone go to standard error. The file gets everything, with times: what it
    held before stays. Raises InputError where it cannot be written, or holds what is no log of this program.
    """
    root, package = logging.getLogger(), logging.getLogger("pancam_graph")
    levels = root.level, package.level
    handlers = [_standard_error() if verbose else _Warnings(level=logging.WARNING)]
    if file is not None:
        handlers.append(_in_file(file))
    for handler in handlers:
        (root if handler.level < logging.WARNING else package).addHandler(handler)
    if verbose:
        root.setLevel(logging.INFO)
    if file is not None:
        package.setLevel(logging.DEBUG)
    try:
        _LOG.debug("pancam-graph %s: %s", __version__, shlex.join(sys.argv))
        yield
    except BaseException as end:
        _LOG.debug("ended by %s", type(end).__name__, exc_info=True)
        raise
    finally:
        root.setLevel(levels[0])
        package.setLevel(levels[1])
        for handler in handlers:
            root.removeHandler(handler)
            package.removeHandler(handler)
            handler.close()


def show_log(*, verbose: bool) -> None:
    """Send the package's log to standard error from here on, if asked for."""
    if verbose:
        logging.basicConfig(level=logging.INFO, handlers=[_standard_error()])


def check_log_outside(file: Path | None, out: Path) -> None:
    """Raise InputError for a log at the place of the results or in their folder, which is replaced whole."""
    if file is None:
        return
    if out.resolve() == file.resolve():
        raise InputError(f"{file}: expected a log at another place than the results, found the same")
    if out.resolve() in file.resolve().parents:
        raise InputError(f"{file}: expected a log outside {out}, whose content is replaced, found it inside")


def _standard_error() -> logging.Handler:
    if is_terminal("stderr"):
        from rich.logging import RichHandler

        from pancam_graph.cli._terminal import Terminal

        shown: logging.Handler = RichHandler(console=Terminal(stderr=True), level=logging.INFO)
        shown.setFormatter(_Lines("%(message)s"))
        return shown
    return _ToStandardError(level=logging.INFO)


def _in_file(file: Path) -> logging.Handler:
    expected = f"{file}: expected a new file or an older log of this program"
    try:
        has_content = file.is_file() and file.stat().st_size > 0  # neither a device nor a pipe
        if has_content:
            with file.open("rb") as older:
                if older.read(len(_FIRST_LINE)) != _FIRST_LINE.encode():
                    raise InputError(f"{expected}, found something else in it")
        else:
            file.write_text(f"{_FIRST_LINE}\n", encoding="utf-8")
        handler = _File(file, mode="a", encoding="utf-8")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{expected}, found a place that cannot be written to ({reason})") from error
    handler.setLevel(logging.DEBUG)
    handler.setFormatter(_Lines("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    return handler
