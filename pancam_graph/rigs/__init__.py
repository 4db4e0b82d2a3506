"""Mast rigs: the pan-tilt chain, its eyes, and the templates that ship."""

from pancam_graph.rigs._masts import MARS2020_MAST as MARS2020_MAST
from pancam_graph.rigs._masts import MER_MAST as MER_MAST
from pancam_graph.rigs._masts import MSL_MAST as MSL_MAST
from pancam_graph.rigs._masts import MastKinematics as MastKinematics
from pancam_graph.rigs._rig import Eye as Eye
from pancam_graph.rigs._rig import PointingSigma as PointingSigma
from pancam_graph.rigs._rig import Rig as Rig
from pancam_graph.rigs._templates import TEMPLATES as TEMPLATES
from pancam_graph.rigs._templates import exomars_pancam as exomars_pancam
from pancam_graph.rigs._templates import mer_navcam as mer_navcam
from pancam_graph.rigs._templates import mer_pancam as mer_pancam
from pancam_graph.rigs._templates import rig_template as rig_template
