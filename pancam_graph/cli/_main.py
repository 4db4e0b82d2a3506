"""The command `pancam-graph`: its parser, and the call of a subcommand."""

import os
import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from pancam_graph import __version__
from pancam_graph.base.choices import nearest
from pancam_graph.cli._collector import leave_to_the_system
from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._config import read_config
from pancam_graph.cli._ending import run, status_of
from pancam_graph.cli._log import check_log_outside, logged
from pancam_graph.cli._parser import Assignment, CommandParser, LateChoice, Parser, Several
from pancam_graph.cli._progress import Progress, display_for
from pancam_graph.cli._registry import COMMANDS

__all__ = ["main", "make_program", "parse", "run_script"]

_PROGRAM = "pancam-graph"
_DESCRIPTION = (
    "Bundle adjustment of mast camera panoramas: sharper pointing, poses and terrain, with uncertainties."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `pancam-graph` with the arguments of the process, or with those given; returns the exit status."""
    if argv is None:
        # Pydantic would look through all installed packages for plugins of its own.
        os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    words = list(sys.argv[1:] if argv is None else argv)
    status = status_of(lambda: _dispatched(words))
    if argv is None:
        leave_to_the_system()
    return status


def run_script(name: str) -> None:
    """Run a subcommand by itself with the arguments of the process, which ends with its status."""
    prog = Path(sys.argv[0]).name
    run(lambda: _called(COMMANDS[name], sys.argv[1:], prog))


def make_program() -> Parser:
    """The parser of the whole program, with all subcommands; for its help and for completion."""
    program = Parser(_DESCRIPTION, prog=_PROGRAM, epilog=f"{_PROGRAM} SUBCOMMAND --help explains one.")
    program.add_argument("--version", action="version", version=f"{_PROGRAM} {__version__}")
    below = program.add_subparsers(
        title="subcommands", dest="command", metavar="SUBCOMMAND", parser_class=CommandParser
    )
    for name, command in COMMANDS.items():
        parser = below.add_parser(
            name,
            help=command.summary,
            description=command.description,
            command=name,
            prog=f"{_PROGRAM} {name}",
        )
        command.add_options(parser)
    return program


def parse(command: Command, words: Sequence[str], prog: str) -> Namespace:
    """The arguments of a subcommand: those of the command line, else of its file of options, else defaults.

    Raises InputError for a file that is not as it should be; ends the program for a wrong command line.
    """
    parser = CommandParser(command.description, command=command.name, prog=prog)
    command.add_options(parser)
    spread = _one_by_one(parser, words)
    config = _config_file(parser, spread)
    values = {} if config is None else read_config(config, parser, command.name, COMMANDS)
    for action in parser.long_options().values():
        action.required = action.required and action.dest not in values
    arguments, extra = parser.parse_known_args(spread, Namespace(**values))
    if extra:
        parser.error(f"expected no more arguments, found {extra[0]!r}")
    if arguments.verbose and arguments.quiet:
        parser.error("expected --verbose or --quiet, found both")
    return arguments


def _dispatched(words: Sequence[str]) -> int:
    """Call the subcommand that the first word names."""
    if words and words[0] in COMMANDS:
        return _called(COMMANDS[words[0]], words[1:], f"{_PROGRAM} {words[0]}")
    program = make_program()
    expected = f"expected a subcommand ({', '.join(COMMANDS)})"
    if words:
        program.option(words[0])  # complains of an unknown one
        if words[0].startswith("-"):
            program.parse_args(words)  # --help and --version end here
        program.error(f"{expected}, found {words[0]!r}{nearest(words[0], COMMANDS)}")
    return program.error(f"{expected}, found none")


def _called(command: Command, words: Sequence[str], prog: str) -> int:
    """Parse the arguments of a subcommand, and do its work."""
    arguments = parse(command, words, prog)
    out = getattr(arguments, "out", None)
    if out is not None:
        check_log_outside(arguments.log, out)
    with logged(verbose=arguments.verbose, file=arguments.log):
        progress = Progress(display_for(arguments.progress, quiet=arguments.quiet), quiet=arguments.quiet)
        return command.work(Invocation(arguments=arguments, progress=progress, make_program=make_program))


def _one_by_one(parser: Parser, words: Sequence[str]) -> list[str]:
    """A command line in which each entry of a list that can be told stands behind an option of its own.

    `--export colmap cahvor FOLDER` becomes `--export colmap --export=cahvor FOLDER`: the list ends before
    the first word that is none of its entries, which argparse cannot do.
    """
    spread, waiting = list[str](), list(words)
    while waiting:
        word = waiting.pop(0)
        spread.append(word)
        if word == "--":
            break
        action = parser.option(word)
        if isinstance(action, Several) and isinstance(action.type, LateChoice | Assignment):
            if "=" not in word and waiting:
                spread.append(waiting.pop(0))
            while waiting and action.type.takes(waiting[0]):
                spread.append(f"{word.partition('=')[0]}={waiting.pop(0)}")
    return [*spread, *waiting]


def _config_file(parser: Parser, words: Sequence[str]) -> Path | None:
    """The file of options that a command line names; the last one counts."""
    file = None
    for number, word in enumerate(words):
        if word == "--":
            break
        action = parser.option(word)
        if action is not None and action.dest == "config":
            _, equals, value = word.partition("=")
            following = words[number + 1 : number + 2]
            file = Path(value) if equals else Path(following[0]) if following else file
    return file
