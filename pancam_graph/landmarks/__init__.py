"""Landmarks as unit 4-vectors, robust losses, and the compiled loops over observations."""

from pancam_graph.landmarks._landmarks import SETTLED as SETTLED
from pancam_graph.landmarks._landmarks import CameraViews as CameraViews
from pancam_graph.landmarks._landmarks import Landmarks as Landmarks
from pancam_graph.landmarks._landmarks import Measurements as Measurements
from pancam_graph.landmarks._landmarks import as_floats as as_floats
from pancam_graph.landmarks._landmarks import evaluate as evaluate
from pancam_graph.landmarks._landmarks import lines_of_sight as lines_of_sight
from pancam_graph.landmarks._landmarks import over_landmarks as over_landmarks
from pancam_graph.landmarks._landmarks import point_sigma_m as point_sigma_m
from pancam_graph.landmarks._landmarks import rays_of as rays_of
from pancam_graph.landmarks._landmarks import refine as refine
from pancam_graph.landmarks._landmarks import residuals as residuals
from pancam_graph.landmarks._landmarks import seen_by as seen_by
from pancam_graph.landmarks._landmarks import triangulate as triangulate
from pancam_graph.landmarks._losses import SQUARED as SQUARED
from pancam_graph.landmarks._losses import Loss as Loss
from pancam_graph.landmarks._losses import LossName as LossName
from pancam_graph.landmarks._losses import loss_of as loss_of
from pancam_graph.landmarks._ranges import InverseRanges as InverseRanges
from pancam_graph.landmarks._ranges import at_inverse_ranges as at_inverse_ranges
from pancam_graph.landmarks._ranges import inverse_ranges as inverse_ranges
