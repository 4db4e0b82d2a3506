"""From image files to observations: reading, features, matching, tracks."""

from pancam_graph.images._front_end import find_observations as find_observations
from pancam_graph.images._options import FrontEndOptions as FrontEndOptions
