"""Points that chance alone explains: of two wrong sights whose rays meet nearer than any terrain is seen."""

import numpy as np

from pancam_graph.base.geometry import BoolArray
from pancam_graph.solve._chance_links import accident
from pancam_graph.solve._problem import Problem

__all__ = ["chance_points"]

_EXPECTED = 0.05
"""Accidents expected among the rejected measurements, from which on there may be one."""
_LEAST = 20
"""Least points that three measurements or more agree on, for these to say how near terrain is seen."""
_NEARER = 0.8
"""Share of the distance of the nearest of these, below which two measurements are not believed."""


def chance_points(problem: Problem, cutoff_px: float) -> BoolArray:
    """Accepted measurements (n,) of points that chance alone explains.

    Two wrong measurements agree by accident where their rays pass each other within `cutoff_px`, at any
    distance. Most such points do little harm, but one at the distance of a baseline tells where cameras sit
    on the mast better than all terrain does. Three measurements do not agree by accident, so that the points
    which they see say how near terrain is.
    """
    m, kept = problem.measurements, problem.kept
    outside = np.zeros(len(m.row), dtype=bool)
    if float(np.sum(~problem.accepted)) * accident(problem, cutoff_px) < _EXPECTED:
        return outside
    distance = np.linalg.norm(problem.points_m()[m.landmark] - problem.views.world_t_camera[m.image], axis=1)
    nearest = np.full(m.n_landmarks, np.inf)
    np.minimum.at(nearest, m.landmark[kept], distance[kept])
    count = np.bincount(m.landmark[kept], minlength=m.n_landmarks)
    if int(np.sum(count >= 3)) < _LEAST:
        return outside
    near = (count == 2) & (nearest < _NEARER * nearest[count >= 3].min())
    return np.asarray(kept & near[m.landmark])
