"""A drive that refine reads: `traverse.json`, observations and pictures."""

from pathlib import Path

from pancam_graph.io import write_traverse
from pancam_graph.results._exported import write_export_json
from pancam_graph.results.formats._source import Source

__all__ = ["write_drive"]


def write_drive(source: Source, folder: Path) -> None:
    """Write a traverse folder into an empty folder: telemetry, the rig as told, observations, constraints.

    What an adjustment found is not in it. Pictures are copied along.
    """
    write_traverse(source.solution.traverse, folder)
    write_export_json(folder, "traverse", {})
