"""The option that names a cluster, and its workers while a command needs them."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pancam_graph.cli._command import Invocation
from pancam_graph.cli._parser import CommandParser

__all__ = ["add_cluster_option", "workers"]


def add_cluster_option(parser: CommandParser) -> None:
    """Add the option --cluster."""
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="share the work on pictures among workers of a Dask cluster: tcp://HOST:PORT of its scheduler, "
        "local for a process a core of this machine, local:N for N; workers need pictures and OUT on a file "
        "system in common; needs the extra: pip install 'pancam-graph[cluster]'",
    )


@contextmanager
def workers(call: Invocation) -> Iterator[Any]:
    """A client of the cluster that the user names, else None.

    Its page is told, and with --log each worker has a log.
    """
    if call.arguments.cluster is None:
        yield None
        return
    from pancam_graph.cluster import connected, dashboard, log_workers

    with connected(call.arguments.cluster) as client:
        page = dashboard(client)
        if page is not None:
            call.say(f"the cluster's own page of progress: {page}")
        if call.arguments.log is not None:
            log_workers(client, call.arguments.log.with_name(f"{call.arguments.log.name}.workers"))
        yield client
