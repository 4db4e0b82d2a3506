"""Solve a traverse: screen the observations, adjust everything, and say how sure it is."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

from pancam_graph.base.threads import blas_on_one_thread
from pancam_graph.data import Seconds, Solution, Traverse
from pancam_graph.initialise import Start
from pancam_graph.landmarks import kernel
from pancam_graph.solve._adjustment import Adjustment
from pancam_graph.solve._optimise import Iteration
from pancam_graph.solve._options import SolveOptions

__all__ = ["COMPILING", "SolveOptions", "solve"]

_LOG = logging.getLogger(__name__)
COMPILING = "compiling the kernel for this machine: about 20 seconds, once"
"""What the first solve of an installation logs."""


def solve(
    traverse: Traverse,
    options: SolveOptions | None = None,
    *,
    start: Start | None = None,
    on_iteration: Callable[[Iteration], None] | None = None,
) -> Solution:
    """Adjust a traverse that has observations.

    `start` gives first values of the stops and angles where they differ from the priors' centres;
    `on_iteration` is told of every iteration. Deterministic: the same input gives the same output.

    A solve that reaches its iteration limit is returned with `converged` False. Raises InputError for a
    traverse without observations or unknown options, SolveError where no track is seen twice or the system
    has a direction that neither observations nor priors hold.
    """
    if kernel.must_compile():
        _LOG.info(COMPILING)
    times = [time.perf_counter()]
    with blas_on_one_thread():
        adjustment = Adjustment(traverse, options or SolveOptions(), start, on_iteration)
        times.append(time.perf_counter())
        adjustment.solve()
        times.append(time.perf_counter())
        solution = adjustment.solution()
    times.append(time.perf_counter())
    initialise, solving, report = (after - before for before, after in pairwise(times))
    return replace(solution, seconds=Seconds(initialise=initialise, solve=solving, report=report))
