"""The figures of the report as pictures, and the tables of all results beside them."""

from pathlib import Path

from pancam_graph import report
from pancam_graph.data import Solution
from pancam_graph.results._exported import check_export, whole_export, write_export_json
from pancam_graph.results.formats import source_of
from pancam_graph.results.formats._tables import write_tables

__all__ = ["check_plots", "write_plots"]


def check_plots(folder: Path | str) -> None:
    """Raise InputError where `write_plots` would, as far as can be told before there is a solution."""
    report.require_plots()
    check_export(Path(folder))


def write_plots(solution: Solution, folder: Path | str) -> None:
    """Write every figure of the report as SVG and PNG, and tables as CSV, into a folder (docs/files.md).

    `export.json` there has the caption of each figure. Needs the extra `plots` and a browser of the Chrome
    family. Raises InputError without them, and as `whole_export` does.
    """
    with whole_export(Path(folder)) as place:
        captions = report.write_plots(solution, place)
        write_tables(source_of(solution), place)
        write_export_json(place, "plots", {"captions": captions})
