"""All that a folder of results may hold. To add an output: a module with its writer, and an entry here.

What the command offers, what is checked before a solve, what is written and what is recognised as an older
result follow from `OUTPUTS`. Listing names imports no writer.
"""

# Each writer is imported when it is first used, so that `--help` does not wait for OpenCV and Plotly.
# ruff: noqa: PLC0415

from collections.abc import Iterable

from pancam_graph.base.errors import InputError
from pancam_graph.data import Traverse
from pancam_graph.results._older import EXPORT_FOLDER, MOSAIC_FOLDER, SOLUTION_FILE, TERRAIN, TERRAIN_FOLDER
from pancam_graph.results._output import Output, OutputWriter

__all__ = ["EXPORTS", "OUTPUTS", "SOLUTION", "check_exports"]

SOLUTION = "solution.json"
"""The output without which a folder is no folder of results."""


def _points() -> OutputWriter:
    from pancam_graph.results._ply import POINTS

    return POINTS


def _colmap() -> OutputWriter:
    from pancam_graph.results._colmap import COLMAP

    return COLMAP


def _cahvor() -> OutputWriter:
    from pancam_graph.results._camera_models import CAMERAS

    return CAMERAS


def _rig() -> OutputWriter:
    from pancam_graph.results._rig import RIG

    return RIG


def _gis() -> OutputWriter:
    from pancam_graph.results._gis import GIS

    return GIS


def _stereo() -> OutputWriter:
    from pancam_graph.results._stereo import STEREO

    return STEREO


def _residuals() -> OutputWriter:
    from pancam_graph.results._residuals import RESIDUALS

    return RESIDUALS


def _residuals_csv() -> OutputWriter:
    from pancam_graph.results._residuals import RESIDUALS_CSV

    return RESIDUALS_CSV


def _smoother() -> OutputWriter:
    from pancam_graph.results._smoother import SMOOTHER

    return SMOOTHER


def _mosaics() -> OutputWriter:
    from pancam_graph.results._mosaics import MOSAICS

    return MOSAICS


def _terrain() -> OutputWriter:
    from pancam_graph.results._terrain import TERRAIN_WRITER

    return TERRAIN_WRITER


def _report() -> OutputWriter:
    from pancam_graph.results._report import REPORT

    return REPORT


def _solution() -> OutputWriter:
    from pancam_graph.results._solution_json import SOLUTION_WRITER

    return SOLUTION_WRITER


OUTPUTS = (
    Output(name="points.ply", when="always", writer=_points),
    Output(
        name="colmap",
        when="export",
        says="undistorted images and a model with rigs and frames, for dense reconstruction",
        writer=_colmap,
        older=EXPORT_FOLDER,
    ),
    Output(
        name="cahvor",
        when="export",
        says="the refined cameras as text files",
        writer=_cahvor,
        older=EXPORT_FOLDER,
    ),
    Output(
        name="rig",
        when="export",
        says="the refined rig with its covariance, for --use-rig of another run, and its cameras as text",
        writer=_rig,
        older=EXPORT_FOLDER,
    ),
    Output(
        name="gis",
        when="export",
        says="stops, ellipses, views and points for GIS programs: GeoPackage, with a site GeoJSON and KML",
        writer=_gis,
        older=EXPORT_FOLDER,
    ),
    Output(name="residuals.npz", when="always", writer=_residuals),
    Output(name="stereo.npz", when="always", writer=_stereo),
    Output(name="residuals.csv", when="csv", writer=_residuals_csv),
    Output(name="smoother.npz", when="smoother", writer=_smoother),
    Output(name="mosaics", when="mosaics", writer=_mosaics, older=MOSAIC_FOLDER),
    Output(name=TERRAIN, when="terrain", writer=_terrain, older=TERRAIN_FOLDER),
    Output(name="report.html", when="report", writer=_report),
    # Last: it says how long the others took, and what they warned of.
    Output(name=SOLUTION, when="always", writer=_solution, older=SOLUTION_FILE),
)
"""The outputs in the order in which they are written."""

EXPORTS = {output.name: output.says for output in OUTPUTS if output.when == "export"}
"""What may be asked for besides the usual outputs: the name of each, and what it is."""


def check_exports(traverse: Traverse, exports: Iterable[str]) -> tuple[str, ...]:
    """The exports, once each, if a solution of the traverse can have them; for before a long solve.

    Raises InputError for an unknown name, and for what an export cannot say, as a lens that the models of
    `cahvor` have no equal of.
    """
    chosen = tuple(dict.fromkeys(exports))
    for name in chosen:
        if name not in EXPORTS:
            raise InputError(f"export: expected {' or '.join(EXPORTS)}, found {name!r}")
    for output in OUTPUTS:
        if output.name in chosen:
            output.writer().check(traverse)
    return chosen
