"""Pointing from pictures of which none is known, or only within many degrees."""

from pancam_graph.images.pointing._find import FoundPointing as FoundPointing
from pancam_graph.images.pointing._find import find_pointing as find_pointing
