"""The rig as a factor template, and landmarks as variables; options that shape a graph."""

from pancam_graph.graph._hard import HardTemplate as HardTemplate
from pancam_graph.graph._landmarks import ExplicitLandmarks as ExplicitLandmarks
from pancam_graph.graph._options import DEFAULT_FLEX as DEFAULT_FLEX
from pancam_graph.graph._options import RIGID as RIGID
from pancam_graph.graph._options import Flex as Flex
from pancam_graph.graph._options import Model as Model
from pancam_graph.graph._options import Tie as Tie
from pancam_graph.graph._projective import ProjectiveTemplate as ProjectiveTemplate
from pancam_graph.graph._rig_variables import RigVariables as RigVariables
from pancam_graph.graph._soft import SoftTemplate as SoftTemplate
from pancam_graph.graph._template import FactorTemplate as FactorTemplate
from pancam_graph.graph._template import diagonal_noise as diagonal_noise
from pancam_graph.graph._template import read_variable as read_variable
