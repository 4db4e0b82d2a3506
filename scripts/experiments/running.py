"""Running over seeds: in two processes, in a fixed order, and without losing a run that fails."""

import math
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from pancam_graph.base.errors import PancamGraphError

__all__ = ["Row", "Sample", "Task", "attempt", "quantile", "run_tasks", "summarise"]


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One solve of one seed."""

    experiment: str
    model: str
    sharing: str
    noise_px: float | None
    """Noise of an observation; None for real images."""
    seed: int
    metrics: Mapping[str, float] = field(default_factory=dict, hash=False)
    failure: str = ""
    """Reason of a failure; "" for a solve that did not fail."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Median and interval of one metric over all seeds: an entry of results.json."""

    experiment: str
    model: str
    sharing: str
    noise_px: float | None
    seeds: int
    metric: str
    median: float
    """Median by rank, where a failed run is the worst: infinite if half of the runs failed."""
    q05: float
    q95: float
    failed: int
    """Number of seeds whose run failed."""

    def to_json(self) -> dict[str, str | int | float | None]:
        """The entry, with null for infinity, which JSON does not have."""
        return {k: None if isinstance(v, float) and math.isinf(v) else v for k, v in vars(self).items()}


class Task(Protocol):
    """Work of one seed, which can be sent to another process."""

    def run(self) -> list[Sample]:
        """Simulate, solve with each model, measure."""
        ...


def attempt(measure: Callable[[], dict[str, float]]) -> tuple[dict[str, float], str]:
    """Metrics, and the reason of a failure ("" for none): an exception, or a metric that is not finite."""
    try:
        metrics = measure()
    except PancamGraphError as error:
        return {}, str(error)
    lost = [name for name, value in metrics.items() if not math.isfinite(value)]
    return metrics, f"no finite {', '.join(lost)}" if lost else ""


def run_tasks(
    tasks: Sequence[Task], *, processes: int, progress: Callable[[str, int, int], None] | None = None
) -> list[Sample]:
    """Samples of all tasks in their order, whatever the number of processes."""
    of_tasks: list[list[Sample]] = []
    # The last tasks are the longest. Begun first, they do not leave one process busy alone at the end.
    for done, samples in enumerate(_results(tasks[::-1], processes), start=1):
        of_tasks.append(samples)
        if progress is not None:
            progress("running", done, len(tasks))
    return [sample for samples in reversed(of_tasks) for sample in samples]


def _results(tasks: Sequence[Task], processes: int) -> Iterator[list[Sample]]:
    if processes == 1 or len(tasks) < 2:
        yield from map(_run, tasks)
        return
    # Fresh processes: threads of the compiled kernel do not survive a fork.
    with multiprocessing.get_context("spawn").Pool(processes, _work_alone) as pool:
        yield from pool.imap(_run, tasks)


def _work_alone() -> None:
    """Use one thread in a process beside others; the number of threads changes no bit of a result."""
    os.environ.setdefault("PANCAM_GRAPH_THREADS", "1")


def _run(task: Task) -> list[Sample]:
    return task.run()


def quantile(values: Sequence[float], share: float) -> float:
    """The smallest value that at least this share of all values does not exceed; infinite values count.

    NaN ranks as infinite.
    """
    ordered = sorted(math.inf if math.isnan(v) else v for v in values)
    return ordered[max(0, math.ceil(share * len(ordered) - 1e-9) - 1)]


def summarise(samples: Sequence[Sample]) -> list[Row]:
    """Medians and 90 % intervals over seeds of each metric, in the order of the samples.

    A failed run is infinite in every metric. A model whose runs all failed gets the metrics of the other
    models of the experiment.
    """
    groups: dict[tuple[str, str, str, float | None], list[Sample]] = {}
    everywhere: dict[str, dict[str, None]] = {}
    for s in samples:
        groups.setdefault((s.experiment, s.model, s.sharing, s.noise_px), []).append(s)
        everywhere.setdefault(s.experiment, {}).update(dict.fromkeys(s.metrics))
    rows = []
    for (experiment, model, sharing, noise_px), group in groups.items():
        metrics = dict.fromkeys(name for s in group for name in s.metrics) or everywhere[experiment]
        for metric in metrics:
            values = [math.inf if s.failure else s.metrics.get(metric, math.inf) for s in group]
            rows.append(
                Row(
                    experiment=experiment,
                    model=model,
                    sharing=sharing,
                    noise_px=noise_px,
                    seeds=len(group),
                    metric=metric,
                    median=quantile(values, 0.5),
                    q05=quantile(values, 0.05),
                    q95=quantile(values, 0.95),
                    failed=sum(bool(s.failure) for s in group),
                )
            )
    return rows
