"""How the loops of this folder are compiled: they take the spline of images from the room `base`."""

from pathlib import Path

from pancam_graph.base import splines
from pancam_graph.base.compiled import Compiling

__all__ = ["entry"]

entry = Compiling(parts_from=(Path(splines.__file__).parent,)).entry
"""`base.compiled.entry` for functions that may take a part of `base`: an edit there makes them stale."""
