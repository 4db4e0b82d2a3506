"""The report: one HTML file that explains a solution."""

from pathlib import Path

from pancam_graph.images.mosaic import WrittenMosaics
from pancam_graph.report._drive import DriveStep, write_drive
from pancam_graph.report._page import make_page
from pancam_graph.solution import Solution

__all__ = ["DriveStep", "write_drive", "write_report"]


def write_report(solution: Solution, path: Path | str, mosaics: WrittenMosaics | None = None) -> None:
    """Write the report of a solution as one self-contained HTML file.

    It needs no network: Plotly's script is inside, compressed. The same solution gives the same bytes. An
    existing file is replaced; its folder must exist. Pictures are taken from the traverse's folder where
    it has image files that can be read; where not, residuals are drawn on an empty frame. `mosaics` are what
    `write_mosaics` wrote beside; the page has a section of them then.
    """
    Path(path).write_text(make_page(solution, mosaics), encoding="utf-8", newline="\n")
