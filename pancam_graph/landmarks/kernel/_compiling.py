"""How the loops of this folder are compiled: they take the distortions of lenses from the room `cameras`."""

from pancam_graph.base.compiled import Compiling
from pancam_graph.cameras import LENS_SOURCES

__all__ = ["entry"]

entry = Compiling(parts_from=(LENS_SOURCES,)).entry
"""`base.compiled.entry` for functions that may project through a lens: an edit of a lens makes them stale."""
