"""Drawing for people: pictures with axes and words."""

from pancam_graph.charts._encoded import encoded as encoded
from pancam_graph.charts._framed import INK as INK
from pancam_graph.charts._framed import STEPS as STEPS
from pancam_graph.charts._framed import Axis as Axis
from pancam_graph.charts._framed import Picture as Picture
from pancam_graph.charts._framed import framed as framed
from pancam_graph.charts._framed import width_px as width_px
from pancam_graph.charts._framed import write as write
from pancam_graph.charts._framed import write_over as write_over
