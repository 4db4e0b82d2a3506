"""Constraints of a traverse as part of a problem: they count from the final least squares on.

Outliers are screened without them: a constraint that is wrong must not decide which observations are.
"""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.cameras import Sensor
from pancam_graph.data import Traverse
from pancam_graph.graph import (
    HardTemplate,
    Sensors,
    Sight,
    check_given,
    landmark_constraints,
    stop_constraints,
)
from pancam_graph.landmarks import Landmarks
from pancam_graph.solve._options import SolveOptions
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._ties import ties_of

__all__ = ["constrained", "require_constraints"]

_IN_FRONT = 1e-3
"""Inverse distance, 1/m, at which a landmark of known coordinates starts that is at infinity or beyond."""
_LARGEST = 2048
"""Nodes of a surface, along an axis, between the points that are tied to it."""


def require_constraints(traverse: Traverse, options: SolveOptions, problem: Problem) -> None:
    """Raise InputError for constraints that the options cannot serve, or that fail at the start."""
    template, seen = problem.template, _tracks(problem)
    for i, one in enumerate(traverse.constraints):
        if not one.landmarks:
            continue
        where = f"constraints[{i}] ({one.about})"
        if not options.is_usual:
            raise InputError(
                f"{where}: expected the model mast, a hard tie, eliminated landmarks and the joint method, "
                f"found {options.model}, {options.firm_tie}, {options.landmarks} and {options.method}"
            )
        for landmark in one.landmarks:
            if traverse.track_of(landmark, where) not in seen:
                raise InputError(
                    f"{where}: expected a point that two or more images see, found it in fewer; a place or a "
                    "direction that one image sees is a frame-point or a frame-direction"
                )
    given = list(stop_constraints(traverse, template))
    check_given(given, template.seats(given), problem.values)


def constrained(problem: Problem, *, placed: bool = True) -> Problem:
    """The problem with the constraints of its traverse; the same object where there are none.

    Raises InputError for a surface that does not cover its point, where points are `placed` as well as
    pictures can.
    """
    template = problem.template
    traverse = template.traverse
    if not traverse.constraints:
        return problem
    given = [one for one in problem.factors.given if one.constraint is None]
    given += stop_constraints(traverse, template)
    made = ties_of(traverse, _tracks(problem))
    if made is None:
        return replace(problem, factors=template.factors(given, present=problem.values))
    sights, ties = made
    assert isinstance(template, HardTemplate)  # `require_constraints` has looked
    near = [s.kind in {Sensor.COORDINATES, Sensor.SURFACE} for s in sights]
    problem = replace(problem, ties=ties, landmarks=_in_front(problem.landmarks, ties.landmark[near]))
    place_m = problem.points_m()[ties.landmark]
    if placed:
        _require_surfaces(problem, sights, place_m)
    sensors = Sensors.of(sights, place_m)
    template, values = template.sensing(sensors), gtsam.Values(problem.values)
    sensors.insert(values)
    given += landmark_constraints(traverse, sensors.point_keys)
    return replace(problem, template=template, values=values, factors=template.factors(given, present=values))


def _require_surfaces(problem: Problem, sights: Sequence[Sight], place_m: FloatArray) -> None:
    """Raise InputError for a surface that does not cover its point, or has too many nodes between several."""
    constraints = problem.template.traverse.constraints
    for sight, place in zip(sights, place_m, strict=True):
        if sight.surface is None:
            continue
        where = f"constraints[{sight.constraint}] ({constraints[sight.constraint].about})"
        if not sight.surface.covers(place[None, :2])[0]:
            x, y = place[:2]
            raise InputError(
                f"{where}: expected a surface with heights two nodes around the point, which is at "
                f"x {x:.2f} m, y {y:.2f} m; found none there"
            )
        of_surface = [p for s, p in zip(sights, place_m, strict=True) if s.surface is sight.surface]
        span = np.ptp(np.array(of_surface)[:, :2], axis=0) / np.abs(sight.surface.step_m)
        if span.max() > _LARGEST:
            raise InputError(
                f"{where}: expected points on one surface within {_LARGEST} nodes of each other, found them "
                f"{span.max():.0f} apart"
            )


def _tracks(problem: Problem) -> IntArray:
    """(landmarks,) track of each landmark."""
    m, observations = problem.measurements, problem.template.traverse.observations
    assert observations is not None  # its measurements are of these
    return np.asarray(observations.track[m.row[m.starts]])


def _in_front(landmarks: Landmarks, rows: IntArray) -> Landmarks:
    """Landmarks with those of `rows` nearer than infinity, along their lines of sight."""
    vector = landmarks.vector.copy()
    length = np.linalg.norm(vector[rows, :3], axis=1)
    vector[rows, 3] = np.maximum(vector[rows, 3], _IN_FRONT * length)
    return replace(landmarks, vector=vector / np.linalg.norm(vector, axis=1, keepdims=True))
