"""The subcommands, in the order of help. To add one: write its module and register it here."""

from collections.abc import Mapping

from pancam_graph.cli._check import CHECK
from pancam_graph.cli._command import Command
from pancam_graph.cli._completion import COMPLETION
from pancam_graph.cli._convert import CONVERT
from pancam_graph.cli._drive import DRIVE
from pancam_graph.cli._init import INIT
from pancam_graph.cli._refine import REFINE
from pancam_graph.cli._register import REGISTER
from pancam_graph.cli._render import RENDER
from pancam_graph.cli._simulate import SIMULATE
from pancam_graph.cli._terrain import TERRAIN

__all__ = ["COMMANDS"]

COMMANDS: Mapping[str, Command] = {
    c.name: c for c in (REFINE, INIT, CHECK, TERRAIN, REGISTER, CONVERT, SIMULATE, RENDER, DRIVE, COMPLETION)
}
