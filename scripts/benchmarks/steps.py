"""Time of each step of a run."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

__all__ = ["Steps"]


@dataclass
class Steps:
    """Wall-clock and processor time of each step, in the order in which steps first ended."""

    wall: Callable[[], float] = time.perf_counter
    processor: Callable[[], float] = time.process_time
    seconds: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Wall-clock and processor seconds of each step, the latter over all threads."""

    def __post_init__(self) -> None:
        """Start the clocks."""
        self._last = self.wall(), self.processor()

    def done(self, step: str, *_: object) -> None:
        """Add the time since the last call to this step; further arguments are ignored."""
        now = self.wall(), self.processor()
        wall_s, processor_s = self.seconds.get(step, (0.0, 0.0))
        self.seconds[step] = wall_s + now[0] - self._last[0], processor_s + now[1] - self._last[1]
        self._last = now

    def table(self) -> str:
        """Lines of step, wall-clock and processor seconds, the sum last."""
        wall_s, processor_s = (sum(column) for column in zip(*self.seconds.values(), strict=True))
        rows = [("step", "wall (s)", "processor (s)")]
        rows += [(name, f"{w:.1f}", f"{p:.1f}") for name, (w, p) in self.seconds.items()]
        rows.append(("all", f"{wall_s:.1f}", f"{processor_s:.1f}"))
        widths = [max(len(row[i]) for row in rows) for i in range(3)]
        return "\n".join(
            f"{name:<{widths[0]}}  {wall:>{widths[1]}}  {processor:>{widths[2]}}"
            for name, wall, processor in rows
        )
