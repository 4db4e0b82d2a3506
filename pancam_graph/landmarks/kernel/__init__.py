"""Compiled loops over observations and landmarks, on plain arrays.

Everything else of the package works on whole arrays, or once per image, frame or stop.
"""

from pancam_graph.landmarks.kernel._eliminate import eliminate_calibrations as eliminate_calibrations
from pancam_graph.landmarks.kernel._eliminate import eliminate_poses as eliminate_poses
from pancam_graph.landmarks.kernel._eliminate import must_compile as must_compile
from pancam_graph.landmarks.kernel._fields import FieldSights as FieldSights
from pancam_graph.landmarks.kernel._fields import eliminate_fields as eliminate_fields
from pancam_graph.landmarks.kernel._follow import follow as follow
from pancam_graph.landmarks.kernel._follow import landmark_costs as landmark_costs
from pancam_graph.landmarks.kernel._follow import point_covariances as point_covariances
from pancam_graph.landmarks.kernel._loss import BEHIND_COST as BEHIND_COST
from pancam_graph.landmarks.kernel._loss import CAUCHY as CAUCHY
from pancam_graph.landmarks.kernel._loss import HUBER as HUBER
from pancam_graph.landmarks.kernel._loss import NONE as NONE
from pancam_graph.landmarks.kernel._loss import loss_costs as loss_costs
from pancam_graph.landmarks.kernel._loss import loss_weights as loss_weights
from pancam_graph.landmarks.kernel._observe import Cameras as Cameras
from pancam_graph.landmarks.kernel._observe import Seen as Seen
from pancam_graph.landmarks.kernel._observe import evaluate as evaluate
from pancam_graph.landmarks.kernel._observe import free_derivatives as free_derivatives
from pancam_graph.landmarks.kernel._observe import lines_of_sight as lines_of_sight
from pancam_graph.landmarks.kernel._observe import residuals as residuals
from pancam_graph.landmarks.kernel._order import Bearings as Bearings
from pancam_graph.landmarks.kernel._order import Reduced as Reduced
from pancam_graph.landmarks.kernel._order import Sights as Sights
from pancam_graph.landmarks.kernel._order import arrange as arrange
from pancam_graph.landmarks.kernel._outliers import cofactors as cofactors
from pancam_graph.landmarks.kernel._outliers import reject as reject
from pancam_graph.landmarks.kernel._outliers import residual_tests as residual_tests
from pancam_graph.landmarks.kernel._outliers import smallest_information as smallest_information
from pancam_graph.landmarks.kernel._refine import refine as refine
from pancam_graph.landmarks.kernel._shared import connect as connect
from pancam_graph.landmarks.kernel._shared import count_links as count_links
from pancam_graph.landmarks.kernel._shared import count_pairs as count_pairs
from pancam_graph.landmarks.kernel._tiles import add_to_panels as add_to_panels
from pancam_graph.landmarks.kernel._triangulate import triangulate as triangulate
