"""The connection to a scheduler, or to workers of this machine that live as long as it."""

import asyncio
import logging
import os
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pancam_graph.base.errors import ClusterError
from pancam_graph.base.extras import needed

__all__ = ["connected", "dashboard", "log_workers"]

EXTRA = "cluster"
_LOCAL = re.compile(r"local(?::([1-9][0-9]{0,3}))?")
_REMOTE = re.compile(r"(?:tcp|tls|ucx|ws|wss)://[^\s/]+:[0-9]+")
_CONNECT_S = 10.0
_ENVIRONMENT = {
    "PANCAM_GRAPH_THREADS": 1,
    "MALLOC_TRIM_THRESHOLD_": 256 << 20,
    "MALLOC_MMAP_THRESHOLD_": 32 << 20,
}
"""Of workers. What they hold in memory is by the number of threads. The other two are what they keep of
memory that they have freed, bytes: by Dask's choice (64 kB) the system clears each page of each array anew,
which takes nearly as long as the work on pictures."""


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """A distributed.Client, closed at the end of the block.

    `address` is that of a scheduler (tcp://HOST:PORT), or local:N for N processes of this machine with one
    thread each, local for as many as there are cores; these end with the block.

    Raises ClusterError for an address that is none, where nobody listens or somebody else does, and
    InputError where the extra is not installed.
    """
    local = _LOCAL.fullmatch(address)
    if not local and not _REMOTE.fullmatch(address):
        raise ClusterError(
            f"cluster {address!r}: expected the address of a Dask scheduler, as tcp://HOST:8786, or local or "
            "local:N for processes of this machine"
        )
    distributed = needed("distributed", EXTRA)
    if local:
        with _own_workers(distributed, int(local[1] or _cores())) as cluster:
            yield from _as_client(distributed, cluster)
    else:
        _must_answer(distributed, address)
        yield from _as_client(distributed, address)


def _must_answer(distributed: Any, address: str) -> None:
    """Raise ClusterError unless a scheduler answers: a client would wait for ever for somebody else."""

    async def asked() -> Any:
        async with distributed.rpc(address) as somebody:
            return await somebody.identity()

    async def answered() -> Any:
        return await asyncio.wait_for(asked(), _CONNECT_S)

    try:
        # In a thread of its own: that of the caller may have a loop already, as in a notebook.
        with ThreadPoolExecutor(1) as pool:
            found = str(pool.submit(asyncio.run, answered()).result()["type"])
    except Exception as error:  # whatever Dask makes of what somebody says who is no scheduler
        found = f"none in {_CONNECT_S:.0f} s ({type(error).__name__})"
    if found != "Scheduler":
        raise ClusterError(f"cluster {address}: expected a Dask scheduler that listens there, found {found}")


def _as_client(distributed: Any, cluster: Any) -> Iterator[Any]:
    """A client of a cluster, or of the address of a scheduler, until it is closed."""
    client = distributed.Client(cluster, timeout=_CONNECT_S, set_as_default=False)
    try:
        yield client
    finally:
        with suppress(Exception):  # whatever a scheduler that is gone leads to
            client.close(timeout=_CONNECT_S)


@contextmanager
def _own_workers(distributed: Any, n: int) -> Iterator[Any]:
    """Processes of this machine, begun here and not waited for."""
    environment = {
        f"distributed.nanny.pre-spawn-environ.{name}": value for name, value in _ENVIRONMENT.items()
    }
    with needed("dask", EXTRA).config.set(environment):
        cluster = distributed.LocalCluster(
            n_workers=0,
            threads_per_worker=1,
            processes=True,
            dashboard_address=":0",
            silence_logs=logging.CRITICAL,  # a worker that dies is replaced; what matters is raised
        )
        try:
            # A nanny begins a worker again that was killed, but none that was killed while it began.
            cluster.adapt(minimum=n, maximum=n)
            yield cluster
        finally:
            with suppress(Exception):
                cluster.close()


def dashboard(client: Any) -> str | None:
    """The address of the scheduler's own page of progress, if it has one."""
    with suppress(Exception):  # what there is depends on the kind of client and cluster
        if client.run_on_scheduler(_has_page):
            return str(client.dashboard_link)
    return None


def _has_page() -> bool:
    """Whether the scheduler that runs this can draw its page."""
    return find_spec("bokeh") is not None


def log_workers(client: Any, folder: Path) -> None:
    """Have each worker, also those to come, write a log of its own into a folder, which is made.

    Raises OSError where it cannot be made.
    """
    from pancam_graph.cluster._worker_log import WorkerLog  # noqa: PLC0415  it needs the extra

    folder.mkdir(parents=True, exist_ok=True)
    client.register_plugin(WorkerLog(folder.resolve()))


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
