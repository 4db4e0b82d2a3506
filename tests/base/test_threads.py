"""Ranges over threads: all of them once, the same for any number of threads, and errors that come through."""

import multiprocessing
import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.base.threads import each, in_order, in_parallel, n_workers
from support.parameters import slow_but_for


def wait_at(barrier: threading.Barrier) -> None:
    """Return when the other threads are there too."""
    barrier.wait()


def ranges_of(n: int, grain: int) -> list[tuple[int, int]]:
    seen = []
    in_parallel(lambda begin, end: seen.append((begin, end)), n, grain=grain)
    return sorted(seen)


@pytest.mark.parametrize("threads", ["1", "2", "3"])
@pytest.mark.parametrize(("n", "grain"), [(0, 10), (1, 10), (9, 10), (14, 10), (16, 10), (1000, 7), (3, 1)])
def test_ranges_follow_each_other_and_do_not_depend_on_the_threads(
    monkeypatch: pytest.MonkeyPatch, threads: str, n: int, grain: int
) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "1")
    alone = ranges_of(n, grain)
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", threads)
    assert ranges_of(n, grain) == alone
    assert [i for begin, end in alone for i in range(begin, end)] == list(range(n))
    lengths = [end - begin for begin, end in alone]
    assert not lengths or max(lengths) - min(lengths) <= 1
    assert len(lengths) <= 1 or 0.6 * grain < np.mean(lengths) < 1.5 * grain


def test_two_threads_work_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "2")
    both = threading.Barrier(2, timeout=10)
    in_parallel(lambda begin, end: wait_at(both), 2, grain=1)


def test_one_range_runs_in_the_thread_of_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "2")
    names = []
    in_parallel(lambda begin, end: names.append(threading.current_thread()), 5, grain=10)
    assert names == [threading.current_thread()]


@pytest.mark.parametrize("threads", ["1", "2"])
def test_the_first_error_comes_through(monkeypatch: pytest.MonkeyPatch, threads: str) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", threads)

    def fails(begin: int, end: int) -> None:
        if begin >= 2:
            raise ValueError(begin)

    with pytest.raises(ValueError, match="2"):
        in_parallel(fails, 10, grain=1)


@pytest.mark.parametrize("text", ["0", "-1", "two", "1.5", "²"])
def test_a_number_of_threads_that_is_none_is_named(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", text)
    with pytest.raises(InputError, match=r"PANCAM_GRAPH_THREADS: expected .* found"):
        n_workers()


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_a_forked_process_starts_threads_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "2")
    assert len(ranges_of(10, 1)) == 10
    child = multiprocessing.get_context("fork").Process(target=ranges_of, args=(10, 1))
    child.start()
    child.join(20)
    hangs = child.is_alive()
    child.kill()
    assert not hangs
    assert child.exitcode == 0


@pytest.mark.parametrize("threads", ["1", "2"])
def test_ranges_within_ranges_run_in_the_thread_of_the_outer_one(
    monkeypatch: pytest.MonkeyPatch, threads: str
) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", threads)
    ran = []

    def outer(begin: int, end: int) -> None:
        own = threading.current_thread()
        in_parallel(lambda a, b: ran.append((begin, a, threading.current_thread() is own)), 4, grain=1)

    in_parallel(outer, 6, grain=1)
    assert sorted(ran) == [(i, j, True) for i in range(6) for j in range(4)]
    # And when all is done, ranges are for all threads again.
    if threads == "2":
        both = threading.Barrier(2, timeout=10)
        in_parallel(lambda begin, end: wait_at(both), 2, grain=1)


def test_each_keeps_the_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "2")
    assert each(lambda x: 10 * x, [3, 1, 2]) == [30, 10, 20]
    assert each(lambda x: x, []) == []


@pytest.mark.parametrize("threads", ["1", "2", "3"])
def test_results_are_in_the_order_of_the_items(monkeypatch: pytest.MonkeyPatch, threads: str) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", threads)
    told = []

    def squared(item: int) -> int:
        time.sleep(0.002 * (item % 3))
        return item * item

    found = in_order(squared, range(20), lambda k, result: told.append((k, result)))
    assert found == [i * i for i in range(20)]
    assert told == list(enumerate(found))


@pytest.mark.parametrize("threads", ["1", "2"])
def test_a_task_may_share_its_ranges_out_and_an_error_ends_the_rest(
    monkeypatch: pytest.MonkeyPatch, threads: str
) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", threads)
    begun = []

    def task(item: int) -> int:
        begun.append(item)
        if item == 3:
            raise ValueError(item)
        return len(ranges_of(10, 1))

    with pytest.raises(ValueError, match="3"):
        in_order(task, range(100))
    assert len(begun) < 10
    assert in_order(task, range(3)) == [10, 10, 10]


def test_two_tasks_run_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "2")
    both = threading.Barrier(2, timeout=10)
    assert in_order(lambda _: both.wait() >= 0, range(2)) == [True, True]


def test_after_an_interrupt_ranges_are_for_all_threads_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "2")
    caller, began = threading.current_thread(), threading.Event()

    def interrupted(begin: int, end: int) -> None:
        if threading.current_thread() is caller:
            began.set()
            raise KeyboardInterrupt
        began.wait(10)

    with pytest.raises(KeyboardInterrupt):
        in_parallel(interrupted, 1000, grain=1)
    both = threading.Barrier(2, timeout=10)
    in_parallel(lambda begin, end: wait_at(both), 2, grain=1)


@pytest.mark.parametrize(
    "before",
    [
        pytest.param("pass", marks=pytest.mark.slow),
        pytest.param("import scipy.linalg", marks=pytest.mark.slow),
        "with blas_on_one_thread(): pass\nimport cv2",
        pytest.param("from pancam_graph import solve, find_observations", marks=pytest.mark.slow),
    ],
)
def test_every_blas_that_is_loaded_within_has_one_thread(before: str) -> None:
    """NumPy, SciPy and OpenCV bring libraries of their own, whichever of them are imported first."""
    code = f"""
from pancam_graph.base.threads import blas_on_one_thread
{before}
from threadpoolctl import threadpool_info
with blas_on_one_thread():
    import scipy.linalg, scipy.special, scipy.sparse.linalg, scipy.spatial
    print(*[library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"])
"""
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    numbers = done.stdout.split()
    assert numbers
    assert set(numbers) == {"1"}


OVERLAPPING = """
import threading
from pancam_graph.base.threads import blas_on_one_thread
from threadpoolctl import threadpool_info
import scipy.linalg

def show():
    blas = [library for library in threadpool_info() if library["user_api"] == "blas"]
    print(sorted({{library["num_threads"] for library in blas}}))

both, first_has_left, all_done = threading.Barrier(2), threading.Event(), threading.Event()

def leaves_first():
    with blas_on_one_thread():
        both.wait()
    first_has_left.set()
    all_done.wait(20)  # a thread that lives on

show()
other = threading.Thread(target=leaves_first)
if {enters_first}:
    other.start()
    while both.n_waiting == 0:
        pass
with blas_on_one_thread(), blas_on_one_thread():
    if not {enters_first}:
        other.start()
    both.wait()
    first_has_left.wait(20)
    show()
show()
try:
    with blas_on_one_thread():
        1 // 0
except ZeroDivisionError:
    show()
all_done.set()
"""


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="BLAS has one thread anyway")
@pytest.mark.parametrize("enters_first", slow_but_for([True], [True, False]))
def test_blas_has_its_threads_again_when_the_last_of_several_contexts_ends(enters_first: bool) -> None:
    """Contexts of two threads that overlap: the first that leaves has set the limit, or found it set."""
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", OVERLAPPING.format(enters_first=enters_first)],
        env={**environment, "OPENBLAS_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split("\n") == ["[2]", "[1]", "[2]", "[2]", ""]
