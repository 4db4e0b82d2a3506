"""A recorded traverse solved stop by stop: its solution, with cost and time of each stop."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
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
from pancam_graph.smoother._continued import brought_up_to_date, rows_in, what_differs
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

__all__ = ["continued", "smoother_for", "solve_incrementally", "stops_of"]

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
    smoother: TraverseSmoother | None = None,
) -> Solution:
    """Solve a traverse by adding its stops one by one to a smoother; `on_stop` is called after each.

    Their order is that of the file as long as each shares tracks with the one before (`order_of_stops`).

    `factors` as for `solve`; they are added after the last stop. `smoother` is one of `smoother_for`, empty
    or as an earlier call with a part of the drive left it: the stops that it has are not added again, what
    has changed of their observations is, and it is left with the whole drive.

    Raises InputError for options that the smoother lacks: another model than the rigid mast, explicit
    landmarks, and alternation; of the robust loss only "none" counts, which turns the test for outliers off.
    Raises InputError too for a smoother of another drive, saying what differs.
    """
    options = options_of(SolveOptions, options, "solve_incrementally")
    begin = time.perf_counter()
    wanted = _smoother_options(traverse, options)
    if smoother is None:
        smoother = TraverseSmoother(traverse.rig, wanted)
    elif smoother.stops and (why := what_differs(smoother, traverse, wanted)) is not None:
        raise InputError(f"smoother: expected one with the first stops of {traverse.name}, found {why}")
    updates: dict[str, Update] = {}
    order, parts = order_of_stops(traverse), list(stops_of(traverse))
    known, cost_known = frozenset(smoother.stops), smoother.cost
    for number, previous in order:
        stop, after = parts[number][0], None if previous is None else traverse.stops[previous].id
        if stop.id in known:
            continue
        update = updates[stop.id] = smoother.add_stop(*parts[number], after=after)
        _LOG.info("%s: cost %.6g, %.3f s", stop.id, update.cost, update.seconds)
        if on_stop is not None:
            on_stop(update)
    if known:
        brought_up_to_date(smoother, traverse)
    if factors is not None:
        sharing = replace(free_numbers(traverse, options), field=FIXED)
        smoother.add_factors_of(HardTemplate(traverse, sharing), factors)
    solved = time.perf_counter()
    solution = _as_solution(traverse, options, smoother, updates, cost_known, factors)
    done = time.perf_counter()
    return replace(solution, seconds=Seconds(initialise=0.0, solve=solved - begin, report=done - solved))


def smoother_for(traverse: Traverse, options: SolveOptions | None = None) -> TraverseSmoother:
    """An empty smoother as `solve_incrementally` makes one for a traverse; raises InputError as it does."""
    options = options_of(SolveOptions, options, "smoother_for")
    return TraverseSmoother(traverse.rig, _smoother_options(traverse, options))


def continued(path: Path, traverse: Traverse, options: SolveOptions) -> tuple[TraverseSmoother | None, str]:
    """The smoother that a file keeps, if it has the first stops of a traverse; else None, and why not."""
    try:
        smoother = TraverseSmoother.load(path)
        why = what_differs(smoother, traverse, _smoother_options(traverse, options))
    except InputError as error:
        return None, str(error)
    return (smoother, "") if why is None else (None, f"{path} has {why}")


def _smoother_options(traverse: Traverse, options: SolveOptions) -> SmootherOptions:
    """The smoother's options that go with a solve's. Raises InputError for those that it lacks."""
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
    return SmootherOptions(
        # What is considered enters sigmas alone, and these are `solve`'s.
        rig="estimated" if options.rig == "estimated" else "held",
        sharing=free_numbers(traverse, options),
        outlier_sigma=None if options.loss == "none" else options.outlier_sigma,
    )


def _as_solution(
    traverse: Traverse,
    options: SolveOptions,
    smoother: TraverseSmoother,
    updates: Mapping[str, Update],
    cost_known: float,
    factors: UserFactors | None,
) -> Solution:
    """The smoother's estimate as a solution of the traverse.

    `updates` are those of stops that were added now, by id; `cost_known` is the cost of those
    that were there already. The outliers are judged once more, as `solve` does,
    now that all stops are known: what is kept should not depend on the order in which they came. Rejected
    loop closures stay out.
    """
    assert traverse.observations is not None
    used = np.zeros(len(traverse.observations), dtype=bool)
    unbelieved = used.copy()
    row = rows_in(smoother, traverse)
    there = row >= 0
    used[row[there]] = smoother.used[there]
    unbelieved[row[there]] = (smoother.fate == int(Fate.CLOSURE))[there]
    costs = (*([cost_known] if cost_known else []), *(u.cost for u in updates.values()))
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
    by_stop = [updates.get(stop.id) for stop in traverse.stops]
    warnings = (w for u in updates.values() for w in u.warnings)
    return replace(
        solution,
        warnings=tuple(dict.fromkeys((*solution.warnings, *warnings))),
        incremental=Incremental(
            seconds_per_stop=tuple(0.0 if u is None else u.seconds for u in by_stop),
            cost_per_stop=tuple(cost_known if u is None else u.cost for u in by_stop),
            relinearised_per_stop=tuple(0 if u is None else u.relinearised for u in by_stop),
        ),
    )
