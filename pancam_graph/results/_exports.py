"""What comes after an adjustment: exports that a folder of results may hold, by name."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, cast, get_args

from pancam_graph.base.errors import InputError
from pancam_graph.data import Solution, Traverse
from pancam_graph.results._brightness import Brightness
from pancam_graph.results._camera_models import fill_cameras, require_cahv_family
from pancam_graph.results._colmap import fill_colmap

__all__ = ["EXPORTS", "Export", "check_exports", "fill_exports"]

Export = Literal["colmap", "cahvor"]
"""Folders beside the other results: a COLMAP workspace, camera models as text."""
EXPORTS: tuple[Export, ...] = get_args(Export)


def check_exports(traverse: Traverse, exports: Iterable[str]) -> tuple[Export, ...]:
    """The exports, once each, if a solution of the traverse can have them; for before a long solve.

    Raises InputError for an unknown name, and for cameras that the models of `cahvor` cannot say.
    """
    chosen = tuple(dict.fromkeys(exports))
    for name in chosen:
        if name not in EXPORTS:
            raise InputError(f"export: expected {' or '.join(EXPORTS)}, found {name!r}")
    if "cahvor" in chosen:
        require_cahv_family(traverse)
    return cast("tuple[Export, ...]", chosen)


def fill_exports(solution: Solution, exports: Iterable[Export], out: Path, brightness: Brightness) -> None:
    """Write the exports into folders of their names in a folder of results."""
    for name in exports:
        folder = out / name
        folder.mkdir()
        if name == "colmap":
            fill_colmap(solution, folder, brightness)
        else:
            fill_cameras(solution, folder)
