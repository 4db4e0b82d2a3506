"""Formal uncertainties of a solution, from the inverse of its reduced normal equations."""

from dataclasses import dataclass

import numpy as np
import scipy

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.data import State
from pancam_graph.elimination import Covariance, FreeDirectionError, JointCovariance, Root
from pancam_graph.graph import FactorTemplate, Kind, index_of, kind_of
from pancam_graph.landmarks import Landmarks
from pancam_graph.solve._problem import EliminatedLandmarks, Problem
from pancam_graph.solve._reduced import ReducedSystem, loosened_root

__all__ = ["Uncertainty", "covariance_of", "uncertainty"]

_LOOSER = 10.0
"""Factor on the sigmas of priors that reveals the directions which depend on them."""
_HELD = 10.0
"""Growth of variance by that factor beyond which a direction depends on priors more than on images."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Uncertainty:
    """Formal uncertainties: from the system linearised at the solution, with noise models as given."""

    stop_covariance: FloatArray
    """(stops, 6, 6) of each mast pose, rotation first, radians and metres, body frame; 0 where held"""
    angle_sigma_rad: FloatArray
    """(frames, 2) of pan and tilt; 0 where held"""
    landmark_covariance_m2: FloatArray | None
    """(landmarks, 3, 3) of world points; NaN for landmarks that take no part; None: not computed"""
    undetermined: BoolArray
    """(landmarks,) whether its rays leave a direction undetermined that only the weak prior holds"""
    rig_sigmas: list[FloatArray] | None
    """(entries,) standard deviations of each variable of the rig; None where unknown"""
    unseen: tuple[str, ...] = ()
    """Names of directions of the rig that images do not determine, by the entries of which they consist"""
    masts: JointCovariance | None = None
    """Joint covariances of pairs of mast poses; None where unknown"""
    variables: Covariance | None = None
    """Covariances of the variables, by groups; None where unknown"""


def uncertainty(
    problem: Problem, state: State, reduced: ReducedSystem, *, landmarks: Landmarks | None, unseen: bool
) -> Uncertainty:
    """Marginal covariances at a problem's values, from its reduced system.

    `landmarks` are the places whose covariances are computed; None: of none. `unseen`: whether that is
    computed. Raises SolveError where a direction is undetermined.
    """
    template, m, system, rows = problem.template, problem.measurements, reduced.system, reduced.rows
    covariance = covariance_of(template, reduced)
    undetermined = np.zeros(m.n_landmarks, dtype=bool)
    undetermined[rows] = system.undetermined
    spread = None
    if landmarks is not None:
        spread = np.full((m.n_landmarks, 3, 3), np.nan)
        spread[rows] = _linearised_at(problem, reduced, landmarks).landmark_covariance_m2(covariance)
    return Uncertainty(
        stop_covariance=template.stop_covariance(covariance),
        masts=template.mast_covariance(reduced.root),
        variables=covariance,
        angle_sigma_rad=template.angle_sigma_rad(covariance, state),
        landmark_covariance_m2=spread,
        undetermined=undetermined,
        rig_sigmas=template.rig_sigmas(covariance, problem.values),
        unseen=_unseen(problem, reduced, covariance) if unseen and template.rig_variables.variables else (),
    )


def _linearised_at(problem: Problem, reduced: ReducedSystem, landmarks: Landmarks) -> EliminatedLandmarks:
    """A problem's landmark system linearised at these landmarks; the reduced one's where they are its own."""
    if problem.landmarks is landmarks:
        return reduced.system
    return ReducedSystem.of(problem.at(problem.values, landmarks)).system


def _unseen(problem: Problem, reduced: ReducedSystem, covariance: Covariance) -> tuple[str, ...]:
    """Directions of the rig that priors, of the rig or of telemetry, determine better than images.

    Their variance grows with the sigmas of all priors. An example is a common rotation of all mounts about
    the tilt axis, which images cannot tell from a change of all tilts. Entries without a prior whose sigma is
    far above the usual one are listed too.
    """
    template, link, free = problem.template, problem.template.linkage, problem.template.rig_variables
    loose = _inverse(template, loosened_root(problem, reduced.system, _LOOSER))
    out = []
    for g in sorted({free.group(v) for v in free.variables}):
        of_group = [v for v in free.variables if free.group(v) == g]
        columns = np.concatenate(
            [np.arange(c.start, c.stop) for v in of_group for c in [link.columns_of(v.key)]]
        )
        names = [free.name(v, entry) for v in of_group for entry in v.entries]
        firm, wide = (c.block(g, g)[np.ix_(columns, columns)] for c in (covariance, loose))
        size = np.sqrt(np.diag(firm))
        usual, prior = (np.concatenate([getattr(v, what) for v in of_group]) for what in ("usual", "sigma"))
        out += [names[i] for i in np.flatnonzero(np.isinf(prior) & (size > _LOOSER * usual))]
        firm, wide = firm / np.outer(size, size), wide / np.outer(size, size)
        # The small diagonal keeps the matrix regular where a correlation is 1.
        ratio, functional = scipy.linalg.eigh(wide, firm + 1e-12 * np.eye(len(size)))
        for k in np.flatnonzero(ratio > _HELD)[::-1]:
            direction = np.abs(firm @ functional[:, k])
            most = np.argsort(-direction)
            out.append(" with ".join(names[i] for i in most if direction[i] > 0.5 * direction[most[0]]))
    return tuple(out)


def covariance_of(template: FactorTemplate, reduced: ReducedSystem) -> Covariance:
    """Marginal covariance of a template's variables at the linearisation point; 0 where held.

    Raises SolveError where a direction is undetermined.
    """
    return _inverse(template, reduced.root)


def _inverse(template: FactorTemplate, root: Root) -> Covariance:
    try:
        covariance = root.covariance()
    except FreeDirectionError as error:
        raise SolveError(f"nothing holds {_name(template, error)}") from error
    covariance.release(template.held_by_group)
    return covariance


def _name(template: FactorTemplate, free: FreeDirectionError) -> str:
    """Name of a column of a group, for errors."""
    t, link = template.traverse, template.linkage
    for key in link.key:
        columns = link.columns_of(key)
        if link.group[link.row[key]] != free.group or not columns.start <= free.column < columns.stop:
            continue
        component, kind = free.column - columns.start, kind_of(key)
        if kind in {Kind.MAST, Kind.CAMERA}:
            what = ("rotation about x", "rotation about y", "rotation about z", "x", "y", "z")[component]
            entries = t.stops if kind is Kind.MAST else t.images
            return f"the {what} of {entries[index_of(key)].id}, with what moves along"
        if kind is Kind.PROJECTION:
            return f"an entry of the projection matrix of {t.images[index_of(key)].id}"
        for v in template.rig_variables.variables:
            if v.key == key:
                name = template.rig_variables.name(v, v.entries[component])
                return f"{name} of the rig, with what moves along"
        if kind is Kind.FIELD:
            return f"the smooth field of {t.rig.eyes[index_of(key)].name}"
        if kind is Kind.FLEX:
            return f"the flex of a frame at {t.stops[free.group].id}"
        return f"pan or tilt at {t.stops[free.group].id}"
    return "a direction of the solution"
