"""The log of each worker, as a file of its own."""

import logging
import re
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

from distributed import WorkerPlugin

__all__ = ["WorkerLog"]

_LINES = "%(asctime)s %(levelname)s %(name)s: %(message)s"


class _File(logging.FileHandler):
    """The log file of a worker; several workers may live in one process."""


class WorkerLog(WorkerPlugin):
    """Sends the package's log of every worker, present and to come, to a file in a folder."""

    name = "pancam-graph-log"
    _level_before: ClassVar[int] = logging.NOTSET
    """Level of the package's log before the first worker of this process began its own."""

    def __init__(self, folder: Path) -> None:
        """`folder` exists where the client is; a worker that cannot write there has no log."""
        self._folder = folder
        self._handler: logging.Handler | None = None

    def setup(self, worker: Any) -> None:
        """Begin the log of a worker."""
        file = self._folder / f"{re.sub(r'[^0-9A-Za-z.]+', '-', str(worker.address))}.log"
        package = logging.getLogger("pancam_graph")
        with suppress(OSError):
            self._handler = _File(file, encoding="utf-8")
            self._handler.setFormatter(logging.Formatter(_LINES))
            if not _logs_of_workers(package):
                WorkerLog._level_before = package.level
            package.addHandler(self._handler)
            package.setLevel(logging.DEBUG)

    def teardown(self, worker: Any) -> None:
        """End it; with the last one of a process the level of the log is what it was."""
        if self._handler is not None:
            package = logging.getLogger("pancam_graph")
            package.removeHandler(self._handler)
            self._handler.close()
            if not _logs_of_workers(package):
                package.setLevel(self._level_before)


def _logs_of_workers(package: logging.Logger) -> list[logging.Handler]:
    return [handler for handler in package.handlers if isinstance(handler, _File)]
