"""Uncertainties at a solution: one elimination of the landmarks, then those entries of the inverse needed."""

from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph._problem import Problem
from pancam_graph._reduced import ReducedSystem, held_columns
from pancam_graph.elimination import Covariance, FreeDirectionError
from pancam_graph.errors import SolveError
from pancam_graph.geometry import BoolArray, FloatArray
from pancam_graph.graph import FactorTemplate
from pancam_graph.solution import State

__all__ = ["Uncertainty", "covariance_of", "uncertainty"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Uncertainty:
    """Formal: from the linearised system at the solution, taking noise models at their word."""

    stop_covariance: FloatArray
    """(stops, 6, 6) rotation first, body frame; 0 where held"""
    angle_sigma_rad: FloatArray
    """(frames, 2); 0 where held"""
    landmark_covariance_m2: FloatArray | None
    """(landmarks, 3, 3), if asked for; NaN for those that take no part"""
    undetermined: BoolArray
    """(landmarks,) whether rays leave a direction free that the weak prior alone holds"""


def uncertainty(problem: Problem, state: State, reduced: ReducedSystem, *, landmarks: bool) -> Uncertainty:
    """Covariances, everything else marginalised, from what is left of the landmarks at the problem's values.

    Raises SolveError where a direction is held by nothing.
    """
    template, m, system, rows = problem.template, problem.measurements, reduced.system, reduced.rows
    covariance = covariance_of(template, reduced)
    undetermined = np.zeros(m.n_landmarks, dtype=bool)
    undetermined[rows] = system.undetermined
    spread = None
    if landmarks:
        spread = np.full((m.n_landmarks, 3, 3), np.nan)
        spread[rows] = system.landmark_covariance_m2(covariance)
    return Uncertainty(
        stop_covariance=template.stop_covariance(covariance),
        angle_sigma_rad=template.angle_sigma_rad(covariance, state),
        landmark_covariance_m2=spread,
        undetermined=undetermined,
    )


def covariance_of(template: FactorTemplate, reduced: ReducedSystem) -> Covariance:
    """Covariance of a template's variables where the system was linearised; 0 where held.

    Raises SolveError where a direction is held by nothing.
    """
    try:
        covariance = reduced.root.covariance()
    except FreeDirectionError as error:
        raise SolveError(f"nothing holds {_name(template, error)}") from error
    covariance.release(held_columns(template))
    return covariance


def _name(template: FactorTemplate, free: FreeDirectionError) -> str:
    """What a column of a group is, for a user."""
    t, link = template.traverse, template.linkage
    for key in link.key:
        columns = link.columns_of(key)
        if link.group[link.row[key]] != free.group or not columns.start <= free.column < columns.stop:
            continue
        component, kind = free.column - columns.start, chr(gtsam.symbolChr(key))
        if kind in "MX":
            what = ("rotation about x", "rotation about y", "rotation about z", "x", "y", "z")[component]
            entries = t.stops if kind == "M" else t.images
            return f"the {what} of {entries[gtsam.symbolIndex(key)].id}, with what moves along"
        return f"pan or tilt at {t.stops[free.group].id}" if kind == "A" else "the radius of a circle"
    return "a direction of the solution"
