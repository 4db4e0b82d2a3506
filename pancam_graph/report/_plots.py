"""The figures of the report as pictures: SVG and PNG, drawn by a browser without a window."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pancam_graph.base.errors import InputError
from pancam_graph.base.extras import needed
from pancam_graph.data import Solution
from pancam_graph.report._figures import make_corrections, make_histogram
from pancam_graph.report._look import Figure
from pancam_graph.report._map import make_map
from pancam_graph.report._rig import rig_section
from pancam_graph.report._scene import make_masts, scene_figure
from pancam_graph.report._shown_terrain import shown_terrain

__all__ = ["require_plots", "write_plots"]

_EXTRA = "plots"
_WIDTH_PX, _HEIGHT_PX = 1000, 620
_PNG_SCALE = 2


def require_plots() -> None:
    """Raise InputError unless figures can be drawn: the extra `plots`, and a browser of the Chrome family."""
    needed("kaleido", _EXTRA)
    browser: Any = needed("choreographer.browsers.chromium", _EXTRA)
    if browser.Chromium.find_browser(skip_local=False) is None:
        raise InputError(
            "plots: expected Chrome or Chromium on this machine (or its path in BROWSER_PATH), found none"
        )


def write_plots(solution: Solution, folder: Path) -> dict[str, str]:
    """Draw each figure of the report that needs no choice of an image, as ID.svg and ID.png into a folder.

    Returns the caption of each, by its id. Pictures are 1000 x 620 pixels, PNG twice that. The solution's
    scene is seen as the page first shows it. Raises InputError as `require_plots` does, and where the browser
    fails.
    """
    require_plots()
    figures = _figures(solution)
    kaleido: Any = needed("kaleido", _EXTRA)
    wanted = [_specification(figure, folder, ending) for figure in figures for ending in ("svg", "png")]
    try:
        failed: Sequence[Exception] = kaleido.write_fig_from_object_sync(wanted) or ()
    except RuntimeError as error:
        failed = (error,)
    if failed:
        raise InputError(f"plots: expected a browser that draws, found: {' '.join(str(failed[0]).split())}")
    return {figure.id: figure.caption for figure in figures}


def _figures(solution: Solution) -> list[Figure]:
    terrain = shown_terrain(solution)
    scene, _ = scene_figure(solution, terrain, make_masts(solution))
    _, of_rig = rig_section(solution)
    return [scene, make_map(solution, terrain), make_histogram(solution), make_corrections(solution), *of_rig]


def _specification(figure: Figure, folder: Path, ending: str) -> dict[str, object]:
    drawn = {"data": list(figure.traces), "layout": figure.layout | {"autosize": False}}
    scale = _PNG_SCALE if ending == "png" else 1
    size = {"format": ending, "width": _WIDTH_PX, "height": _HEIGHT_PX, "scale": scale}
    return {"fig": drawn, "path": str(folder / f"{figure.id}.{ending}"), "opts": size}
