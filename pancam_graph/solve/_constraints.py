"""Constraints of a traverse as part of a problem: they count from the final least squares on.

Outliers are screened without them: a constraint that is wrong must not decide which observations are.
"""

from dataclasses import replace

from pancam_graph.base.errors import InputError
from pancam_graph.data import Traverse
from pancam_graph.graph import check_given, stop_constraints
from pancam_graph.solve._options import SolveOptions
from pancam_graph.solve._problem import Problem

__all__ = ["constrained", "require_constraints"]


def require_constraints(traverse: Traverse, options: SolveOptions, problem: Problem) -> None:
    """Raise InputError for constraints that the options cannot serve, or that fail at the start."""
    template = problem.template
    for i, one in enumerate(traverse.constraints):
        if one.landmarks:
            raise InputError(f"constraints[{i}] ({one.about}): not supported yet")
    given = list(stop_constraints(traverse, template.keys))
    check_given(given, template.seats(given), problem.values)


def constrained(problem: Problem) -> Problem:
    """The problem with the constraints of its traverse; the same object where it has them, or has none."""
    template, given = problem.template, problem.factors.given
    traverse = template.traverse
    if not traverse.constraints or any(one.constraint is not None for one in given):
        return problem
    given = (*given, *stop_constraints(traverse, template.keys))
    return replace(problem, factors=template.factors(given, present=problem.values))
