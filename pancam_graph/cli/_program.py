"""What the command-line programs share: parsing, progress on a terminal, one sentence for bad input."""

import argparse
import logging
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import numpy as np
from rich.console import Console
from rich.logging import RichHandler
from rich.table import Table

from pancam_graph.base.errors import PancamGraphError
from pancam_graph.data import CrossValidation, Solution
from pancam_graph.images import cache_folder, is_cache
from pancam_graph.smoother import Update
from pancam_graph.solve import Iteration

__all__ = ["Parser", "Progress", "degrees", "print_summary", "resumable", "run", "show_log"]

BAD_INPUT = 2
INTERRUPTED = 130
_STAGES = {"screening": "looking for outliers", "approach": "adjusting", "solve": "adjusting to the end"}


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line."""

    def __init__(self, description: str) -> None:
        super().__init__(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
        self.add_argument("--verbose", action="store_true", help="log what is done, on standard error")

    def error(self, message: str) -> NoReturn:
        """Print one line and end with status 2."""
        self.exit(BAD_INPUT, f"{self.prog}: {message} (--help explains)\n")


def degrees(text: str) -> float:
    """An argument in degrees, as radians."""
    return float(np.deg2rad(float(text)))


def run(main: Callable[[], int]) -> NoReturn:
    """Run a program: bad input ends it with one sentence on standard error and status 2."""
    try:
        sys.exit(main())
    except (PancamGraphError, OSError) as error:
        sys.stderr.write(f"{str(error).strip()}\n")
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt as interrupt:
        sys.stderr.write(f"{str(interrupt) or 'interrupted; nothing was written'}\n")
        sys.exit(INTERRUPTED)


@contextmanager
def resumable(out: Path) -> Iterator[None]:
    """While the block runs, what it keeps in the cache of the folder `out` outlives an interrupt.

    The interrupt then says how to go on. Bad input leaves nothing behind that was not there before.
    """
    before = [path for path in (out, cache_folder(out)) if path.exists()]
    try:
        yield
    except KeyboardInterrupt:
        if is_cache(cache_folder(out)):
            raise KeyboardInterrupt(
                f"interrupted; no results were written; what was found in the images so far is in "
                f"{cache_folder(out)}: run the same command again to go on from there"
            ) from None
        raise
    except PancamGraphError:
        if is_cache(cache_folder(out)) and cache_folder(out) not in before:
            shutil.rmtree(cache_folder(out) if out in before else out, ignore_errors=True)
        raise


def show_log(*, verbose: bool) -> None:
    """Send the package's log to standard error, if asked for."""
    if verbose:
        console = Console(stderr=True)
        logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[RichHandler(console=console)])


class Progress:
    """A line on the terminal that says what is going on; nothing where standard error is no terminal."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self._status = self.console.status("") if self.console.is_terminal else None

    @contextmanager
    def shown(self, text: str) -> Iterator[None]:
        """Show the line while the block runs."""
        self.say(text)
        if self._status is None:
            yield
            return
        with self._status:
            yield

    def say(self, text: str) -> None:
        """Change the line."""
        if self._status is not None:
            self._status.update(text)

    def counted(self, what: str, done: int, total: int) -> None:
        """Progress of what is done one by one."""
        self.say(f"{what} {done} of {total}")

    def iteration(self, iteration: Iteration) -> None:
        """Progress of the solve."""
        self.say(f"{_STAGES[iteration.stage]}: step {iteration.number}, cost {iteration.cost:.6g}")

    def stop(self, update: Update) -> None:
        """A line for a stop that was added; on standard output, which a terminal or a file shows."""
        closed = "".join(f", closes a loop to {c.other}" for c in update.closures if c.accepted)
        line = (
            f"{update.stop}: {update.observations} observations, cost {update.cost:.6g}, "
            f"{update.blocks} blocks, {update.relinearised} relinearised, {update.seconds:.3f} s{closed}"
        )
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()


def print_summary(solution: Solution, where: str) -> None:
    """What a solve did: a table on a terminal, one line where standard output is piped.

    Warnings then go to standard error, a line each.
    """
    used, total = int(solution.used.sum()), len(solution.used)
    warnings = solution.warnings
    if solution.cross_validation is not None:
        warnings = (*warnings, *solution.cross_validation.warnings)
    console = Console()
    if not console.is_terminal:
        sys.stdout.write(
            f"{'converged' if solution.converged else 'NOT converged'}: RMS {solution.rms_initial_px:.3f} -> "
            f"{solution.rms_final_px:.3f} px over {used} of {total} observations; {where}\n"
        )
        for line in _of_images(solution):
            sys.stdout.write(f"{line}\n")
        if solution.cross_validation is not None:
            sys.stdout.write(f"{_of_cross_validation(solution.cross_validation)}\n")
        sys.stderr.writelines(f"warning: {warning}\n" for warning in warnings)
        return
    table = Table(title=solution.traverse.name or None, title_justify="left")
    for column in ("", "before", "after"):
        table.add_column(column, justify="right" if column else "left")
    table.add_row(
        "RMS of the residuals, px", f"{solution.rms_initial_px:.3f}", f"{solution.rms_final_px:.3f}"
    )
    table.add_row("cost", f"{solution.cost_initial:.6g}", f"{solution.cost_final:.6g}")
    table.add_row("observations", f"{total}", f"{used} used")
    console.print(table)
    state = "converged" if solution.converged else "[bold red]not converged[/]"
    console.print(f"{state}: {solution.stop_reason}; {solution.seconds.solve:.1f} s")
    for line in _of_images(solution):
        console.print(line, highlight=False)
    if solution.cross_validation is not None:
        console.print(_of_cross_validation(solution.cross_validation), highlight=False)
    for warning in warnings:
        console.print(f"[yellow]warning[/] {warning}", highlight=False)
    console.print(f"results in [bold]{where}[/]", highlight=False)


def _of_images(solution: Solution) -> tuple[str, ...]:
    """What was thrown away of what was found in images, and why; nothing for observations from elsewhere."""
    if solution.traverse.matching is None:
        return ()
    why = [f"{count} {name}" for name, count in sorted(Counter(solution.reason).items()) if name and count]
    if solution.came_back is not None:
        why.append(f"{int(solution.came_back.sum())} of those used came back after they had been set aside")
    left_out = int(np.count_nonzero(~solution.used))
    inside = f"in the solve: {left_out} of {len(solution.used)} observations left out; {', '.join(why)}"
    return (*solution.traverse.matching.summary(), inside)


def _of_cross_validation(found: CrossValidation) -> str:
    """One line: by how much honest sigmas exceed formal ones, and how halves fit each other."""
    relative = len(found.pairs) > 0
    ratio = found.relative_pointing.ratio if relative else found.pointing.ratio
    known = ratio[~np.isnan(ratio)]
    what = "relative pointing" if relative else "pointing"
    times = f"{np.median(known):.1f} times the formal ones (median)" if len(known) else "unknown"
    scored, expected = found.score_px("upper_lower")
    return (
        f"cross-validation: honest sigmas of {what} {times}; image halves under each other's cameras "
        f"{scored:.3f} px, by noise {expected:.3f}; {len(found.scores)} half solves, {found.seconds:.1f} s"
    )
