"""Errors that a solution's covariance predicts: draws from the covariance, aligned as the real errors are.

They separate the faults of a model from the limits of the information that it is given.
"""

from dataclasses import replace

import numpy as np

from experiments.errors import aligned_centres, distances_percent
from pancam_graph.base.geometry import FloatArray
from pancam_graph.solve import Judged, reduced_of, regular_problem
from pancam_graph.solve._joint import retracted

__all__ = ["DRAWS", "predicted_errors"]

DRAWS = 25
"""Draws from the covariance of each solution; over 50 seeds the median is of 1250."""


def predicted_errors(judged: Judged, seed: int) -> dict[str, float]:
    """Medians over draws of the errors of centres and distances that a finished solve predicts for itself.

    The dictionary is empty for a solution without covariance.
    """
    if not np.isfinite(judged.uncertainty.stop_covariance).all():
        return {}
    t, problem = judged.fitted.screened.prepared.traverse, regular_problem(judged.fitted)
    root = reduced_of(judged.fitted, problem).root
    rng = np.random.default_rng(seed)
    place = problem.views.world_t_camera
    centre_mm, distance_percent = [], []
    for _ in range(DRAWS):
        # R x = z has the covariance (R'R)^-1.
        rows = tuple(np.column_stack([r[:, :-1], rng.normal(size=len(r))]) for r in root.rows)
        step = replace(root, rows=rows).step()
        drawn = problem.template.views(
            retracted(problem.template.linkage, problem.values, step)
        ).world_t_camera
        centre_mm.append(1e3 * _rms(aligned_centres(drawn, place) - place))
        if len(t.stops) > 1:
            distance_percent.append(distances_percent(t, drawn, place))
    medians = {"centre_predicted_mm": float(np.median(centre_mm))}
    if distance_percent:
        medians["distance_predicted_percent"] = float(np.median(distance_percent))
    return medians


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
