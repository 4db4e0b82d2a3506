"""Residuals that a solution would leave with its rig held as told: what estimating the rig has changed."""

from dataclasses import replace

import numpy as np

from pancam_graph.base.errors import PancamGraphError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.base.threads import blas_on_one_thread
from pancam_graph.data import Solution
from pancam_graph.solve._fit import fit
from pancam_graph.solve._options import SolveOptions
from pancam_graph.solve._prepare import prepare
from pancam_graph.solve._screen import screen

__all__ = ["residuals_with_rig_held"]

_ENOUGH = 10_000
"""Observations in use beyond which every n-th terrain point alone is looked at."""
_OPTIONS = SolveOptions(rig="held", loss="none", rescale_noise=False, max_iterations=30)


def residuals_with_rig_held(solution: Solution) -> FloatArray | None:
    """Projected minus measured (observations, 2), raw pixels, of an adjustment with the rig held as told.

    Of the same observations, without another search for outliers, from the solution's poses and angles,
    which take the place of telemetry. Rows that are not looked at are NaN. None where the rig was not
    estimated on a rigid mast, and where such an adjustment fails.
    """
    t, observations = solution.traverse, solution.traverse.observations
    if solution.treatment != "estimated" or not solution.refined or solution.model != "mast":
        return None
    if observations is None or not solution.used.any():
        return None
    _, point = np.unique(observations.track, return_inverse=True)
    every = -(-int(solution.used.sum()) // _ENOUGH)
    rows = np.flatnonzero(solution.used & (point % every == 0))
    angles = solution.final.pan_tilt_rad.tolist()
    places = zip(t.stops, solution.final.world_T_mast, strict=True)
    try:
        part = replace(
            t,
            stops=tuple(replace(stop, world_T_mast=pose) for stop, pose in places),
            frames=tuple(
                replace(frame, pan_rad=pan, tilt_rad=tilt)
                for frame, (pan, tilt) in zip(t.frames, angles, strict=True)
            ),
            observations=observations.select(rows),
            sharing=None,
        )
        with blas_on_one_thread():
            fitted = fit(screen(prepare(part, _OPTIONS)))
    except PancamGraphError:
        return None
    m = fitted.problem.measurements
    whitened, in_front = fitted.problem.residuals
    seen = in_front & fitted.problem.kept
    out = np.full((len(observations), 2), np.nan)
    out[rows[m.row[seen]]] = fitted.noise.select(m.row[seen]).to_pixels(whitened[seen])
    return out
