"""What the folder of results must know of an output; each output's module fills in an `OutputWriter`."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from pancam_graph.base.errors import ClusterError
from pancam_graph.data import Solution, Traverse
from pancam_graph.results._older import ONE_FILE, Older

if TYPE_CHECKING:  # these import OpenCV, and names of outputs must be cheap
    from pancam_graph.mosaic import MosaicOptions, WrittenMosaics
    from pancam_graph.results._brightness import Brightness
    from pancam_graph.smoother import TraverseSmoother
    from pancam_graph.terrain import TerrainOptions, WrittenTerrain

__all__ = ["Output", "OutputWriter", "Written"]

_LOG = logging.getLogger(__name__)
_MadeT = TypeVar("_MadeT")


@dataclass(frozen=True, kw_only=True, eq=False)
class Written:
    """The solution and what earlier outputs have added to it: what an output is made from."""

    solution: Solution
    """The solution, with the warnings of the outputs so far."""
    brightness: "Brightness"
    mosaic_options: "MosaicOptions | None"
    """How mosaics are drawn; None: none are written."""
    terrain_options: "TerrainOptions | None"
    """How terrain is made; None: none is written."""
    out: Path
    """Where all will be once it is complete."""
    progress: Callable[[str, int, int], None] | None
    """Told of a stage, how many of its parts are done, and how many there are."""
    seconds: Callable[[], float]
    """How long writing has taken so far."""
    client: Any = None
    """A distributed.Client whose workers share the work on pictures, or None."""
    smoother: "TraverseSmoother | None" = None
    """What the drive can go on with, where it was solved stop by stop."""
    mosaics: "WrittenMosaics | None" = None
    """The mosaics, once they are written."""
    terrain: "WrittenTerrain | None" = None
    """The terrain, once it is written."""

    def made_with_workers(self, make: Callable[[Any], _MadeT]) -> _MadeT:
        """What `make` returns with the client; without it where workers or scheduler fail.

        A solve that took long must not be lost for them, and the log has a warning.
        """
        if self.client is None:
            return make(None)
        try:
            return make(self.client)
        except ClusterError as error:
            _LOG.warning("%s; this process goes on alone", error)
            return make(None)


def _anything(traverse: Traverse) -> None:
    """A solution of any traverse can be written."""


@dataclass(frozen=True, kw_only=True)
class OutputWriter:
    """How an output is written."""

    write: Callable[[Written, Path], Written]
    """Write the file, or the files of the folder, at the path; a folder exists and is empty. Returns what it
    was given, with what later outputs need of this one."""
    check: Callable[[Traverse], None] = _anything
    """Raise InputError if a solution of the traverse cannot be written; for before a long solve."""


@dataclass(frozen=True, kw_only=True)
class Output:
    """A file or a folder in the folder of results."""

    name: str
    """Name of the file or folder; an export is asked for by this name."""
    when: Literal["always", "report", "csv", "mosaics", "terrain", "smoother", "export"]
    """The option with which it is written."""
    writer: Callable[[], OutputWriter]
    """Imports the module that writes it and returns its writer; names and choices are listed without."""
    says: str = ""
    """What an export is, as the help of an option says it."""
    older: Older = ONE_FILE
    """How an output of an earlier run is recognised."""
