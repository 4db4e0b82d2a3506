"""A recorded traverse solved stop by stop: its solution, with cost and time of each stop."""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import IntArray
from pancam_graph.base.options import options_of
from pancam_graph.base.threads import blas_on_one_thread
from pancam_graph.data import (
    FIXED,
    Frame,
    Image,
    Incremental,
    Observations,
    Seconds,
    Solution,
    Stop,
    Traverse,
)
from pancam_graph.graph import HardTemplate, UserFactors
from pancam_graph.smoother._ledger import Fate
from pancam_graph.smoother._order import order_of_stops
from pancam_graph.smoother._smoother import TraverseSmoother
from pancam_graph.smoother._smoother_options import SmootherOptions, Update
from pancam_graph.solve import (
    SolveOptions,
    fitted_elsewhere,
    free_numbers,
    judge,
    prepare,
    reconsidered,
    screened_again,
    screened_elsewhere,
    solution_of,
)

__all__ = ["solve_incrementally", "stops_of"]

_LOG = logging.getLogger(__name__)


def stops_of(traverse: Traverse) -> Iterator[tuple[Stop, list[Frame], list[Image], Observations]]:
    """A traverse's stops, each as `TraverseSmoother.add_stop` takes it.

    Raises InputError for a traverse without observations.
    """
    observations = traverse.observations
    if observations is None:
        raise InputError("observations: expected some, found none; find them in the images first")
    of_stop = traverse.image_stop[observations.image]
    for number, stop in enumerate(traverse.stops):
        frames = [traverse.frames[i] for i in np.flatnonzero(traverse.frame_stop == number)]
        rows = np.flatnonzero(traverse.image_stop == number)
        of_this_stop = observations.select(of_stop == number)
        images = [traverse.images[i] for i in rows]
        yield stop, frames, images, replace(of_this_stop, image=np.searchsorted(rows, of_this_stop.image))


def solve_incrementally(
    traverse: Traverse,
    options: SolveOptions | None = None,
    *,
    on_stop: Callable[[Update], None] | None = None,
    factors: UserFactors | None = None,
) -> Solution:
    """Solve a traverse by adding its stops one by one to a smoother; `on_stop` is called after each.

    Their order is that of the file as long as each shares tracks with the one before (`order_of_stops`).

    `factors` as for `solve`; they are added after the last stop.

    Raises InputError for options that the smoother lacks: another model than the rigid mast, explicit
    landmarks, and alternation. Of the robust loss only "none" counts, which turns the test for outliers off.
    """
    options = options_of(SolveOptions, options, "solve_incrementally")
    for name, chosen, expected in (
        ("model", options.model, "mast"),
        ("tie", options.firm_tie, "hard"),
        ("landmarks", options.landmarks, "eliminated"),
        ("method", options.method, "joint"),
    ):
        if chosen != expected:
            raise InputError(f"incremental: {name}: expected {expected}, found {chosen}")
    if traverse.observations is not None:
        traverse.observations.noise.require_even()
    begin, sharing = time.perf_counter(), free_numbers(traverse, options)
    smoother = TraverseSmoother(
        traverse.rig,
        SmootherOptions(
            # What is considered enters sigmas alone, and these are `solve`'s.
            rig="estimated" if options.rig == "estimated" else "held",
            sharing=sharing,
            outlier_sigma=None if options.loss == "none" else options.outlier_sigma,
        ),
    )
    updates = []
    order, parts = order_of_stops(traverse), list(stops_of(traverse))
    for number, previous in order:
        stop, after = parts[number][0], None if previous is None else traverse.stops[previous].id
        updates.append(smoother.add_stop(*parts[number], after=after))
        _LOG.info("%s: cost %.6g, %.3f s", stop.id, updates[-1].cost, updates[-1].seconds)
        if on_stop is not None:
            on_stop(updates[-1])
    if factors is not None:
        smoother.add_factors_of(HardTemplate(traverse, replace(sharing, field=FIXED)), factors)
    solved = time.perf_counter()
    solution = _as_solution(traverse, options, smoother, [i for i, _ in order], updates, factors)
    done = time.perf_counter()
    return replace(solution, seconds=Seconds(initialise=0.0, solve=solved - begin, report=done - solved))


def _as_solution(
    traverse: Traverse,
    options: SolveOptions,
    smoother: TraverseSmoother,
    order: Sequence[int],
    updates: list[Update],
    factors: UserFactors | None,
) -> Solution:
    """The smoother's estimate as a solution of the traverse.

    `order` has the rows of its stops as they were added. The outliers are judged once more, as `solve` does,
    now that all stops are known: what is kept should not depend on the order in which they came. Rejected
    loop closures stay out.
    """
    assert traverse.observations is not None
    used = np.zeros(len(traverse.observations), dtype=bool)
    unbelieved = used.copy()
    as_added = _rows_as_added(traverse, order)
    used[as_added] = smoother.used
    unbelieved[as_added] = smoother.state().fate == int(Fate.CLOSURE)
    costs = tuple(u.cost for u in updates)
    with blas_on_one_thread():
        prepared = prepare(traverse, options, factors=factors)
        template = prepared.problem.template
        assert isinstance(template, HardTemplate)  # the model and tie that the smoother has
        before = screened_elsewhere(prepared, smoother.values_on(template), used, unbelieved)
        screened = screened_again(before)
        fitted = fitted_elsewhere(
            screened,
            costs if factors is None else (*costs, smoother.cost),
            f"{len(updates)} stops added one by one",
            is_optimum=screened is before,
        )
        solution = solution_of(reconsidered(judge(fitted)))
    by_stop = [updates[int(i)] for i in np.argsort(order)]
    warnings = (w for u in updates for w in u.warnings)
    return replace(
        solution,
        warnings=tuple(dict.fromkeys((*solution.warnings, *warnings))),
        incremental=Incremental(
            seconds_per_stop=tuple(u.seconds for u in by_stop),
            cost_per_stop=tuple(u.cost for u in by_stop),
            relinearised_per_stop=tuple(u.relinearised for u in by_stop),
        ),
    )


def _rows_as_added(traverse: Traverse, order: Sequence[int]) -> IntArray:
    """Rows of the traverse's observations as its stops, in their `order`, bring them."""
    assert traverse.observations is not None
    place = np.argsort(order)
    return np.argsort(place[traverse.image_stop[traverse.observations.image]], kind="stable")
