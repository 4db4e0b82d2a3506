"""The report as a file."""

from pathlib import Path

from pancam_graph.base.whole_files import whole_file
from pancam_graph.data import Solution
from pancam_graph.mosaic import WrittenMosaics
from pancam_graph.report._mosaic_page import make_mosaic_page
from pancam_graph.report._page import make_page
from pancam_graph.report._terrain import make_terrain_page
from pancam_graph.terrain import WrittenTerrain

__all__ = ["write_mosaic_page", "write_report", "write_terrain_page"]


def write_report(
    solution: Solution,
    path: Path | str,
    mosaics: WrittenMosaics | None = None,
    terrain: WrittenTerrain | None = None,
) -> None:
    """Write the report of a solution as one self-contained HTML file, whole or not at all.

    It needs no network: Plotly's script is inside, compressed. The same solution gives the same bytes. An
    existing file is replaced; its folder must exist. Pictures are taken from the traverse's folder where
    it has image files that can be read; without, residuals are drawn on an empty frame. `mosaics` is what
    `write_mosaics` returned; with it the page has a section of mosaics. `terrain` is what `write_terrain`
    returned, with the folder `terrain` beside the page.
    """
    whole_file(Path(path).resolve(), make_page(solution, mosaics, terrain).encode())


def write_terrain_page(terrain: WrittenTerrain, name: str, path: Path | str) -> None:
    """Write the page of the terrain of a traverse, by its name, into the folder of the terrain."""
    whole_file(Path(path).resolve(), make_terrain_page(terrain, name).encode())


def write_mosaic_page(mosaics: WrittenMosaics, name: str, path: Path | str) -> None:
    """Write the page of the mosaics of a traverse, by its name, into the folder of the mosaics."""
    whole_file(Path(path).resolve(), make_mosaic_page(mosaics.entries, mosaics.north_deg, name).encode())
