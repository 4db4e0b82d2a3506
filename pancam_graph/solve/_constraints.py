"""Constraints of a traverse as part of a problem: they count from the final least squares on.

Outliers are screened without them: a constraint that is wrong must not decide which observations are.
"""

from dataclasses import replace

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import IntArray
from pancam_graph.cameras import Sensor
from pancam_graph.data import Traverse
from pancam_graph.graph import HardTemplate, Sensors, check_given, stop_constraints
from pancam_graph.landmarks import Landmarks
from pancam_graph.solve._options import SolveOptions
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._ties import ties_of

__all__ = ["constrained", "require_constraints"]

_IN_FRONT = 1e-3
"""Inverse distance, 1/m, at which a landmark of known coordinates starts that is at infinity or beyond."""


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
                raise InputError(f"{where}: expected a point that two or more images see, found it in fewer")
    given = list(stop_constraints(traverse, template.keys))
    check_given(given, template.seats(given), problem.values)


def constrained(problem: Problem) -> Problem:
    """The problem with the constraints of its traverse; the same object where there are none."""
    template = problem.template
    traverse = template.traverse
    if not traverse.constraints:
        return problem
    given = [one for one in problem.factors.given if one.constraint is None]
    given += stop_constraints(traverse, template.keys)
    problem = replace(problem, factors=template.factors(given, present=problem.values))
    made = ties_of(traverse, _tracks(problem))
    if made is None:
        return problem
    sights, ties = made
    assert isinstance(template, HardTemplate)  # `require_constraints` has looked
    return replace(
        problem,
        template=template.sensing(Sensors.of(sights)),
        ties=ties,
        landmarks=_in_front(problem.landmarks, ties.landmark[[s.kind is Sensor.COORDINATES for s in sights]]),
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
