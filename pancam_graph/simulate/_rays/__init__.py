"""Rays against ground, rocks, pebbles and the rover's deck, and the light that comes back.

All detail is a function of the place on the surface, not of the image: a point looks the same from
everywhere. Detail finer than a pixel's footprint is left out, octave by octave.
"""

from pancam_graph.simulate._rays._ground import heights as heights
from pancam_graph.simulate._rays._noise import make_lattice as make_lattice
from pancam_graph.simulate._rays._noise import noises as noises
from pancam_graph.simulate._rays._pixels import trace as trace
from pancam_graph.simulate._rays._rocks import BLOCK as BLOCK
from pancam_graph.simulate._rays._rocks import DIM_FOOT as DIM_FOOT
from pancam_graph.simulate._rays._world import CHANNELS as CHANNELS
from pancam_graph.simulate._rays._world import ROCK_ALBEDO as ROCK_ALBEDO
from pancam_graph.simulate._rays._world import ROCK_COLUMNS as ROCK_COLUMNS
from pancam_graph.simulate._rays._world import ROCK_FORM as ROCK_FORM
from pancam_graph.simulate._rays._world import ROCK_KEY as ROCK_KEY
from pancam_graph.simulate._rays._world import ROCK_RADIUS as ROCK_RADIUS
from pancam_graph.simulate._rays._world import ROCK_TO_BALL as ROCK_TO_BALL
from pancam_graph.simulate._rays._world import ROCK_TOP as ROCK_TOP
from pancam_graph.simulate._rays._world import ROCK_X as ROCK_X
from pancam_graph.simulate._rays._world import ROCK_Y as ROCK_Y
from pancam_graph.simulate._rays._world import ROCK_Z as ROCK_Z
from pancam_graph.simulate._rays._world import Deck as Deck
from pancam_graph.simulate._rays._world import Grids as Grids
from pancam_graph.simulate._rays._world import Scene as Scene
