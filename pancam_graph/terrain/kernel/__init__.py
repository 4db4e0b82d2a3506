"""Compiled loops of dense matching and of grids."""

from pancam_graph.terrain.kernel._fuse import fuse_cells as fuse_cells
from pancam_graph.terrain.kernel._raster import raster_quads as raster_quads
from pancam_graph.terrain.kernel._resample import resample as resample
from pancam_graph.terrain.kernel._shared import shared_variances as shared_variances
from pancam_graph.terrain.kernel._slanted import FINER as FINER
from pancam_graph.terrain.kernel._slanted import refine_rows as refine_rows
