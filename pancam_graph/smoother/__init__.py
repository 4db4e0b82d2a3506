"""The drive followed stop by stop: iSAM2 on masts, angles and the rig, landmarks eliminated in blocks."""

from pancam_graph.smoother._file import load_smoother as load_smoother
from pancam_graph.smoother._file import save_smoother as save_smoother
from pancam_graph.smoother._incremental import continued as continued
from pancam_graph.smoother._incremental import smoother_for as smoother_for
from pancam_graph.smoother._incremental import solve_incrementally as solve_incrementally
from pancam_graph.smoother._incremental import stops_of as stops_of
from pancam_graph.smoother._smoother import TraverseSmoother as TraverseSmoother
from pancam_graph.smoother._smoother_options import Closure as Closure
from pancam_graph.smoother._smoother_options import Estimate as Estimate
from pancam_graph.smoother._smoother_options import SmootherOptions as SmootherOptions
from pancam_graph.smoother._smoother_options import Update as Update
from pancam_graph.smoother._state import SmootherState as SmootherState
