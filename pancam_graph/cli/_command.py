"""What a subcommand is."""

from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass

from pancam_graph.cli._parser import CommandParser, Parser
from pancam_graph.cli._progress import Progress
from pancam_graph.cli._streams import write

__all__ = ["Command", "Invocation"]


@dataclass(frozen=True, kw_only=True)
class Invocation:
    """One call of a subcommand."""

    arguments: Namespace
    """The values of its options."""
    progress: Progress
    """Where it tells its progress."""
    make_program: Callable[[], Parser]
    """Makes the parser of the whole program, with all subcommands."""

    def say(self, line: str) -> None:
        """Write a line on standard output, unless the user wants quiet."""
        if not self.arguments.quiet:
            write("stdout", line)


@dataclass(frozen=True, kw_only=True)
class Command:
    """A subcommand. Its module imports nothing heavy before `work` is called: help must be quick."""

    name: str
    """As it stands on the command line."""
    summary: str
    """One line for the list of subcommands."""
    description: str
    """What its own help says above the options."""
    add_options: Callable[[CommandParser], None]
    """Adds its options to a parser, which has those of every subcommand."""
    work: Callable[[Invocation], int]
    """Does what it is for, and returns the exit status."""
