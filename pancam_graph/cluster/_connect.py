"""The connection to a scheduler, or to workers of this machine that live as long as it."""

import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from pancam_graph.base.errors import ClusterError
from pancam_graph.base.extras import needed

__all__ = ["EXTRA", "connected"]

EXTRA = "cluster"
_LOCAL = re.compile(r"local(?::([1-9][0-9]{0,3}))?")
_REMOTE = re.compile(r"(?:tcp|tls|ucx|ws|wss)://[^\s/]+:[0-9]+")
_CONNECT_S = 10.0


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
        yield from _as_client(distributed, address)


def _as_client(distributed: Any, cluster: Any) -> Iterator[Any]:
    """A client of a cluster, or of the address of a scheduler, until it is closed."""
    try:
        client = distributed.Client(cluster, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, RuntimeError) as error:
        raise ClusterError(
            f"cluster {cluster}: expected a Dask scheduler that listens there, found none in "
            f"{_CONNECT_S:.0f} s ({' '.join(str(error).split())})"
        ) from error
    try:
        yield client
    finally:
        with suppress(Exception):  # whatever a scheduler that is gone leads to
            client.close(timeout=_CONNECT_S)


@contextmanager
def _own_workers(distributed: Any, n: int) -> Iterator[Any]:
    """Processes of this machine, begun here and not waited for."""
    cluster = distributed.LocalCluster(
        n_workers=0,
        threads_per_worker=1,
        processes=True,
        dashboard_address=":0",
        silence_logs=logging.CRITICAL,  # a worker that dies is replaced; what matters is raised
    )
    try:
        cluster.scale(n)
        yield cluster
    finally:
        with suppress(Exception):
            cluster.close()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
