"""Bundle adjustment of mast camera panoramas on GTSAM.

Read a traverse, find observations in its images where it has none, solve, save::

    traverse = read_input("folder")
    if traverse.observations is None:
        traverse = find_observations(traverse)
    solution = solve(traverse)
    write_results(solution, "out")
"""

import logging

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
from pancam_graph.solve import cross_validate as cross_validate
from pancam_graph.solve import solve as solve

__version__ = "0.1.0"

logging.getLogger(__name__).addHandler(logging.NullHandler())
