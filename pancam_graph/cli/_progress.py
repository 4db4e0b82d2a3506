"""Progress of long work: events, and the ways to show them on standard error."""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

from pancam_graph.cli._streams import is_terminal, write

if TYPE_CHECKING:
    from rich.status import Status

    from pancam_graph.smoother import Update
    from pancam_graph.solve import Iteration

__all__ = ["Display", "Event", "JsonLines", "NoDisplay", "PlainLines", "Progress", "display_for"]

_STAGES = {"screening": "looking for outliers", "approach": "adjusting", "solve": "adjusting to the end"}
_PERIOD_S = 20.0
"""Time between two plain lines."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """Where the work is."""

    stage: str
    """What is being done, in words."""
    done: int | None = None
    """How many steps of it are done; None where they are not counted."""
    total: int | None = None
    """How many steps it has; None where that is not known."""
    seconds_left: float | None = None
    """How long the rest of the stage takes, if its steps take as long as those before; None: not known."""
    per_second: float | None = None
    """Steps in a second since the stage began; None: not known."""
    detail: str = ""
    """What else there is to say."""

    @property
    def text(self) -> str:
        """The event in words."""
        counted = "" if self.done is None else f": step {self.done}"
        if self.done is not None and self.total is not None:
            counted = f" {self.done} of {self.total}"
        return f"{self.stage}{counted}{', ' if self.detail else ''}{self.detail}"

    @property
    def pace(self) -> str:
        """How quickly it goes and how long that takes, as the end of a sentence; empty where not known."""
        quick = "" if self.per_second is None else f", {self.per_second:.2g} a second"
        left = "" if self.seconds_left is None else f", about {_duration(self.seconds_left)} left"
        return f"{quick}{left}"


class Display(Protocol):
    """A way to show events."""

    def begin(self) -> None:
        """Long work begins."""

    def show(self, event: Event) -> None:
        """Show an event, between `begin` and `end`."""

    def end(self) -> None:
        """Long work ends, well or not."""


class NoDisplay:
    """Nothing is shown."""

    def begin(self) -> None:
        """Do nothing."""

    def show(self, event: Event) -> None:
        """Do nothing."""

    def end(self) -> None:
        """Do nothing."""


class TerminalLine:
    """A line at the bottom of a terminal that changes."""

    def __init__(self) -> None:
        self._status: Status | None = None

    def begin(self) -> None:
        """Show the line, still without words."""
        from pancam_graph.cli._terminal import Terminal

        terminal = Terminal(stderr=True)
        self._status = terminal.status("", spinner="dots" if terminal.encoding.startswith("utf") else "line")
        self._status.start()

    def show(self, event: Event) -> None:
        """Change the line."""
        from pancam_graph.cli._terminal import words

        if self._status is not None:
            self._status.update(words(f"{event.text}{event.pace}"))

    def end(self) -> None:
        """Take the line away."""
        if self._status is not None:
            self._status.stop()


class PlainLines:
    """A line now and then, for files and pipes; also while one long step has no events."""

    def __init__(self, period_s: float = _PERIOD_S) -> None:
        self._period_s = period_s
        self._latest: Event | None = None
        self._begun_s = 0.0
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Start the thread that writes."""
        self._begun_s = time.monotonic()
        self._over.clear()
        self._thread = threading.Thread(target=self._write, name="pancam-graph-progress", daemon=True)
        self._thread.start()

    def show(self, event: Event) -> None:
        """Keep the event for the next line."""
        self._latest = event

    def end(self) -> None:
        """Stop the thread."""
        self._over.set()
        if self._thread is not None:
            self._thread.join()

    def _write(self) -> None:
        while not self._over.wait(self._period_s):
            event = self._latest
            if event is not None:
                since = _duration(time.monotonic() - self._begun_s)
                write("stderr", f"{event.text} ({since} since the beginning{event.pace})")


class JsonLines:
    """Every event as a line of JSON: stage, done, total, seconds_left, per_second; null: not known."""

    def begin(self) -> None:
        """Do nothing."""

    def show(self, event: Event) -> None:
        """Write the event."""
        left = None if event.seconds_left is None else round(event.seconds_left, 1)
        pace = None if event.per_second is None else float(f"{event.per_second:.3g}")
        entry = {
            "stage": event.stage,
            "done": event.done,
            "total": event.total,
            "seconds_left": left,
            "per_second": pace,
        }
        write("stderr", json.dumps(entry))

    def end(self) -> None:
        """Do nothing."""


def display_for(way: Literal["auto", "json"] = "auto", *, quiet: bool = False) -> Display:
    """The display that a user asked for; `quiet` silences all but JSON."""
    if way == "json":
        return JsonLines()
    if quiet:
        return NoDisplay()
    return TerminalLine() if is_terminal("stderr") else PlainLines()


class Progress:
    """The functions that the library calls back, as events on a display."""

    def __init__(self, display: Display | None = None, *, quiet: bool = False) -> None:
        self._display = display or display_for()
        self._quiet = quiet
        self._stage = ""
        self._first = (0, 0.0)
        self._stops = 0

    @contextmanager
    def shown(self, stage: str) -> Iterator[None]:
        """Show progress while the block runs, which begins with this stage."""
        self._display.begin()
        try:
            self.say(stage)
            yield
        finally:
            self._display.end()

    def say(self, stage: str) -> None:
        """A stage whose steps are not counted begins."""
        self._display.show(Event(stage=stage))

    def counted(self, what: str, done: int, total: int) -> None:
        """So many of a stage's steps are done."""
        self._display.show(self._timed(what, done, total))

    def iteration(self, iteration: "Iteration") -> None:
        """The solve has made a step."""
        stage, detail = _STAGES[iteration.stage], f"cost {iteration.cost:.6g}"
        self._display.show(Event(stage=stage, done=iteration.number, detail=detail))

    def stop(self, update: "Update", total: int | None = None) -> None:
        """A stop was added: an event, and a line on standard output, which a terminal or a file shows."""
        self._stops += 1
        self._display.show(self._timed("adding stops", self._stops, total))
        if self._quiet:
            return
        closed = "".join(f", closes a loop to {c.other}" for c in update.closures if c.accepted)
        write(
            "stdout",
            f"{update.stop}: {update.observations} observations, cost {update.cost:.6g}, "
            f"{update.blocks} blocks, {update.relinearised} relinearised, {update.seconds:.3f} s{closed}",
        )

    def _timed(self, stage: str, done: int, total: int | None) -> Event:
        """An event with the pace since the first event of the stage, and the time for the steps to come."""
        now_s = time.monotonic()
        if stage != self._stage:
            self._stage, self._first = stage, (done, now_s)
        first, begun_s = self._first
        known = done > first and now_s > begun_s
        pace = (done - first) / (now_s - begun_s) if known else None
        left = None if total is None or pace is None else (total - done) / pace
        if total is not None and done >= total:
            left = 0.0
        return Event(stage=stage, done=done, total=total, seconds_left=left, per_second=pace)


def _duration(seconds: float) -> str:
    """A time in words."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    return (
        f"{whole // 60} min {whole % 60} s" if whole < 3600 else f"{whole // 3600} h {whole % 3600 // 60} min"
    )
