"""Text for standard output and standard error, which may be closed, full, or of any encoding."""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from pancam_graph.base.errors import InputError
from pancam_graph.base.text import visible

__all__ = ["flush_all", "is_terminal", "must_write", "ready_streams", "silence", "write", "write_rendered"]

Stream = Literal["stdout", "stderr"]
_STREAMS: tuple[Stream, ...] = ("stdout", "stderr")


def write(stream: Stream, text: str) -> bool:
    """Write a line, made `visible`; False where there is no room for it.

    Where nobody reads any more, or there is no room, nothing is written from here on: the work goes on, and
    its results do not depend on who watches.
    """
    return write_rendered(stream, f"{visible(text)}\n")


def write_rendered(stream: Stream, text: str) -> bool:
    """Write what is made up for a terminal, as `write` does."""
    file = getattr(sys, stream)
    if file is None:  # closed before the program began
        return False
    try:
        file.write(text)
        file.flush()
    except BrokenPipeError:  # whoever read has had enough
        silence(stream)
    except (OSError, ValueError) as error:  # a full disk; closed within this process
        silence(stream)
        if stream == "stdout":
            write("stderr", f"standard output: expected a place that can be written to, found: {error}")
        return False
    return True


def must_write(text: str) -> None:
    """Write lines of this program that are all that was asked for.

    Raises InputError where standard output takes none.
    """
    if not write_rendered("stdout", text):
        raise InputError("standard output: expected a place that can be written to, found it closed or full")


def is_terminal(stream: Stream) -> bool:
    """Whether somebody may watch a stream."""
    file = getattr(sys, stream)
    try:
        return file is not None and bool(file.isatty())
    except ValueError:  # closed within this process
        return False


@contextmanager
def ready_streams() -> Iterator[None]:
    """While the block runs, a character that the encoding of a stream lacks is written as its escape.

    A stream that was closed before the program began leads nowhere from here on: else the next file that is
    opened would get its number, and what a library prints would end up in results.
    """
    _open_closed()
    changed: list[tuple[io.TextIOWrapper, str]] = []
    for stream in _STREAMS:
        file = getattr(sys, stream)
        if isinstance(file, io.TextIOWrapper) and not file.closed and file.errors is not None:
            changed.append((file, file.errors))
            file.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        for file, errors in changed:
            if not file.closed:
                file.reconfigure(errors=errors)


def _open_closed() -> None:
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free: this one


def silence(stream: Stream) -> None:
    """Send what is still written to the stream nowhere: its reader has gone, and work may go on."""
    try:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, getattr(sys, stream).fileno())
        os.close(nowhere)
    except (OSError, ValueError):  # a stream of a test, without a file below
        setattr(sys, stream, None)


def flush_all() -> None:
    """Write out what the streams hold back, so that the end of the process has no complaint to print."""
    for stream in _STREAMS:
        write_rendered(stream, "")
