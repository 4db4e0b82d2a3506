"""What rays may meet, as arrays that the compiled loops read."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = ["ALBEDO", "CHANNELS", "OUTCROP", "SHADE", "SLOPE_X", "SLOPE_Y", "Deck", "Grids", "Scene"]

Grids = NDArray[np.float32]

SLOPE_X, SLOPE_Y, ALBEDO, OUTCROP, SHADE = range(5)
"""Channels of a node of the ground: its slopes, its reflectance, its share of bare rock (0 to 1), and the
height up to which other ground hides the sun."""
CHANNELS = 5

FIRST, ALONG_X, ALONG_Y = range(3)
"""The shape of a grid: where it begins in its array, its nodes along x and along y."""
X, Y, STEP = range(3)
"""The frame of a grid: x and y of its first node, and the distance between nodes."""

ROCK_X, ROCK_Y, ROCK_Z = range(3)
"""Columns of `Scene.rocks`: centre in the world."""
ROCK_TO_BALL = 3
"""First of nine columns: rotation and scale, by rows, from the world about the centre to the unit ball."""
ROCK_TOP, ROCK_FORM, ROCK_ALBEDO, ROCK_RADIUS, ROCK_KEY = range(12, 17)
"""Height of the top, row in `Scene.forms`, reflectance, radius seen from above, number for fine detail."""
ROCK_COLUMNS = 17


class Scene(NamedTuple):
    """Everything that stands still in the world."""

    height_m: Grids
    """Heights of the nodes of all grids, one grid after the other; x runs fastest."""
    ceiling_m: Grids
    """Upper bound of the ground in each square of 2^k x 2^k meshes, for all k of all grids."""
    surface: Grids
    """Channels of all nodes, mips and grids, CHANNELS numbers a node."""
    height_shape: IntArray
    """(levels, 3): FIRST, ALONG_X and ALONG_Y of each grid in `height_m`."""
    ceiling_shape: IntArray
    """(levels, squarings, 3): those in `ceiling_m`."""
    surface_shape: IntArray
    """(levels, mips, 3): those in `surface`. Each mip has half as many nodes along x and y as the last."""
    frame_m: FloatArray
    """(levels, mips, 3): X, Y and STEP of each grid."""
    steep: float
    """A slope that hardly any ground exceeds."""
    top_m: float
    """Height of the highest ground."""
    rocks: FloatArray
    """(rocks, ROCK_COLUMNS)."""
    forms: FloatArray
    """(forms, planes, 4): unit normal and distance of the planes that cut a ball into a rock's form."""
    cells: IntArray
    """(cells + 1,) where the rocks over a cell start in `cell_rocks`; x runs fastest."""
    cell_rocks: IntArray
    """Rocks over each cell, one cell after the other."""
    cell_top_m: FloatArray
    """Height of the highest rock over a cell, and after all cells, over blocks of them."""
    shaded: IntArray
    """(cells + 1,) where the rocks that shade a cell start in `shaded_rocks`."""
    shaded_rocks: IntArray
    """Rocks whose shadow, or whose dim surroundings, reach into each cell, one cell after the other."""
    cell_frame_m: FloatArray
    """(3,) x and y of the corner of the first cell, and the width of a cell."""
    cell_shape: tuple[int, int]
    """Cells along x and along y."""
    rock_top_m: float
    """Height of the highest rock."""
    lattice: Grids
    """(side, side, 2) random slopes at the nodes of all noise."""
    sun: FloatArray
    """(3,) unit vector to the sun."""
    haze_m: float
    """Distance from which 63 % of the light that arrives is that of the haze."""
    key: int
    """Number that all fine detail is computed from."""


class Deck(NamedTuple):
    """The rover's deck as one mast sees it: flat plates that move along with the mast."""

    rotation: FloatArray
    """(3, 3) world_R_mast."""
    centre_m: FloatArray
    """(3,) of the mast in the world."""
    plates_m: FloatArray
    """(plates, corners, 3): convex, anticlockwise, in the mast frame; none where there is no deck."""
