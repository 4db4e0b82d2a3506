"""Elimination of landmarks: the Schur complement on the variables of cameras, its square root and inverse."""

from pancam_graph.elimination._dissection import Dissection as Dissection
from pancam_graph.elimination._joint_covariance import JointCovariance as JointCovariance
from pancam_graph.elimination._joint_covariance import PosePlace as PosePlace
from pancam_graph.elimination._joint_covariance import relative_pose_covariance as relative_pose_covariance
from pancam_graph.elimination._linkage import FieldColumns as FieldColumns
from pancam_graph.elimination._linkage import Linkage as Linkage
from pancam_graph.elimination._linkage import Posture as Posture
from pancam_graph.elimination._panels import Covariance as Covariance
from pancam_graph.elimination._panels import FreeDirectionError as FreeDirectionError
from pancam_graph.elimination._panels import Panels as Panels
from pancam_graph.elimination._panels import Root as Root
from pancam_graph.elimination._panels import pattern as pattern
from pancam_graph.elimination._row_spread import RowSpread as RowSpread
from pancam_graph.elimination._stretched_system import StretchedSystem as StretchedSystem
from pancam_graph.elimination._system import LandmarkSystem as LandmarkSystem
from pancam_graph.elimination._system import Room as Room
from pancam_graph.elimination._with_rows import Rows as Rows
from pancam_graph.elimination._with_rows import with_rows as with_rows
