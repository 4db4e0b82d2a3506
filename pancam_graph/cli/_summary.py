"""What a solve did, in a few lines."""

import math
from collections import Counter
from collections.abc import Iterator

import numpy as np

from pancam_graph.base.text import shortened
from pancam_graph.cli._streams import is_terminal, write
from pancam_graph.data import CrossValidation, Solution, Verdict, VerdictTest

__all__ = ["print_summary", "verdict_lines"]

_UNDEFINED = "undefined"
"""The RMS of residuals of which one has no pixel, as of a point behind its camera at the start."""


def print_summary(solution: Solution, where: str, *, quiet: bool = False) -> None:
    """Print what a solve did: a table on a terminal, a few lines where standard output is piped.

    `where` names the folder of the results. Failed tests and warnings go to standard error where there is no
    terminal, a line each; with `quiet` they are all that is printed.
    """
    verdict = solution.verdict or Verdict(tests=())
    failures = tuple(f"{test.name}: {test.says}" for test in verdict.failures)
    warnings = (*solution.warnings, *(test.says for test in verdict.notes))
    if solution.cross_validation is not None:
        warnings = (*warnings, *solution.cross_validation.warnings)
    if not quiet and is_terminal("stdout"):
        _print_table(solution, where, failures, warnings)
        return
    if not quiet:
        write("stdout", _one_line(solution, where))
        for line in _lines_below(solution):
            write("stdout", line)
    for failure in failures:
        write("stderr", shortened(f"failed test: {failure}"))
    for warning in warnings:
        write("stderr", shortened(f"warning: {warning}"))


def verdict_lines(verdict: Verdict) -> Iterator[str]:
    """A verdict as lines of text: how many tests passed, then each test, failed ones first."""
    failed = len(verdict.failures)
    total = len(verdict.tests)
    yield f"FAILED {failed} of {total} tests" if failed else f"passed all {total} tests"
    for test in sorted(verdict.tests, key=lambda t: (t.passed, not t.is_note)):
        size = f"{_number(test.value):>9} of {_number(test.limit):<8}"
        yield f"{_state(test)}{test.name:<17} {size} {test.says}"


def _state(test: VerdictTest) -> str:
    return "FAILED  " if not test.passed else "advice  " if test.is_note else "passed  "


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _outcome(solution: Solution) -> str:
    """Whether a solution converged, and whether its numbers can be believed."""
    if not solution.converged:
        return "NOT converged"
    if solution.passed:
        return "converged"
    return "converged, but FAILED its tests"


def _one_line(solution: Solution, where: str) -> str:
    used, total = int(solution.used.sum()), len(solution.used)
    initial, final = (_pixels(x) for x in (solution.rms_initial_px, solution.rms_final_px))
    rms = f"{initial} -> {final} px" if initial != _UNDEFINED else f"{final} px (at the start {initial})"
    return f"{_outcome(solution)}: RMS {rms} over {used} of {total} observations; {where}"


def _print_table(
    solution: Solution, where: str, failures: tuple[str, ...], warnings: tuple[str, ...]
) -> None:
    from rich.table import Table

    from pancam_graph.cli._terminal import print_on_terminal, words

    table = Table(title=solution.traverse.name or None, title_justify="left")
    for column in ("", "before", "after"):
        table.add_column(column, justify="right" if column else "left")
    table.add_row(
        "RMS of the residuals, px", _pixels(solution.rms_initial_px), _pixels(solution.rms_final_px)
    )
    table.add_row("cost", f"{solution.cost_initial:.6g}", f"{solution.cost_final:.6g}")
    table.add_row("observations", f"{len(solution.used)}", f"{int(solution.used.sum())} used")
    state = _outcome(solution) if solution.passed else (_outcome(solution), "bold red")
    print_on_terminal(
        table,
        words(state, f": {solution.stop_reason}; {solution.seconds.solve:.1f} s"),
        *_lines_below(solution),
        *(words(("failed test", "bold red"), f" {shortened(failure)}") for failure in failures),
        *(words(("warning", "yellow"), f" {shortened(warning)}") for warning in warnings),
        words("results in ", (where, "bold")),
    )


def _pixels(value: float) -> str:
    """A number of pixels; in words where observations that are used had no pixel there."""
    return f"{value:.3f}" if math.isfinite(value) else _UNDEFINED


def _lines_below(solution: Solution) -> tuple[str, ...]:
    """What there is to say of images and of cross-validation."""
    validated = solution.cross_validation
    return (*_of_images(solution), *([] if validated is None else [_of_cross_validation(validated)]))


def _of_images(solution: Solution) -> tuple[str, ...]:
    """What was left out of the observations that were found in images, and why.

    Nothing for observations from elsewhere.
    """
    if solution.traverse.matching is None:
        return ()
    why = [f"{count} {name}" for name, count in sorted(Counter(solution.reason).items()) if name and count]
    if solution.came_back is not None:
        why.append(f"{int(solution.came_back.sum())} of those used came back after they had been set aside")
    left_out = int(np.count_nonzero(~solution.used))
    inside = f"in the solve: {left_out} of {len(solution.used)} observations left out; {', '.join(why)}"
    return (*solution.traverse.matching.summary(), inside)


def _of_cross_validation(validated: CrossValidation) -> str:
    """One line: by how much honest sigmas exceed formal ones, and how halves fit each other."""
    relative = len(validated.pairs) > 0
    ratio = validated.relative_pointing.ratio if relative else validated.pointing.ratio
    known = ratio[~np.isnan(ratio)]
    what = "relative pointing" if relative else "pointing"
    times = f"{np.median(known):.1f} times the formal ones (median)" if len(known) else "unknown"
    scored, expected = validated.score_px("upper_lower")
    return (
        f"cross-validation: honest sigmas of {what} {times}; image halves under each other's cameras "
        f"{scored:.3f} px, by noise {expected:.3f}; {len(validated.scores)} half solves, "
        f"{validated.seconds:.1f} s"
    )
