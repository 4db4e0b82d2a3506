"""The client's side of work on a cluster: checks of the workers, tasks, and what becomes of their faults."""

import hashlib
import logging
import pickle
import queue
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from itertools import islice
from pathlib import Path
from typing import Any

from pancam_graph.base.errors import ClusterError
from pancam_graph.base.whole_files import whole_file
from pancam_graph.cluster._hanging import Executing, Pace, restart, what_runs
from pancam_graph.cluster._machine import PACKAGE, package_version
from pancam_graph.cluster._worker import Parcel, Probe, look_around, run_batch

__all__ = ["Crew", "Job"]

_LOG = logging.getLogger(__name__)
_POLL_S = 1.0
_WAIT_FOR_WORKERS_S = 60.0
_LOOK_AGAIN_S = 0.05
_AHEAD = 8
"""Batches that the scheduler has, per thread of a worker: enough that no thread waits for the client."""
_SHARE = 8
"""Batches per thread that ready items are split into, so that the last ones end at about the same time."""
_MOST_IN_BATCH = 16
_TRIES = 3
_LOOK_S = 5.0
"""How often the scheduler is asked what runs; workers tell it about as often."""
_PROBE_FILES = 3


def _of_one_kind(_: Any) -> str:
    return ""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One kind of work: a function of a module, called on workers as function(shared, item)."""

    function: Callable[[Any, Any], Any]
    shared: Any
    """What all items need; goes to a worker once, by a file in the shared folder."""
    name: Callable[[Any], str]
    """What an item is, for people."""
    kind: Callable[[Any], str] = _of_one_kind
    """Items of one kind take about the same time."""


@dataclass
class _Batch:
    """Items of one task."""

    numbers: list[int]
    tries: int = 0
    given_up: int = 0
    """How often it was taken from a worker that did not end it."""
    seconds: float = 0.0
    """How long a worker had been at it when the scheduler was last asked."""


class Crew:
    """The workers of a client, and the folder that they have in common with it."""

    def __init__(self, client: Any, *, folder: Path, machine: Callable[[], Mapping[str, str]]) -> None:
        """`client` is a distributed.Client; `folder` exists; `machine` is a function of a module.

        It is called here and on workers, and returns what must be the same everywhere.
        """
        self.client = client
        self._folder = folder.resolve()
        self._machine = machine, dict(machine())
        self._files: list[tuple[Path, int]] = []
        self._parcels = set[Path]()
        self._can_look = True

    @contextmanager
    def at_work(self, files: Iterable[Path] = ()) -> Iterator[None]:
        """A context in which the workers are known to be able to do the work; `files` are some they read.

        Raises ClusterError naming a worker that has another version, other sources or libraries or another
        kind of processor, that lacks the package, or does not see the folder or a file; and where no worker
        comes within a minute.
        """
        known = islice((path.resolve() for path in files if path.is_file()), _PROBE_FILES)
        self._files = [(path, path.stat().st_size) for path in known]
        begun_s = time.monotonic()
        while not self.n_threads():
            if time.monotonic() - begun_s > _WAIT_FOR_WORKERS_S:
                raise self.broken(f"expected workers, found none in {_WAIT_FOR_WORKERS_S:.0f} s")
            time.sleep(_LOOK_AGAIN_S)
        self.check()
        try:
            yield
        finally:
            for path in self._parcels:
                with suppress(OSError):
                    path.unlink(missing_ok=True)

    def n_threads(self) -> int:
        """Threads of all workers that the scheduler knows. Raises ClusterError where it is gone."""
        try:
            return sum(self.client.nthreads().values())
        except Exception as error:  # which one depends on how it went
            raise self.gone() from error

    def broken(self, what: str) -> ClusterError:
        """An error of the cluster, with the sentence that what was found is kept."""
        scheduler = getattr(self.client.scheduler, "address", "")
        return ClusterError(
            f"cluster{scheduler and ' '}{scheduler}: {what}; what was found so far is in {self._folder}: run "
            "the same command again to go on from there"
        )

    def gone(self) -> ClusterError:
        """The error of a scheduler that is gone."""
        return self.broken("the scheduler is gone")

    def what_runs(self) -> Mapping[str, Executing]:
        """Tasks under way, by key; none where the scheduler cannot tell, which is logged once."""
        if not self._can_look:
            return {}
        try:
            found: Mapping[str, Executing] = self.client.run_on_scheduler(what_runs)
        except (
            Exception
        ) as error:  # what a scheduler says that lacks the package; one that is gone is noticed
            self._can_look = False
            _LOG.warning(
                "the scheduler does not tell what runs, so that nothing that hangs is noticed: %s", error
            )
            return {}
        return found

    def restart(self, address: str) -> None:
        """End a worker that hangs; its nanny, if it has one, begins another."""
        self.client.run_on_scheduler(restart, address)

    def check(self) -> None:
        """Raise ClusterError for the first worker, by address, that cannot do the work."""
        probe = self._folder / f"probe-{secrets.token_hex(4)}"
        content = secrets.token_bytes(32)
        whole_file(probe, content)
        try:
            answers = self.client.run(
                look_around,
                self._machine,
                Probe(path=probe, content=content, files=self._files),
                on_error="return",
            )
        finally:
            probe.unlink(missing_ok=True)
        for address in sorted(answers):
            answer = answers[address]
            if isinstance(answer, Exception):  # most often it has no such module
                expected = f"{PACKAGE} {package_version()} as on the machine that asks"
                answer = f"expected {expected}, found {type(answer).__name__}: {answer}"
            if answer is not None:
                raise ClusterError(f"worker {address}: {answer}")

    def share(
        self,
        job: Job,
        items: Sequence[Any],
        after: Sequence[Sequence[int]] | None = None,
        done: Callable[[int, int], None] | None = None,
    ) -> None:
        """Call job.function(job.shared, item) on workers for all items; results are dropped.

        An item begins once the items whose numbers `after` has for it are done; earlier ones first. `done`
        is called with how many items are done, and how many there are. A task whose worker dies runs on
        another one; one that raises runs again twice. An item that still raises is left to the caller, with
        those that come after it: the caller meets the same error where it does them itself, and the log has a
        warning. A task that takes many times as long as others of its kind is taken from its worker, which is
        ended, and given to another one.

        Raises ClusterError for an item on which each worker that tries it dies or hangs, where the scheduler
        is gone or no worker is left for a minute, and as `at_work` does for workers that have come since.
        """
        if items:
            _Run(self, job, items, after or [()] * len(items), done).finish()

    def parcel(self, shared: Any) -> Parcel:
        """A file of what a job shares, written unless it is there."""
        content = pickle.dumps(shared, protocol=pickle.HIGHEST_PROTOCOL)
        digest = hashlib.sha256(content).hexdigest()
        path = self._folder / f"parcel-{digest[:40]}.pickle"
        if path not in self._parcels:
            whole_file(path, content)
            self._parcels.add(path)
        return Parcel(path=path, digest=digest)

    def submit(self, job: Job, parcel: Parcel, batches: Sequence[Sequence[Any]]) -> Any:
        """A future of each batch of items."""
        try:
            return self.client.map(
                run_batch, batches, machine=self._machine, function=job.function, parcel=parcel, pure=False
            )
        except Exception as error:  # whatever a client raises that has lost its scheduler
            raise self.gone() from error


class _Run:
    """A job under way."""

    def __init__(
        self,
        crew: Crew,
        job: Job,
        items: Sequence[Any],
        after: Sequence[Sequence[int]],
        done: Callable[[int, int], None] | None,
    ) -> None:
        self._crew = crew
        self._job = job
        self._items = items
        self._tell = done
        self._parcel = crew.parcel(job.shared)
        self._threads = max(1, crew.n_threads())
        self._waits_for = [len(set(before)) for before in after]
        self._next: list[list[int]] = [[] for _ in items]
        for number, before in enumerate(after):
            for earlier in set(before):
                self._next[earlier].append(number)
        self._ready = [number for number, waits_for in enumerate(self._waits_for) if not waits_for]
        heapify(self._ready)
        self._again = deque[_Batch]()
        self._running = dict[Any, _Batch]()
        self._ended = queue.SimpleQueue[Any]()
        self._pace, self._looked_s = Pace(), time.monotonic()
        self._over = set[int]()

    def finish(self) -> None:
        """Do all items."""
        lonely_since_s: float | None = None
        try:
            while len(self._over) < len(self._items):
                self._begin()
                self._look()
                try:
                    future = self._ended.get(timeout=_POLL_S)
                except queue.Empty:
                    lonely_since_s = self._lonely(lonely_since_s)
                else:
                    lonely_since_s = None
                    batch = self._running.pop(future, None)
                    if batch is not None:  # else it was taken from its worker
                        self._end(future, batch)
        finally:
            if self._running:
                with suppress(Exception):  # a scheduler that is gone has nothing to cancel
                    self._crew.client.cancel(list(self._running), force=True)

    def _begin(self) -> None:
        """Hand batches to the scheduler, many at once, where it has little left."""
        most, batches = _AHEAD * self._threads, list[_Batch]()
        if len(self._running) > most // 2:
            return
        while len(self._running) + len(batches) < most and (self._again or self._ready):
            if self._again:
                batch = self._again.popleft()
            else:
                size = max(1, min(_MOST_IN_BATCH, len(self._ready) // (_SHARE * self._threads)))
                batch = _Batch([heappop(self._ready) for _ in range(size)])
            batch.tries += 1
            batches.append(batch)
        if batches:
            items = [[self._items[number] for number in batch.numbers] for batch in batches]
            for future, batch in zip(self._crew.submit(self._job, self._parcel, items), batches, strict=True):
                self._running[future] = batch
                future.add_done_callback(self._ended.put)

    def _look(self) -> None:
        """Take from workers what they do not end, and end these, from time to time."""
        if time.monotonic() - self._looked_s < _LOOK_S:
            return
        self._looked_s, runs = time.monotonic(), self._crew.what_runs()
        for future, batch in list(self._running.items()):
            now = runs.get(str(future.key))
            if now is None:
                continue
            batch.seconds = now.seconds
            if now.seconds > self._pace.limit_s(self._kinds(batch), batch.given_up):
                self._give_up(future, batch, now.worker)

    def _kinds(self, batch: _Batch) -> list[str]:
        return [self._job.kind(self._items[number]) for number in batch.numbers]

    def _names(self, batch: _Batch) -> str:
        return ", ".join(self._job.name(self._items[number]) for number in batch.numbers)

    def _give_up(self, future: Any, batch: _Batch, worker: str) -> None:
        """Take a task from a worker that does not end it. What both write then is the same, and whole."""
        what = f"{self._names(batch)}: worker {worker} did not end in {batch.seconds:.0f} s"
        del self._running[future]
        with suppress(Exception):  # one of a worker that has died meanwhile
            self._crew.client.cancel([future], force=True)
        with suppress(Exception):  # it is not given another task in any case
            self._crew.restart(worker)
        given_up = batch.given_up + 1
        if len(batch.numbers) == 1 and given_up >= _TRIES:
            raise self._crew.broken(f"{what}, nor did {given_up - 1} others")
        _LOG.warning("%s, and another one does it", what)
        self._again.extend(_Batch([number], batch.tries, given_up) for number in batch.numbers)

    def _lonely(self, since_s: float | None) -> float | None:
        """Since when there is no worker; None: there is one."""
        if self._crew.n_threads():
            return None
        now_s = time.monotonic()
        if since_s is not None and now_s - since_s > _WAIT_FOR_WORKERS_S:
            raise self._crew.broken(f"no worker is left, and none came in {_WAIT_FOR_WORKERS_S:.0f} s")
        return now_s if since_s is None else since_s

    def _end(self, future: Any, batch: _Batch) -> None:
        """A task has ended: go on after its items, or have them done again, or leave them to the client."""
        if future.status == "cancelled":  # by nobody else than a client that has lost its scheduler
            raise self._crew.gone()
        if future.status != "error":  # finished; or lost since, with the worker that had finished it
            for number in batch.numbers:
                self._go_on_after(number)
            self._pace.ended(self._kinds(batch), batch.seconds)
            self._count(batch.numbers)
            return
        error = future.exception()
        if isinstance(error, ClusterError):
            raise error
        is_killed = type(error).__name__ == "KilledWorker"  # of an extra
        names = self._names(batch)
        if is_killed and len(batch.numbers) == 1 and batch.tries > 1:
            raise self._crew.broken(f"all workers that tried {names} died")
        if len(batch.numbers) > 1:
            self._again.extend(_Batch([number], batch.tries, batch.given_up) for number in batch.numbers)
        elif is_killed or batch.tries < _TRIES:
            self._again.append(batch)
        else:
            self._crew.check()  # a worker that came later may lack something, and is named here
            _LOG.warning("%s: no worker could do it: %s: %s", names, type(error).__name__, error)
            self._count(self._all_after(batch.numbers))

    def _go_on_after(self, number: int) -> None:
        for later in self._next[number]:
            self._waits_for[later] -= 1
            if not self._waits_for[later] and later not in self._over:
                heappush(self._ready, later)

    def _all_after(self, numbers: Iterable[int]) -> set[int]:
        """Items, and all that wait for them, directly or not."""
        found, waiting = set[int](), list(numbers)
        while waiting:
            number = waiting.pop()
            if number not in found:
                found.add(number)
                waiting += self._next[number]
        return found

    def _count(self, numbers: Iterable[int]) -> None:
        self._over.update(numbers)
        if self._tell is not None:
            self._tell(len(self._over), len(self._items))
