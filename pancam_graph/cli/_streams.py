"""Text for standard output and standard error, which may be closed or whose reader may have gone."""

import os
import sys
from typing import Literal

__all__ = ["flush_all", "silence", "write"]

Stream = Literal["stdout", "stderr"]


def write(stream: Stream, text: str) -> None:
    """Write a line; where nobody reads any more, write nothing from here on."""
    file = getattr(sys, stream)
    if file is None:  # closed before the program began
        return
    try:
        file.write(f"{text}\n")
        file.flush()
    except BrokenPipeError:
        silence(stream)


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
    streams: tuple[Stream, ...] = ("stdout", "stderr")
    for stream in streams:
        file = getattr(sys, stream)
        if file is not None:
            try:
                file.flush()
            except BrokenPipeError:
                silence(stream)
