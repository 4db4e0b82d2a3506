"""Parsing a command line: a complaint is one sentence that names the nearest known option."""

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from pancam_graph.base.choices import nearest
from pancam_graph.base.text import shortened, visible
from pancam_graph.cli._streams import must_write, write_rendered

__all__ = [
    "COMMON_OPTIONS",
    "Assignment",
    "CommandParser",
    "Flag",
    "LateChoice",
    "Parser",
    "ScriptParser",
    "Several",
    "above_zero",
    "add_images_option",
    "degrees",
]

BAD_INPUT = 2
COMMON_OPTIONS = ("verbose", "quiet", "log", "progress")
"""Long names of the options that every subcommand has, without --config."""


def degrees(text: str) -> float:
    """An argument in degrees, as radians."""
    return math.radians(float(text))


def above_zero(text: str) -> float:
    """An argument that is a number above 0. Raises ArgumentTypeError for others."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number above 0, found {text!r}")
    return number


@dataclass(frozen=True)
class LateChoice:
    """Type of an argument that is one of some names, which are looked up when an argument is given.

    Looking up imports the module that knows the names: help does not wait for that.
    """

    names: Callable[[], Iterable[str]]
    """Looks the names up."""

    def takes(self, word: str) -> bool:
        """Whether a word of a command line is one of the names."""
        return word in self.names()

    def __call__(self, text: str) -> str:
        """The argument itself. Raises ArgumentTypeError where it is none of the names."""
        names = list(self.names())
        if text not in names:
            raise argparse.ArgumentTypeError(
                f"expected one of {', '.join(names)}; found {text!r}{nearest(text, names)}"
            )
        return text


@dataclass(frozen=True)
class Assignment:
    """Type of an argument NAME=VALUE; what names and values there are, others check."""

    def takes(self, word: str) -> bool:
        """Whether a word of a command line can be such an argument, and is no option."""
        return "=" in word and not word.startswith("-")

    def __call__(self, text: str) -> str:
        """The argument itself."""
        return text


class Several(argparse.Action):
    """A list of arguments whose option may be given more than once.

    The first time on a command line, it begins a new list: defaults and a configuration file, which give
    tuples, do not add to what the command line says.
    """

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Add the argument to the list."""
        before = getattr(namespace, self.dest, ())
        setattr(namespace, self.dest, [*(before if isinstance(before, list) else ()), values])


class Flag(argparse.BooleanOptionalAction):
    """A choice between --NAME and --no-NAME, with the help as it is given under every version of Python."""

    def __init__(self, option_strings: Sequence[str], dest: str, *, help: str, default: bool = False) -> None:  # noqa: A002  argparse's name
        super().__init__(option_strings, dest, default=default, help=help)
        self.help = help


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one sentence.

    Options are given by their whole names: the beginning of one may be that of another in a later version.
    """

    def __init__(self, description: str = "", **others: Any) -> None:
        super().__init__(
            description=description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
            **others,
        )

    def error(self, message: str) -> NoReturn:
        """Print one line and end with status 2."""
        complaint = shortened(visible(f"{self.prog}: {' '.join(message.split())}"))
        self.exit(BAD_INPUT, f"{complaint} (--help explains)\n")

    def _print_message(self, message: str, file: object = None) -> None:
        """Print help or version on standard output, which are all that was asked for, or a complaint."""
        if file is sys.stdout:
            must_write(message)
        else:
            write_rendered("stderr", message)

    def long_options(self) -> dict[str, argparse.Action]:
        """Every option by its long name, without dashes."""
        return {o.removeprefix("--"): a for a in self._actions for o in a.option_strings if o[:2] == "--"}

    def option(self, word: str) -> argparse.Action | None:
        """The option that a word of a command line gives, by its whole name; None for other words.

        Ends the program with a sentence where no option has this name.
        """
        name = word.partition("=")[0].removeprefix("--")
        if not word.startswith("--") or word == "--" or " " in name:
            return None
        options = self.long_options()
        if name not in options:
            near = nearest(f"--{name}", [f"--{known}" for known in options])
            self.error(f"expected one of its options, found --{name}{near}")
        return options[name]


class ScriptParser(Parser):
    """The parser of a script that is no subcommand: it has --verbose."""

    def __init__(self, description: str) -> None:
        super().__init__(description)
        self.add_argument("--verbose", action="store_true", help="log what is done, on standard error")


class CommandParser(Parser):
    """The parser of a subcommand, with the options that all of them have."""

    def __init__(self, description: str = "", *, command: str, **others: Any) -> None:
        super().__init__(description, **others)
        add = self.add_argument_group("options of every subcommand").add_argument
        add("--config", type=Path, metavar="FILE", help="read options from a TOML file too; see below")
        add("--verbose", action=Flag, help="log what is done, on standard error")
        add("--quiet", action=Flag, help="print nothing but warnings and errors")
        add("--log", type=Path, metavar="FILE", help="append a full log with times to a file")
        add(
            "--progress",
            choices=("auto", "json"),
            default="auto",
            help="auto: a line that changes on a terminal, elsewhere a line every 20 s of long work "
            "(default); json: every event as a line of JSON on standard error",
        )
        self.epilog = (
            f"A file of options (TOML) has a table for each subcommand, here [{command}]. Its keys are long\n"
            "names of options without dashes; its values are text, numbers, true or false, and lists where\n"
            f"an option takes several. {', '.join(COMMON_OPTIONS)} may also stand above the tables, for\n"
            "all subcommands. Paths count from the folder that the program runs in. The command line wins\n"
            "over the file."
        )


def add_images_option(parser: CommandParser) -> None:
    """Add the option that says where the pictures of a folder of results are now."""
    parser.add_argument(
        "--images",
        type=Path,
        metavar="FOLDER",
        help="the folder that was refined, or that has all that were refined together, where it is not any "
        "more where it was then",
    )
