"""How a program ends: exit status, one sentence for bad input, a report of a fault of the program itself."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

from pancam_graph.base.errors import PancamGraphError
from pancam_graph.base.text import shortened
from pancam_graph.cli._fault import write_fault_report
from pancam_graph.cli._streams import flush_all, ready_streams, silence, write

__all__ = ["BAD_INPUT", "INTERRUPTED", "run", "status_of"]

BAD_INPUT = 2
INTERRUPTED = 130


def run(main: Callable[[], int]) -> NoReturn:
    """Run a program, and end the process as `status_of` says."""
    sys.exit(status_of(main))


def status_of(main: Callable[[], int]) -> int:
    """Run a program and return its exit status; a failure is one sentence on standard error.

    2 for bad input, for too little memory, and for a fault of the program itself, of which a full report is
    written into the temporary folder; 130 for Ctrl-C, SIGTERM and SIGHUP; else what the program returns.
    """
    with ready_streams():
        return _status_of(main)


def _status_of(main: Callable[[], int]) -> int:
    try:
        with _signals_as_interrupt():
            status = main()
    except SystemExit as end:  # argparse: 0 after --help, 2 after a complaint
        status = end.code if isinstance(end.code, int) else 0 if end.code is None else BAD_INPUT
    except BrokenPipeError:  # whoever read standard output has enough
        silence("stdout")
        status = BAD_INPUT
    except (PancamGraphError, OSError) as error:
        write("stderr", shortened(str(error).strip()))
        status = BAD_INPUT
    except KeyboardInterrupt as interrupt:
        write("stderr", str(interrupt) or "interrupted; nothing was written")
        status = INTERRUPTED
    except MemoryError as error:
        detail = f" ({error})" if str(error) else ""
        write("stderr", f"expected more memory than this machine has left{detail}; nothing was written")
        status = BAD_INPUT
    except Exception as error:  # whatever else is raised is a fault of the program
        write("stderr", write_fault_report(error))
        status = BAD_INPUT
    flush_all()
    return status


@contextmanager
def _signals_as_interrupt() -> Iterator[None]:
    """While the block runs, SIGTERM and SIGHUP interrupt the program as Ctrl-C does.

    A signal that is ignored stays so: nohup ignores SIGHUP, a shell Ctrl-C for what runs in the background.
    """
    if threading.current_thread() is not threading.main_thread():  # only it may set handlers
        yield
        return
    came: list[int] = []

    def interrupt(signum: int, frame: FrameType | None) -> NoReturn:
        came.append(signum)
        raise KeyboardInterrupt

    before: dict[int, Any] = {}
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, interrupt)
    try:
        yield
    except Exception as error:
        if came:  # raised within C code, which made an exception of its own of it
            raise KeyboardInterrupt from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
