"""Levenberg-Marquardt to the optimum, then Gauss-Newton with free directions taken back to the reference."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.rigs.fit._system import Equations, Place, System

__all__ = ["Optimum", "optimum"]

_MAX_ITERATIONS = 200
_NEARLY = 1e-6
"""Relative gain of a step below which the descent ends."""
_MAX_POLISH = 30
_SMALL_STEP = 1e-9
"""Length of a step, in units of the reference, below which the iteration ends."""
_DAMPING = (1e-3, 1e12)
_FREE = 1.0
"""Singular values below it are of free directions, which the reference determines better than the cameras."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Optimum:
    """The best place, and the equations there by singular values."""

    place: Place
    system: System
    singular_values: FloatArray
    """(sought,) descending: misfit in sigmas by a step of one unit along each direction."""
    directions: FloatArray
    """(sought, sought) a row for each singular value, in units of the unknowns."""
    rank: int
    """Number of directions that are not free."""
    converged: bool
    iterations: int


def optimum(equations: Equations) -> Optimum:
    """The least squares optimum that is nearest to the reference, in its units."""
    place, iterations = _descend(equations)
    rank, settled = None, False
    for _ in range(_MAX_POLISH):
        system = equations.system(place)
        along, values, directions = _factors(system.jacobian)
        # The rank is determined once: a value near the limit could otherwise change sides from step to step.
        rank = int(np.sum(values >= _FREE)) if rank is None else rank
        away = _in_units(equations, place)
        step = -directions[:rank].T @ (along[:, :rank].T @ system.residual / values[:rank])
        step -= directions[rank:].T @ (directions[rank:] @ away)
        iterations += 1
        length = np.abs(step).max(initial=0.0)
        settled = bool(length < _SMALL_STEP)
        place = equations.moved(place, system, step)
        if settled or not np.isfinite(length):
            break
    system = equations.system(place)
    _, values, directions = _factors(system.jacobian)
    return Optimum(
        place=place,
        system=system,
        singular_values=values,
        directions=directions,
        rank=rank or 0,
        converged=settled,
        iterations=iterations,
    )


def _factors(jacobian: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Left vectors, all singular values (also where there are fewer rows than columns), all right vectors."""
    rows, columns = jacobian.shape
    padded: FloatArray = (
        jacobian if rows >= columns else np.vstack([jacobian, np.zeros((columns - rows, columns))])
    )
    left, values, right = np.linalg.svd(padded, full_matrices=False)
    return left[:rows], values, right


def _in_units(equations: Equations, place: Place) -> FloatArray:
    sought = equations.unknowns.sought
    return np.asarray(place.unknowns[sought] / equations.unknowns.sigma[sought])


def _descend(equations: Equations) -> tuple[Place, int]:
    """Nearly the optimum, with the reference as a weak observation of one unit; and the number of steps.

    The observation keeps badly determined directions near the reference on the way. The end need not be
    exact, as the steps that follow converge by themselves.
    """
    place, damping = equations.first_place, _DAMPING[0]
    away = _in_units(equations, place)
    merit = equations.cost(place)
    for iteration in range(_MAX_ITERATIONS):
        system = equations.system(place)
        left, values, directions = _factors(system.jacobian)
        gradient = values * (left.T @ system.residual) + directions @ away
        while True:
            step = -directions.T @ (gradient / ((values**2 + 1) * (1 + damping)))
            moved = equations.moved(place, system, step)
            moved_away = _in_units(equations, moved)
            reached = equations.cost(moved) + float(moved_away @ moved_away)
            if reached <= merit:
                damping = max(damping / 10, 1e-12)
                break
            damping *= 10
            if damping > _DAMPING[1]:  # no lower cost within rounding
                return place, iteration
        gained, merit, place, away = merit - reached, reached, moved, moved_away
        if gained <= _NEARLY * merit:
            return place, iteration + 1
    return place, _MAX_ITERATIONS
