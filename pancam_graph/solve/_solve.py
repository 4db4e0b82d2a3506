"""Solve a traverse: screen the observations, adjust everything, and say how sure it is."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace

from pancam_graph.base.options import options_of
from pancam_graph.base.threads import blas_on_one_thread
from pancam_graph.data import Seconds, Solution, Traverse
from pancam_graph.graph import UserFactors
from pancam_graph.initialise import Start
from pancam_graph.landmarks import kernel
from pancam_graph.solve._fit import fit
from pancam_graph.solve._judge import judge
from pancam_graph.solve._optimise import Iteration
from pancam_graph.solve._options import SolveOptions
from pancam_graph.solve._prepare import prepare
from pancam_graph.solve._reconsider import reconsidered
from pancam_graph.solve._screen import screen
from pancam_graph.solve._solution_of import solution_of

__all__ = ["COMPILING", "SolveOptions", "solve"]

_LOG = logging.getLogger(__name__)
COMPILING = "compiling the kernel for this machine: about half a minute, once"
"""What the first solve of an installation logs."""


def solve(
    traverse: Traverse,
    options: SolveOptions | None = None,
    *,
    start: Start | None = None,
    on_iteration: Callable[[Iteration], None] | None = None,
    factors: UserFactors | None = None,
) -> Solution:
    """Adjust a traverse that has observations.

    `start` gives first values of the stops and angles where they differ from the priors' centres;
    `on_iteration` is told of every iteration. `factors` are GTSAM factors of the caller's on keys of
    `graph_keys(traverse, options)`: they count as observations do, from the first screening to covariances,
    and are never taken for outliers (give them a robust noise model for that). Deterministic: the same
    input gives the same output.

    A solve that reaches its iteration limit is returned with `converged` False. Raises InputError for a
    traverse without observations, unknown options, or a factor that cannot be evaluated at the start,
    SolveError where no track is seen twice or the system
    has a direction that neither observations nor priors hold.
    """
    if kernel.must_compile():
        _LOG.info(COMPILING)
    clock = _Clock()
    with blas_on_one_thread():
        prepared = prepare(traverse, options_of(SolveOptions, options, "solve"), start, on_iteration, factors)
        clock.ended("initialise")
        screened = screen(prepared)
        fitted = fit(screened)
        judged = judge(fitted)
        judged = reconsidered(judged)
        clock.ended("solve")
        solution = solution_of(judged)
        clock.ended("report")
    return replace(solution, seconds=Seconds(**clock.seconds))


class _Clock:
    """Wall-clock seconds of one part after the other."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def ended(self, part: str) -> None:
        """Note what a part took, which began when the one before it ended."""
        now = time.perf_counter()
        self.seconds[part], self._since = now - self._since, now
