"""Work over all cores: ranges of items for compiled loops, and tasks whose libraries release the lock."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import cache
from threading import local
from typing import TypeVar

from threadpoolctl import ThreadpoolController

from pancam_graph.base.errors import InputError

__all__ = ["blas_on_one_thread", "each", "in_order", "in_parallel", "n_workers"]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_AHEAD = 2
"""Items for each worker that `in_order` hands over before their turn."""
_VARIABLE = "PANCAM_GRAPH_THREADS"


class _Thread(local):
    """What each thread knows of itself."""

    is_busy = False
    """Whether it works on one of several ranges."""


_THREAD = _Thread()


def n_workers() -> int:
    """How many threads work at once: PANCAM_GRAPH_THREADS, or as many as there are cores to run on.

    Raises InputError where the variable is no positive whole number.
    """
    text = os.environ.get(_VARIABLE, "")
    if text:
        if not (text.isascii() and text.isdigit() and int(text) > 0):
            raise InputError(f"{_VARIABLE}: expected a positive whole number, found {text!r}")
        return int(text)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_parallel(function: Callable[[int, int], None], n: int, *, grain: int) -> None:
    """Call function(begin, end) over consecutive ranges of 0 to n, of about `grain` items each.

    The ranges depend on n and the grain alone, never on the number of threads; each item is in one of them.
    Where there is one range, or one thread, everything runs in the caller's; so does what one of several
    ranges calls this for. Raises the exception of the first range that failed, when no range runs any more.
    """
    n_ranges = max(min(n, 1), round(n / grain))
    ranges = [(n * i // n_ranges, n * (i + 1) // n_ranges) for i in range(n_ranges)]
    waiting, failed = iter(enumerate(ranges)), dict[int, Exception]()

    # Threads that wait for threads of the same pool would wait for ever.
    workers = 1 if n_ranges == 1 or _THREAD.is_busy else n_workers()

    def drain() -> None:
        was_busy, _THREAD.is_busy = _THREAD.is_busy, workers > 1 or _THREAD.is_busy
        try:
            for i, (begin, end) in waiting:  # drawn under the interpreter's lock: each range once
                try:
                    function(begin, end)
                except Exception as error:
                    failed[i] = error  # raised below, in the caller's thread
        finally:  # an interrupt passes through
            _THREAD.is_busy = was_busy

    # The caller works too: to wake one thread less is a good part of a small range's time.
    others = [_pool(workers).submit(drain) for _ in range(min(workers, len(ranges)) - 1)]
    drain()
    for other in others:
        other.result()  # cheaper than waiting for all at once
    if failed:
        raise failed[min(failed)]


def each(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """function(item) of all items, in their order; each is a range of its own of `in_parallel`."""
    made = dict[int, _Result]()

    def make(first: int, last: int) -> None:
        made.update((i, function(items[i])) for i in range(first, last))

    in_parallel(make, len(items), grain=1)
    return [made[i] for i in range(len(items))]


def in_order(
    function: Callable[[_Item], _Result],
    items: Iterable[_Item],
    done: Callable[[int, _Result], None] | None = None,
) -> list[_Result]:
    """function(item) of each item, on as many threads as there are workers; for tasks of a tenth of a second.

    `done` is called in the caller's thread with each item's number and result, in their order. BLAS is held
    to one thread, so that sums have the same order however many there are. The function may call
    `in_parallel`, and must not call this one. Raises the exception of the first item that failed; on an
    exception or interrupt, what has not begun is not begun, and what has is waited for.
    """
    results, workers = list[_Result](), n_workers()

    def take(result: _Result) -> None:
        results.append(result)
        if done is not None:
            done(len(results) - 1, result)

    with blas_on_one_thread():
        if workers == 1:
            for item in items:
                take(function(item))
            return results
        # Threads of its own: were they those of `in_parallel`, all could wait for ranges that none is left
        # to do. Few items begin before their turn: an interrupt then loses and waits for little.
        pool, waiting = (
            ThreadPoolExecutor(workers, thread_name_prefix="pancam-graph-task"),
            deque[Future[_Result]](),
        )
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) >= _AHEAD * workers:
                    take(waiting.popleft().result())
            while waiting:
                take(waiting.popleft().result())
        finally:
            pool.shutdown(cancel_futures=True)
    return results


def blas_on_one_thread() -> AbstractContextManager[object]:
    """While it lasts, BLAS leaves the cores to the compiled loops.

    Matrices here have a few hundred rows. On these, BLAS threads cost more by waiting for each other than
    they gain, and with both cores in use they took twice the time of one.
    """
    limited: AbstractContextManager[object] = _blas().limit(limits=1, user_api="blas")
    return limited


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    """One for the life of the process: starting threads would cost as much as a small range."""
    return ThreadPoolExecutor(workers, thread_name_prefix="pancam-graph")


if hasattr(os, "register_at_fork"):
    # A forked child inherits the pool without its threads, and would wait for them for ever.
    os.register_at_fork(after_in_child=_pool.cache_clear)
