"""The report as a file."""

from pathlib import Path

from pancam_graph.base.whole_files import whole_file
from pancam_graph.data import Solution
from pancam_graph.mosaic import WrittenMosaics
from pancam_graph.report._page import make_page

__all__ = ["write_report"]


def write_report(solution: Solution, path: Path | str, mosaics: WrittenMosaics | None = None) -> None:
    """Write the report of a solution as one self-contained HTML file, whole or not at all.

    It needs no network: Plotly's script is inside, compressed. The same solution gives the same bytes. An
    existing file is replaced; its folder must exist. Pictures are taken from the traverse's folder where
    it has image files that can be read; without, residuals are drawn on an empty frame. `mosaics` is what
    `write_mosaics` returned; with it the page has a section of mosaics.
    """
    whole_file(Path(path).resolve(), make_page(solution, mosaics).encode())
