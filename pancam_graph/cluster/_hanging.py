"""Tasks that do not end: how long each kind may take, what workers are at, and what ends a worker."""

import time
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

__all__ = ["Executing", "Pace", "restart", "what_runs"]

_LEAST_S = 600.0
_TIMES = 20.0
_GROWTH = 2.0
_RESTART_S = 30.0


class Executing(NamedTuple):
    """A task under way."""

    worker: str
    """Address of the worker."""
    seconds: float
    """How long it has been at it."""


class Pace:
    """How long items of each kind have taken, and so may take."""

    def __init__(self) -> None:
        """Nothing has ended yet."""
        self._longest_s = defaultdict[str, float](float)

    def ended(self, kinds: Iterable[str], seconds: float) -> None:
        """Items of these kinds, one after the other, took no longer than that together."""
        for kind in kinds:
            self._longest_s[kind] = max(self._longest_s[kind], seconds)

    def limit_s(self, kinds: Iterable[str], given_up: int) -> float:
        """Seconds after which items of these kinds, one after the other, count as hanging.

        Ten minutes at least, and twenty times what items of their kinds have taken; twice that for each time
        that they were given up before: what takes longer than all others of its kind ends all the same.
        """
        usual_s = sum(self._longest_s[kind] for kind in kinds)
        return max(_LEAST_S, _TIMES * usual_s) * _GROWTH**given_up


def what_runs(dask_scheduler: Any = None) -> Mapping[str, Executing]:
    """Tasks under way, by key, as of the workers' latest heartbeats; runs on the scheduler.

    A worker that is frozen as a whole sends none, and the scheduler itself removes it (worker-ttl).
    """
    return {
        str(task.key): Executing(address, float(seconds))
        for address, worker in dask_scheduler.workers.items()
        for task, seconds in worker.executing.items()
    }


async def restart(address: str, dask_scheduler: Any = None) -> None:
    """End a worker; its nanny, if it has one, begins another; runs on the scheduler."""
    await dask_scheduler.restart_workers(
        workers=[address],
        timeout=_RESTART_S,
        wait_for_workers=False,
        on_error="return",
        stimulus_id=f"pancam-graph-{time.time()}",
    )
