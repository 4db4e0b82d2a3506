"""The subcommand check: the verdict on a solution that was written earlier."""

import json
from pathlib import Path

from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._parser import CommandParser, Flag

__all__ = ["CHECK"]

_DESCRIPTION = """\
Say whether a solution can be believed: the tests that refine made, each with its value and its limit.

OUT is a folder of results, or a solution.json.

Exit status: 0 converged and passed every test, 1 not, 2 bad input or a fault, 130 interrupted.
"""


def _add_options(parser: CommandParser) -> None:
    parser.add_argument("out", metavar="OUT", type=Path, help="folder of results")
    parser.add_argument("--json", action=Flag, help="print the verdict as JSON")


def _work(call: Invocation) -> int:
    """Read the solution, print its verdict."""
    from pancam_graph.base.errors import InputError
    from pancam_graph.cli._summary import verdict_lines
    from pancam_graph.results import read_solution_json, recover_results

    path: Path = call.arguments.out
    recover_results(path)
    path = path / "solution.json" if path.is_dir() else path
    file = read_solution_json(path)
    if file.verdict is None:
        raise InputError(f"{path}: verdict: expected the tests of a solution, found none: refine it again")
    text = json.dumps(file.verdict.model_dump(), indent=1, allow_nan=False, ensure_ascii=True)
    for line in text.splitlines() if call.arguments.json else verdict_lines(file.verdict.verdict()):
        call.say(line)
    return 0 if file.converged and file.verdict.verdict().passed else 1


CHECK = Command(
    name="check",
    summary="say whether a solution can be believed",
    description=_DESCRIPTION,
    add_options=_add_options,
    work=_work,
)
