"""Bundle adjustment of mast camera panoramas on GTSAM.

Read a traverse, find observations in its images where it has none, solve, save::

    traverse = read_input("folder")
    if traverse.observations is None:
        traverse = find_observations(traverse)
    solution = solve(traverse)
    write_results(solution, "out")

A public name is imported from its room when it is first used: `import pancam_graph` alone loads no room.
"""

import logging
import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pancam_graph.base.errors import PancamGraphError as PancamGraphError
    from pancam_graph.data import Frame as Frame
    from pancam_graph.data import Freedom as Freedom
    from pancam_graph.data import Image as Image
    from pancam_graph.data import Observations as Observations
    from pancam_graph.data import Sharing as Sharing
    from pancam_graph.data import Solution as Solution
    from pancam_graph.data import Stop as Stop
    from pancam_graph.data import Traverse as Traverse
    from pancam_graph.images import find_observations as find_observations
    from pancam_graph.io import read_input as read_input
    from pancam_graph.io import read_pds as read_pds
    from pancam_graph.io import read_traverse as read_traverse
    from pancam_graph.io import write_traverse as write_traverse
    from pancam_graph.report import write_report as write_report
    from pancam_graph.results import write_cameras as write_cameras
    from pancam_graph.results import write_colmap as write_colmap
    from pancam_graph.results import write_results as write_results
    from pancam_graph.simulate import Rendering as Rendering
    from pancam_graph.simulate import RenderOptions as RenderOptions
    from pancam_graph.simulate import SimulationOptions as SimulationOptions
    from pancam_graph.simulate import render as render
    from pancam_graph.simulate import simulate as simulate
    from pancam_graph.simulate import write_rendering as write_rendering
    from pancam_graph.smoother import SmootherOptions as SmootherOptions
    from pancam_graph.smoother import TraverseSmoother as TraverseSmoother
    from pancam_graph.solve import CrossValidation as CrossValidation
    from pancam_graph.solve import SolveOptions as SolveOptions
    from pancam_graph.solve import StopRule as StopRule
    from pancam_graph.solve import build_graph as build_graph
    from pancam_graph.solve import cross_validate as cross_validate
    from pancam_graph.solve import graph_keys as graph_keys
    from pancam_graph.solve import solve as solve

__version__ = "0.1.0"

_PUBLIC = {
    "base.errors": ("PancamGraphError",),
    "data": ("Frame", "Freedom", "Image", "Observations", "Sharing", "Solution", "Stop", "Traverse"),
    "images": ("find_observations",),
    "io": ("read_input", "read_pds", "read_traverse", "write_traverse"),
    "report": ("write_report",),
    "results": ("write_cameras", "write_colmap", "write_results"),
    "simulate": (
        "RenderOptions",
        "Rendering",
        "SimulationOptions",
        "render",
        "simulate",
        "write_rendering",
    ),
    "smoother": ("SmootherOptions", "TraverseSmoother"),
    "solve": (
        "CrossValidation",
        "SolveOptions",
        "StopRule",
        "build_graph",
        "cross_validate",
        "graph_keys",
        "solve",
    ),
}
"""The public names by the room that they come from: those imported above for type checkers."""

_ROOM_OF = {name: room for room, names in _PUBLIC.items() for name in names}

__all__ = list(_ROOM_OF)


def __getattr__(name: str) -> object:
    """Import a public name from its room, and keep it. Raises AttributeError for any other name."""
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_ROOM_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """All names: those of the module, and the public ones that were not used yet."""
    return sorted({*globals(), *_ROOM_OF})


class _Package(ModuleType):
    """This package as a module in which no room hides the function of the same name.

    The import system sets each room as an attribute of the package once the room is imported. The rooms
    `solve` and `simulate` have the names of public functions: as attributes these names stay the functions.
    """

    def __setattr__(self, name: str, value: object) -> None:
        """Set an attribute, unless it is a room in place of a public name."""
        if not (name in _ROOM_OF and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package

logging.getLogger(__name__).addHandler(logging.NullHandler())
