"""Bundle adjustment of mast camera panoramas on GTSAM."""

import logging

from pancam_graph.errors import PancamGraphError as PancamGraphError
from pancam_graph.traverse import Frame as Frame
from pancam_graph.traverse import Image as Image
from pancam_graph.traverse import Observations as Observations
from pancam_graph.traverse import Stop as Stop
from pancam_graph.traverse import Traverse as Traverse

__version__ = "0.1.0"

logging.getLogger(__name__).addHandler(logging.NullHandler())
