"""The stages of a solve that tests look into, one after the other."""

from pancam_graph import Solution, SolveOptions, Traverse
from pancam_graph.initialise import Start
from pancam_graph.solve import Fitted, fit, judge, prepare, screen, solution_of

__all__ = ["fitted", "solution_from"]


def fitted(traverse: Traverse, options: SolveOptions, start: Start | None = None) -> Fitted:
    """A traverse as `solve` fits it, before it is judged."""
    return fit(screen(prepare(traverse, options, start)))


def solution_from(fit_: Fitted) -> Solution:
    """The solution that `solve` makes of a fit."""
    return solution_of(judge(fit_))
