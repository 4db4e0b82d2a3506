"""The subcommand completion: what makes a shell complete this command's options and names."""

from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._parser import CommandParser, LateChoice, Parser
from pancam_graph.cli._streams import must_write

__all__ = ["COMPLETION"]

_DESCRIPTION = """\
Print a script that makes a shell complete subcommands, options and their choices.

bash: pancam-graph completion bash > ~/.local/share/bash-completion/completions/pancam-graph
zsh:  pancam-graph completion zsh > _pancam-graph, in a folder of $fpath
fish: pancam-graph completion fish > ~/.config/fish/completions/pancam-graph.fish

Exit status: 0 printed, 2 bad input or a fault.
"""


def _add_options(parser: CommandParser) -> None:
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), help="bash, zsh or fish")


def _work(call: Invocation) -> int:
    """Print the script."""
    import shtab

    program = call.make_program()
    _look_choices_up(program)
    must_write(f"{shtab.complete(program, call.arguments.shell)}\n")
    return 0


def _look_choices_up(parser: Parser) -> None:
    """Give every option the choices that are otherwise looked up when it is used."""
    for action in parser._actions:  # a parser has no other way to all of them
        if isinstance(action.type, LateChoice):
            action.choices = list(action.type.names())
        for below in action.choices.values() if isinstance(action.choices, dict) else ():
            if isinstance(below, Parser):
                _look_choices_up(below)


COMPLETION = Command(
    name="completion",
    summary="print a script for completion in bash, zsh or fish",
    description=_DESCRIPTION,
    add_options=_add_options,
    work=_work,
)
