"""Python's garbage collector in a process that is one command.

What imports make stays to the end of the process. The collector looks at all of it again and again while more
is imported, and once more at the end: about a tenth of a small solve's process.
"""

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["leave_to_the_system", "loading"]

_HEAVY = "gtsam"
"""A module that all work imports: where it is there, the process has begun with something else."""


@contextmanager
def loading() -> Iterator[None]:
    """A context of imports at the start of the work, of which the collector looks at nothing."""
    if _HEAVY in sys.modules or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def leave_to_the_system() -> None:
    """Let the process end without a search for garbage: its memory goes back to the system as it is."""
    gc.freeze()
