"""Mast rigs: the pan-tilt chain, its eyes, and the templates that ship."""

from pancam_graph.rigs._exomars import exomars_pancam as exomars_pancam
from pancam_graph.rigs._mars2020 import MARS2020_MAST as MARS2020_MAST
from pancam_graph.rigs._mars2020 import mars2020_mastcam_z as mars2020_mastcam_z
from pancam_graph.rigs._mars2020 import mars2020_navcam as mars2020_navcam
from pancam_graph.rigs._mast import MastKinematics as MastKinematics
from pancam_graph.rigs._mer import MER_MAST as MER_MAST
from pancam_graph.rigs._mer import mer_navcam as mer_navcam
from pancam_graph.rigs._mer import mer_pancam as mer_pancam
from pancam_graph.rigs._msl import MSL_MAST as MSL_MAST
from pancam_graph.rigs._msl import msl_mastcam as msl_mastcam
from pancam_graph.rigs._msl import msl_navcam as msl_navcam
from pancam_graph.rigs._rig import Eye as Eye
from pancam_graph.rigs._rig import PointingSigma as PointingSigma
from pancam_graph.rigs._rig import Rig as Rig
from pancam_graph.rigs._rings import ladybug3 as ladybug3
from pancam_graph.rigs._rings import ladybug5 as ladybug5
from pancam_graph.rigs._stereo import stereo_pan_tilt as stereo_pan_tilt
from pancam_graph.rigs._templates import TEMPLATES as TEMPLATES
from pancam_graph.rigs._templates import rig_template as rig_template
from pancam_graph.rigs._z_down import camera_z_up as camera_z_up
from pancam_graph.rigs._z_down import pose_z_up as pose_z_up
from pancam_graph.rigs.fit._fit import RigFit as RigFit
from pancam_graph.rigs.fit._fit import fit_rig as fit_rig
from pancam_graph.rigs.fit._free_directions import FreeDirection as FreeDirection
from pancam_graph.rigs.fit._system import ReferenceSigma as ReferenceSigma
from pancam_graph.rigs.fit._system import RigFitOptions as RigFitOptions
