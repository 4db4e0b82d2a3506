"""Where a stop is: its own variables fitted to its observations, everything else held."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination import LandmarkSystem, Posture
from pancam_graph.factors import LandmarkBlocks
from pancam_graph.graph import read_variable
from pancam_graph.landmarks import loss_of, residuals
from pancam_graph.smoother._placing import Seen, placed_anew
from pancam_graph.smoother._station import Postures, Station, copied
from pancam_graph.solve import InOrder, OnGraph, StopRule, optimise, parameters_of

__all__ = ["Located", "localise"]

_RULE = StopRule(max_iterations=15, relative_decrease=1e-4)


@dataclass(frozen=True, kw_only=True, eq=False)
class Located:
    """A stop's own variables where its observations put them."""

    values: gtsam.Values
    squares: FloatArray
    """(n,) squared whitened residuals of what `localise` was given; infinite behind the camera"""


def localise(
    station: Station,
    values: gtsam.Values,
    seen: Seen,
    priors: Sequence[gtsam.NonlinearFactor],
    *,
    robust: bool,
) -> Located:
    """Fit a station's own variables, by a robust loss if asked for, landmarks following.

    `values` are those of all stations of the patch, whose linkage has the one station free. `seen` are
    landmarks with a place, or fresh ones; `priors` are of the station's variables.
    """
    patch, postures = seen.placed.patch, Postures(values)
    seen = placed_anew(seen, patch.views(postures))
    placed = seen.placed
    loss = loss_of("huber" if robust else "none")
    system = LandmarkSystem(patch.linkage, placed.measurements, placed.landmarks, loss)

    def posture(own: gtsam.Values) -> Posture:
        return patch.posture(postures.moved(station, own))

    blocks = LandmarkBlocks(system, read_variable, posture)
    graph = gtsam.NonlinearFactorGraph()
    for factor in (*priors, *blocks.factors()):
        graph.push_back(factor)
    parameters = parameters_of(_RULE, InOrder(blocks.ordering()))
    outcome = optimise(
        lambda: OnGraph(graph, copied(values, station.own), parameters, {}),
        _RULE,
        n_observations=len(placed.measurements.row),
    )
    blocks.settle(outcome.values)
    views = patch.views(postures.moved(station, outcome.values))
    whitened, in_front = residuals(system.landmarks(), placed.measurements, views)
    squares = np.where(in_front, np.sum(whitened**2, axis=1), np.inf)
    return Located(values=outcome.values, squares=squares)
