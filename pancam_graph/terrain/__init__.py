"""Terrain from refined stereo: dense surfaces with sigmas, as grids, pictures, meshes and clouds."""

from pancam_graph.terrain._agreement import Agreement as Agreement
from pancam_graph.terrain._agreement import PairAgreement as PairAgreement
from pancam_graph.terrain._drive import Drive as Drive
from pancam_graph.terrain._drive import drive_of as drive_of
from pancam_graph.terrain._extra import require_extra as require_extra
from pancam_graph.terrain._fused import Fused as Fused
from pancam_graph.terrain._make import Terrain as Terrain
from pancam_graph.terrain._make import make_terrain as make_terrain
from pancam_graph.terrain._registration import CELLS_PER_PIXEL as CELLS_PER_PIXEL
from pancam_graph.terrain._registration import Registration as Registration
from pancam_graph.terrain._registration import register_stop as register_stop
from pancam_graph.terrain._section import Section as Section
from pancam_graph.terrain._shown import Relief as Relief
from pancam_graph.terrain._shown import ShownSurface as ShownSurface
from pancam_graph.terrain._shown import WrittenTerrain as WrittenTerrain
from pancam_graph.terrain._terrain_options import TerrainOptions as TerrainOptions
from pancam_graph.terrain._write import TERRAIN_INDEX as TERRAIN_INDEX
from pancam_graph.terrain._write import TERRAIN_PAGE as TERRAIN_PAGE
from pancam_graph.terrain._write import write_terrain as write_terrain
