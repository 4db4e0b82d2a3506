"""The results folder: every file that an adjustment writes."""

from pancam_graph.results._camera_models import write_cameras as write_cameras
from pancam_graph.results._colmap import write_colmap as write_colmap
from pancam_graph.results._outputs import EXPORTS as EXPORTS
from pancam_graph.results._outputs import check_exports as check_exports
from pancam_graph.results._results import check_out as check_out
from pancam_graph.results._results import recover_results as recover_results
from pancam_graph.results._results import write_results as write_results
from pancam_graph.results._rig import calibrated_rig as calibrated_rig
from pancam_graph.results._rig import write_rig as write_rig
from pancam_graph.results._solution_json import SolutionFile as SolutionFile
from pancam_graph.results._solution_json import read_solution_json as read_solution_json
