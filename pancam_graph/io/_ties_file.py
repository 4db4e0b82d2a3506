"""Ties in a file of their own: for a drive whose folder has no `traverse.json`, or that others look after."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.base.whole_files import whole_file
from pancam_graph.data import Constraint, Site, StopPlacement, Surface, Traverse
from pancam_graph.io._constraint_entries import AnyConstraint, constraint_entry
from pancam_graph.io._entries import TIES_FORMAT, VERSION, Entry
from pancam_graph.io._inside import inside
from pancam_graph.io._json import prefixed, read_json, validated
from pancam_graph.io._surfaces import read_surface

__all__ = ["constraints_of", "read_ties", "write_ties"]


_FREE_RAD, _FREE_M = 1.0, 100.0


class _TiesFile(Entry):
    format: Literal["pancam-graph/ties"] = "pancam-graph/ties"
    version: Literal[1] = 1
    constraints: list[AnyConstraint]


def read_ties(path: Path | str, traverse: Traverse) -> Traverse:
    """The traverse with the ties of a file beside its own; surfaces lie in the folder of that file.

    A stop that the traverse holds (sigma 0: the world frame is its own) and that has a tie of its pose here
    is held by the tie instead, its own sigmas become 1 rad and 100 m.

    Raises InputError naming file and entry: for what `traverse.json` would be refused for too.
    """
    path = Path(path)
    entries = validated(_TiesFile, read_json(path, TIES_FORMAT, VERSION), path)
    places = np.array([stop.world_T_mast.translation()[:2] for stop in traverse.stops])
    with prefixed(path):
        ties = constraints_of(entries.constraints, path.parent, places, traverse.site)
        placed = {tie.stop for tie in ties if isinstance(tie, StopPlacement)}
        stops = tuple(
            replace(stop, sigma_rotation_rad=_FREE_RAD, sigma_translation_m=_FREE_M)
            if stop.id in placed and not stop.sigmas.any()
            else stop
            for stop in traverse.stops
        )
        return replace(traverse, stops=stops, constraints=(*traverse.constraints, *ties))


def write_ties(ties: Sequence[StopPlacement], path: Path | str) -> None:
    """Write ties of stops to a new file, whole. Raises InputError where one is there or cannot be written."""
    path = Path(path)
    if path.exists():
        raise InputError(f"{path}: expected a new file, found one that is there")
    entries = [constraint_entry(tie, {}) for tie in ties]
    content = _TiesFile(constraints=entries).model_dump()  # type: ignore[arg-type]  # of its union
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    try:
        whole_file(path, f"{text}\n".encode())
    except OSError as error:
        raise InputError(f"{path}: expected a file to write, found: {error}") from error


def constraints_of(
    entries: Sequence[AnyConstraint], folder: Path, near_m: FloatArray, site: Site | None
) -> tuple[Constraint, ...]:
    """The constraints that entries say; each surface in `folder` is read once, near places (n, 2)."""
    constraints, surfaces = list[Constraint](), dict[str, Surface]()
    for i, entry in enumerate(entries):
        with prefixed(f"constraints[{i}] ({entry.kind})"):
            if isinstance(file := getattr(entry, "file", None), str) and file not in surfaces:
                surfaces[file] = read_surface(inside(folder, file, "file"), near_m, site)
            constraints.append(entry.constraint(surfaces))
    return tuple(constraints)
