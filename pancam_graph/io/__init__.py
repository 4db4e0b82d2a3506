"""Readers and writers, one file format a module."""

from pancam_graph.io.cache_folder import cache_folder as cache_folder
from pancam_graph.io.cahvor import read_cahvor as read_cahvor
from pancam_graph.io.camera_models import write_cameras as write_cameras
from pancam_graph.io.colmap import write_colmap as write_colmap
from pancam_graph.io.exports import EXPORTS as EXPORTS
from pancam_graph.io.exports import check_exports as check_exports
from pancam_graph.io.image_files import read_image as read_image
from pancam_graph.io.inputs import read_input as read_input
from pancam_graph.io.pds import read_pds as read_pds
from pancam_graph.io.rendering import check_new as check_new
from pancam_graph.io.rendering import write_rendering as write_rendering
from pancam_graph.io.rendering import write_truth as write_truth
from pancam_graph.io.results import check_out as check_out
from pancam_graph.io.results import save_solution as save_solution
from pancam_graph.io.smoother_npz import load_smoother as load_smoother
from pancam_graph.io.smoother_npz import save_smoother as save_smoother
from pancam_graph.io.solution_json import SolutionFile as SolutionFile
from pancam_graph.io.solution_json import read_solution_json as read_solution_json
from pancam_graph.io.traverse_json import read_traverse as read_traverse
from pancam_graph.io.traverse_json import write_traverse as write_traverse
