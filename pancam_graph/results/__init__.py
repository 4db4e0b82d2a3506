"""The results folder: every file that an adjustment writes.

What reads and writes terrain is imported when it is asked for: a solve needs no OpenCV.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from pancam_graph.results._camera_models import write_cameras as write_cameras
from pancam_graph.results._colmap import write_colmap as write_colmap
from pancam_graph.results._doors import DOORS as DOORS
from pancam_graph.results._gis import write_gis as write_gis
from pancam_graph.results._outputs import EXPORTS as EXPORTS
from pancam_graph.results._outputs import check_exports as check_exports
from pancam_graph.results._results import check_out as check_out
from pancam_graph.results._results import recover_results as recover_results
from pancam_graph.results._results import write_results as write_results
from pancam_graph.results._rig import calibrated_rig as calibrated_rig
from pancam_graph.results._rig import write_rig as write_rig
from pancam_graph.results._smoother import SMOOTHER_FILE as SMOOTHER_FILE
from pancam_graph.results._solution_json import SolutionFile as SolutionFile
from pancam_graph.results._solution_json import read_solution_json as read_solution_json

if TYPE_CHECKING:
    from pancam_graph.results._convert import Converted as Converted
    from pancam_graph.results._convert import convert as convert
    from pancam_graph.results._plots import check_plots as check_plots
    from pancam_graph.results._plots import write_plots as write_plots
    from pancam_graph.results._refined_drive import read_drive as read_drive
    from pancam_graph.results._register import Registered as Registered
    from pancam_graph.results._register import register as register
    from pancam_graph.results._terrain import write_terrain_of as write_terrain_of
else:
    _LATE = {
        "Converted": "_convert",
        "Registered": "_register",
        "check_plots": "_plots",
        "convert": "_convert",
        "read_drive": "_refined_drive",
        "register": "_register",
        "write_plots": "_plots",
        "write_terrain_of": "_terrain",
    }

    def __getattr__(name: str) -> object:
        if name not in _LATE:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(f"{__name__}.{_LATE[name]}"), name)
        return value
