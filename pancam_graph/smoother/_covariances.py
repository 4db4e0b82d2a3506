"""Covariances of the mast poses of a drive, from iSAM2."""

from collections.abc import Sequence

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.base.threads import blas_on_one_thread
from pancam_graph.elimination import relative_pose_covariance
from pancam_graph.smoother._engine import Engine
from pancam_graph.smoother._station import Station

__all__ = ["joint_covariance", "relative_covariance"]


def joint_covariance(engine: Engine, stations: Sequence[Station]) -> FloatArray:
    """Joint covariance (6n, 6n) of the mast poses of n stations, in their order; 0 where held."""
    free = [i for i, s in enumerate(stations) if s.mast is not None]
    out = np.zeros((6 * len(stations),) * 2)
    if free:
        with blas_on_one_thread():
            of_free = engine.covariance([m for i in free if (m := stations[i].mast) is not None])
        held = np.zeros(len(out), dtype=bool)
        for i, station in enumerate(stations):
            held[6 * i + station.held_of_mast] = True
        rows = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in free])
        out[np.ix_(rows, rows)] = of_free
        out[held], out[:, held] = 0.0, 0.0
    return out


def relative_covariance(engine: Engine, a: Station, b: Station) -> FloatArray:
    """Covariance (6, 6) of a_T_b; see `relative_pose_covariance`. 0 for a station and itself."""
    if a is b:
        return np.zeros((6, 6))
    values = engine.estimate
    joint = joint_covariance(engine, [a, b])
    return relative_pose_covariance(a.world_T_mast(values), b.world_T_mast(values), joint)
