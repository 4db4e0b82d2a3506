"""What runs on a worker: what it is and sees, and the tasks of a job."""

import hashlib
import logging
import os
import pickle
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from pancam_graph.base.errors import ClusterError
from pancam_graph.base.threads import blas_on_one_thread, in_this_thread
from pancam_graph.cluster._machine import difference

__all__ = ["Machine", "Parcel", "Probe", "look_around", "run_batch", "worker_name"]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Parcel:
    """A file in the shared folder with what all tasks of a job need, pickled."""

    path: Path
    digest: str
    """SHA-256 of the file: a worker unpickles no other content."""


@dataclass(frozen=True, kw_only=True)
class Probe:
    """What a worker must see: a file that the client has just written, and files to read."""

    path: Path
    content: bytes
    files: Sequence[tuple[Path, int]]
    """Paths and sizes in bytes."""

    def missing(self) -> str | None:
        """What this machine does not see, as the end of a sentence; None: it sees all, and can write."""
        folder = self.path.parent
        try:
            content = self.path.read_bytes()
        except OSError:
            content = None
        if content != self.content:
            return (
                f"expected the folder {folder} as the machine that asks sees it, found another or none: "
                "workers need a file system in common with it"
            )
        for path, size in self.files:
            if _size(path) != size:
                return f"expected the file {path} as the machine that asks sees it, found another or none"
        mine = folder / f"{self.path.name}.{secrets.token_hex(4)}"
        try:
            mine.write_bytes(self.content)
        except OSError as error:
            return f"expected the folder {folder} to write to, found none: {error.strerror}"
        finally:
            mine.unlink(missing_ok=True)
        return None


def _size(path: Path) -> int | None:
    """Size of a file in bytes; None: there is none to be seen."""
    try:
        return path.stat().st_size
    except OSError:
        return None


Machine = tuple[Callable[[], Mapping[str, str]], Mapping[str, str]]
"""A function that says what must be the same everywhere, and what it says at the client's."""


def look_around(machine: Machine, probe: Probe) -> str | None:
    """What this worker lacks to do the work of a client, as the end of a sentence; None: nothing."""
    return difference(machine[1], machine[0]()) or probe.missing()


def run_batch(
    items: Sequence[Any], machine: Machine, function: Callable[[Any, Any], Any], parcel: Parcel
) -> None:
    """Call function(shared, item) for items one by one, each in this thread alone.

    Raises ClusterError where this machine is another than the client's, and for a parcel that it cannot read.
    """
    other = difference(machine[1], machine[0]())
    if other is not None:  # a worker that came after the client had looked
        raise ClusterError(f"worker {worker_name()}: {other}")
    shared, begun_s = _unpacked(parcel), time.perf_counter()
    with blas_on_one_thread(), in_this_thread():
        for item in items:
            function(shared, item)
    _LOG.info("%.3f s: %s", time.perf_counter() - begun_s, items)


@lru_cache(maxsize=1)  # it holds pictures in memory
def _unpacked(parcel: Parcel) -> Any:
    try:
        content = parcel.path.read_bytes()
    except OSError as error:
        raise ClusterError(
            f"worker {worker_name()}: expected the file {parcel.path}, found none to read: {error.strerror}"
        ) from error
    if hashlib.sha256(content).hexdigest() != parcel.digest:
        raise ClusterError(
            f"worker {worker_name()}: expected {parcel.path} as the client wrote it, found other content"
        )
    return pickle.loads(content)  # its digest came with the task


def worker_name() -> str:
    """Address of the worker that runs the calling task, with its process."""
    from distributed import get_worker  # noqa: PLC0415  a worker has it

    return f"{get_worker().address} (process {os.getpid()})"
