"""Work on all cores: ranges for compiled loops, and longer tasks that release the interpreter's lock."""

import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from threading import Lock, local
from typing import Any, TypeVar

from threadpoolctl import OpenBLASController, ThreadpoolController

from pancam_graph.base.errors import InputError
from pancam_graph.base.lapack import lapack

__all__ = ["blas_on_one_thread", "each", "in_order", "in_parallel", "in_this_thread", "n_workers"]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_AHEAD = 2
"""How many items per worker `in_order` begins ahead of the one whose result is next."""
_VARIABLE = "PANCAM_GRAPH_THREADS"


class _Thread(local):
    """State of its own for each thread."""

    is_busy = False
    """Whether the thread works on one of several ranges."""


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


@contextmanager
def in_this_thread() -> Iterator[None]:
    """A context in which `in_parallel` calls its function in the caller's thread alone.

    It is for work that others do at the same time, as many as there are cores.
    """
    was_busy, _THREAD.is_busy = _THREAD.is_busy, True
    try:
        yield
    finally:
        _THREAD.is_busy = was_busy


def in_parallel(function: Callable[[int, int], None], n: int, *, grain: int) -> None:
    """Call function(begin, end) over consecutive ranges of 0 to n, of about `grain` items each.

    Each item is in one range. The ranges depend on n and the grain alone, not on the number of threads. All
    runs in the caller's thread if there is one range or one thread, or if the caller itself works on one of
    several ranges. Raises the exception of the first range that failed, after all ranges have ended.
    """
    n_ranges = max(min(n, 1), round(n / grain))
    ranges = [(n * i // n_ranges, n * (i + 1) // n_ranges) for i in range(n_ranges)]
    waiting, failed = iter(enumerate(ranges)), dict[int, Exception]()

    # If threads of the pool waited for other threads of it, all could wait for ever.
    workers = 1 if n_ranges == 1 or _THREAD.is_busy else n_workers()

    def drain() -> None:
        was_busy, _THREAD.is_busy = _THREAD.is_busy, workers > 1 or _THREAD.is_busy
        try:
            for i, (begin, end) in waiting:  # the interpreter's lock gives each range to one thread
                try:
                    function(begin, end)
                except Exception as error:
                    failed[i] = error  # raised below, in the caller's thread
        finally:  # an interrupt passes through
            _THREAD.is_busy = was_busy

    # The caller works too: waking a thread takes a good part of the time of a small range.
    others = [_pool(workers).submit(drain) for _ in range(min(workers, len(ranges)) - 1)]
    drain()
    for other in others:
        other.result()  # one by one is cheaper than a wait for all
    if failed:
        raise failed[min(failed)]


def each(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """The results function(item) in the order of the items, each item as one range of `in_parallel`."""
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
    """The results function(item) in the order of the items; for tasks of a tenth of a second or more.

    `done` is called in the caller's thread with each item's number and result, in their order. BLAS uses one
    thread, so that sums have the same order for any number of workers. The function may call `in_parallel`,
    but not `in_order`. Raises the exception of the first item that failed. After an exception or interrupt no
    further item begins, and those that have begun are waited for.
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
        # These threads are not those of `in_parallel`, for which they may wait. Few items begin ahead of
        # their turn, so that an interrupt loses little work and waits for little.
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


@contextmanager
def blas_on_one_thread() -> Iterator[None]:
    """A context in which BLAS and OpenCV use one thread each: loops and tasks of ours take the other cores.

    Matrices here have a few hundred rows. On these, threads of BLAS wait for each other longer than they
    save: with two cores in use, two took twice the time of one. Most libraries have one number of threads for
    the whole process: while several threads of it are in such a context, the last that leaves restores it.
    """
    # A controller limits the libraries that are loaded when it is made. SciPy's own BLAS may not be yet.
    lapack()

    with_opencv = "cv2" in sys.modules
    _LIMIT.enter(with_opencv)
    try:
        with _blas(with_opencv, of_thread=True).limit(limits=1):
            yield
    finally:
        _LIMIT.leave()


class _Limit:
    """The limit on libraries with one number of threads for the process, and how many contexts need it."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._users = 0
        self._limits = dict[bool, Any]()
        """The limits that are set, by whether OpenCV was loaded, which has a BLAS of its own."""
        self._opencv_threads = 0
        """How many threads OpenCV had, where it is limited; else 0."""

    def enter(self, with_opencv: bool) -> None:
        """Set the limit, unless another context has."""
        with self._lock:
            self._users += 1
            if with_opencv not in self._limits:
                _in_control(lambda: self._limit(with_opencv))

    def leave(self) -> None:
        """Restore what was before, unless another context needs the limit."""
        with self._lock:
            self._users -= 1
            if self._users == 0:
                _in_control(self._restore)

    def _limit(self, with_opencv: bool) -> None:
        self._limits[with_opencv] = _blas(with_opencv, of_thread=False).limit(limits=1)
        if with_opencv:
            # Tasks run on all cores already: OpenCV's own threads only wait for these.
            self._opencv_threads = sys.modules["cv2"].getNumThreads()
            sys.modules["cv2"].setNumThreads(1)

    def _restore(self) -> None:
        while self._limits:  # what was set last, first
            self._limits.popitem()[1].restore_original_limits()
        if self._opencv_threads:
            sys.modules["cv2"].setNumThreads(self._opencv_threads)
            self._opencv_threads = 0


_LIMIT = _Limit()


def _in_control(work: Callable[[], None]) -> None:
    """Change limits, which any thread may do afterwards.

    threadpoolctl 3.8 lets only one living thread change them, until that one says that it is done: whoever
    sets one would have to restore it.
    """
    work()
    done = getattr(OpenBLASController, "clear_controlling_thread", None)
    if done is not None:
        done()


@cache
def _blas(with_opencv: bool, *, of_thread: bool) -> ThreadpoolController:
    """The controller of all loaded BLAS libraries that count threads for each thread, or for the process."""
    loaded = ThreadpoolController().select(user_api="blas")
    chosen = [
        library["filepath"]
        for library in loaded.info()
        if (library.get("threading_layer") == "openmp") is of_thread
    ]
    return loaded.select(filepath=chosen)


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    """The pool of `in_parallel`, kept as long as the process: new threads cost as much as a small range."""
    return ThreadPoolExecutor(workers, thread_name_prefix="pancam-graph")


if hasattr(os, "register_at_fork"):
    # A forked child inherits the pool without the threads, and would wait for them for ever.
    os.register_at_fork(after_in_child=_pool.cache_clear)
