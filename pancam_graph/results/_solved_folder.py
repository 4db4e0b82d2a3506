"""A folder of results together with the folder that was refined: what both say of the same drive."""

from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Traverse
from pancam_graph.io import read_input
from pancam_graph.results._results import recover_results
from pancam_graph.results._solution_json import SolutionFile, read_solution_json

__all__ = ["SOLUTION_JSON", "camera_poses", "read_solved"]

SOLUTION_JSON = "solution.json"


def read_solved(out: Path, folder: Path | None, instead: str = "name it") -> tuple[SolutionFile, Traverse]:
    """The `solution.json` of a folder of results, and the traverse that was refined, from its own folder.

    `folder` is that folder, or the one with all of those that were refined together; None: where it was then.
    `instead` says what to do where images of one eye have
    different cameras.

    Raises InputError for a folder without results, for pictures that are not there any more or belong to
    another drive, and for a solution whose images of one eye have different cameras, which its files do not
    say.
    """
    recover_results(out)
    path = out / SOLUTION_JSON
    file = read_solution_json(path)
    if folder is None and file.folder is None:
        raise InputError(f"{path}: folder: expected the folder that was refined, found none: name it")
    pictures = folder if folder is not None else (out / str(file.folder)).resolve()
    if not pictures.is_dir():
        raise InputError(
            f"{pictures}: expected the folder that was refined into {out}, found no folder: name it"
        )
    traverse = read_input(*(pictures / part for part in file.parts or ["."]))
    for kind, own, found in (
        ("stops", [s.id for s in traverse.stops], [s.id for s in file.stops]),
        ("images", [i.id for i in traverse.images], [i.id for i in file.images]),
        ("frames", [f.id for f in traverse.frames], [f.id for f in file.frames]),
        ("cameras", [e.name for e in traverse.rig.eyes], [c.name for c in file.cameras]),
    ):
        if own != found:
            raise InputError(f"{path}: {kind}: expected those of {pictures}, found those of another drive")
    for entry in file.refined:
        if entry.quantity == "calibration" and (entry.stop is not None or entry.image is not None):
            owner = f"image {entry.image}" if entry.image is not None else f"stop {entry.stop}"
            raise InputError(
                f"{path}: refined: expected one calibration an eye, found one of {owner}: {instead}"
            )
    return file, traverse


def camera_poses(file: SolutionFile, path: Path) -> tuple[FloatArray, FloatArray]:
    """Orientations (images, 3, 3) and centres (images, 3) of the adjusted cameras; NaN where unknown."""
    rotations, centres = np.full((len(file.images), 3, 3), np.nan), np.full((len(file.images), 3), np.nan)
    for row, image in enumerate(file.images):
        if image.world_T_camera is not None:
            pose = image.world_T_camera.pose(f"{path}: images: {image.id}")
            rotations[row], centres[row] = pose.rotation().matrix(), pose.translation()
    return rotations, centres
