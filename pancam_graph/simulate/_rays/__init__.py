"""Rays against ground, rocks, pebbles and the rover's deck, and the light that comes back.

All detail is a function of the place on the surface, never of the image: the same point looks the same from
everywhere. Detail finer than a pixel's footprint is left out, octave by octave.
"""

from pancam_graph.simulate._rays._ground import heights as heights
from pancam_graph.simulate._rays._noise import make_lattice as make_lattice
from pancam_graph.simulate._rays._noise import noises as noises
from pancam_graph.simulate._rays._pixels import trace as trace
from pancam_graph.simulate._rays._rocks import BLOCK as BLOCK
from pancam_graph.simulate._rays._rocks import DIM_FOOT as DIM_FOOT
from pancam_graph.simulate._rays._world import CHANNELS as CHANNELS
from pancam_graph.simulate._rays._world import Deck as Deck
from pancam_graph.simulate._rays._world import Grids as Grids
from pancam_graph.simulate._rays._world import Scene as Scene
