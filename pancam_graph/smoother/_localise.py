"""Localisation of one stop: its own variables are fitted to its observations, all others held."""

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
from pancam_graph.solve import InOrder, OnGraph, StopRule, optimise

__all__ = ["Located", "localise"]

_RULE = StopRule(max_iterations=15, relative_decrease=1e-4)


@dataclass(frozen=True, kw_only=True, eq=False)
class Located:
    """Optimum of a stop's own variables."""

    values: gtsam.Values
    squares: FloatArray
    """(n,) squared whitened residuals of the measurements; infinite for a landmark behind the camera"""


def localise(
    station: Station,
    values: gtsam.Values,
    seen: Seen,
    priors: Sequence[gtsam.NonlinearFactor],
    *,
    robust: bool,
) -> Located:
    """Fit a station's own variables and the landmarks that it sees; by Huber's loss if `robust`.

    `values` has the variables of all stations in the patch of `seen`, in which this station alone is free.
    `seen` has known and new landmarks; `priors` are factors on the station's variables.
    """
    patch, postures = seen.placed.patch, Postures(values)
    seen = placed_anew(seen, patch.views(postures))
    placed = seen.placed
    loss = loss_of("huber" if robust else "none")
    system = LandmarkSystem(patch.linkage, placed.measurements, placed.landmarks, loss)

    def posture(station_values: gtsam.Values) -> Posture:
        return patch.posture(postures.moved(station, station_values))

    blocks = LandmarkBlocks(system, read_variable, posture)
    graph = gtsam.NonlinearFactorGraph()
    for factor in (*priors, *blocks.factors()):
        graph.push_back(factor)
    outcome = optimise(
        lambda: OnGraph(graph, copied(values, station.own_keys), _RULE, InOrder(blocks.ordering()), {}),
        _RULE,
        n_observations=len(placed.measurements.row),
    )
    blocks.settle(outcome.values)
    views = patch.views(postures.moved(station, outcome.values))
    whitened, in_front = residuals(system.landmarks(), placed.measurements, views)
    squares = np.where(in_front, np.sum(whitened**2, axis=1), np.inf)
    return Located(values=outcome.values, squares=squares)
