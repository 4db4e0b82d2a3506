"""From a traverse to a factor graph: the rig as a factor template, landmarks as a strategy beside it."""

from pancam_graph.graph._landmarks import ExplicitLandmarks as ExplicitLandmarks
from pancam_graph.graph._options import DEFAULT_TIES as DEFAULT_TIES
from pancam_graph.graph._options import Model as Model
from pancam_graph.graph._options import Tie as Tie
from pancam_graph.graph._template import FactorTemplate as FactorTemplate
