"""The log of each worker, as a file of its own."""

import logging
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

from distributed import WorkerPlugin

__all__ = ["WorkerLog"]

_LINES = "%(asctime)s %(levelname)s %(name)s: %(message)s"


class WorkerLog(WorkerPlugin):
    """Sends the package's log of every worker, present and to come, to a file in a folder."""

    name = "pancam-graph-log"

    def __init__(self, folder: Path) -> None:
        """`folder` exists where the client is; a worker that cannot write there has no log."""
        self._folder = folder
        self._handler: logging.Handler | None = None
        self._level = logging.NOTSET

    def setup(self, worker: Any) -> None:
        """Begin the log of a worker."""
        file = self._folder / f"{re.sub(r'[^0-9A-Za-z.]+', '-', str(worker.address))}.log"
        with suppress(OSError):
            self._handler = logging.FileHandler(file, encoding="utf-8")
            self._handler.setFormatter(logging.Formatter(_LINES))
            package = logging.getLogger("pancam_graph")
            package.addHandler(self._handler)
            self._level = package.level
            package.setLevel(logging.DEBUG)

    def teardown(self, worker: Any) -> None:
        """End it."""
        if self._handler is not None:
            package = logging.getLogger("pancam_graph")
            package.removeHandler(self._handler)
            package.setLevel(self._level)
            self._handler.close()
