"""Uncertainties at a solution: one elimination of the landmarks, then those entries of the inverse needed."""

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.sparse import coo_array, csc_array

from pancam_graph._problem import Problem
from pancam_graph.elimination import Covariance, FreeDirectionError, LandmarkSystem, Linkage, Panels
from pancam_graph.errors import SolveError
from pancam_graph.geometry import BoolArray, FloatArray, IntArray
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


def uncertainty(
    problem: Problem, state: State, system: LandmarkSystem, rows: IntArray, *, landmarks: bool
) -> Uncertainty:
    """Covariances, everything else marginalised, from the landmark system of what takes part.

    `rows` are the system's landmarks among all. Raises SolveError where a direction is held by nothing.
    """
    template, m = problem.template, problem.measurements
    covariance = covariance_of(problem, system)
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


def covariance_of(problem: Problem, system: LandmarkSystem) -> Covariance:
    """Covariance of the variables at the problem's values; 0 where held.

    Raises SolveError where a direction is held by nothing.
    """
    template = problem.template
    panels = system.linearise(template.posture(problem.values))
    if template.linkage.key:
        _add(panels, template.linkage, problem.factors.linearize(problem.values))
    held = _columns(template.linkage, template.held_columns())
    panels.hold(held)
    try:
        covariance = panels.root().covariance()
    except FreeDirectionError as error:
        raise SolveError(f"nothing holds {_name(template, error)}") from error
    covariance.release(held)
    return covariance


def _add(panels: Panels, linkage: Linkage, linear: gtsam.GaussianFactorGraph) -> None:
    """Add priors and ties, as GTSAM linearises them."""
    row, column, entry = linear.sparseJacobian_()
    # GTSAM counts from 1, takes keys in ascending order, and appends the right-hand side as a last column.
    keys = sorted(linkage.key)
    dims = [int(linkage.dim[linkage.row[key]]) for key in keys]
    shape = (int(row.max(initial=0)), sum(dims) + 1)
    jacobian = csc_array((entry, (row.astype(int) - 1, column.astype(int) - 1)), shape=shape)[:, :-1]
    own = [linkage.columns_of(key) for key in keys]
    group = np.repeat([int(linkage.group[linkage.row[key]]) for key in keys], dims)
    within = np.concatenate([np.arange(s.start, s.stop) for s in own])
    information = coo_array(jacobian.T @ jacobian)
    i, j = information.coords
    panels.add_entries(group[i], within[i], group[j], within[j], information.data)


def _columns(linkage: Linkage, held: dict[int, IntArray]) -> dict[int, IntArray]:
    """Columns by group, from components by key."""
    out: dict[int, IntArray] = {}
    for key, components in held.items():
        if len(components):
            g = int(linkage.group[linkage.row[key]])
            columns = linkage.columns_of(key).start + components
            out[g] = np.concatenate([out.get(g, np.zeros(0, dtype=np.int64)), columns])
    return out


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
