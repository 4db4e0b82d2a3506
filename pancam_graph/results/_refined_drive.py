"""A drive from a folder of results: pictures from the folder that was refined, cameras as they were found."""

from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.io import read_input
from pancam_graph.results._results import recover_results
from pancam_graph.results._solution_json import SolutionFile, read_solution_json
from pancam_graph.terrain import Drive

__all__ = ["read_drive"]


def read_drive(out: Path | str, folder: Path | str | None = None) -> Drive:
    """The drive of a folder of results. `folder` is the one that was refined; None: where it was then.

    Raises InputError for a folder without results, for pictures that are not there any more or belong to
    another drive, and for a solution whose images of one eye have different cameras, which its files do not
    say.
    """
    out = Path(out)
    recover_results(out)
    path = out / "solution.json"
    file = read_solution_json(path)
    if folder is None and file.folder is None:
        raise InputError(f"{path}: folder: expected the folder that was refined, found none: name it")
    pictures = Path(folder) if folder is not None else (out / str(file.folder)).resolve()
    if not pictures.is_dir():
        raise InputError(
            f"{pictures}: expected the folder that was refined into {out}, found no folder: name it"
        )
    traverse = read_input(pictures)
    for kind, own, found in (
        ("images", [i.id for i in traverse.images], [i.id for i in file.images]),
        ("frames", [f.id for f in traverse.frames], [f.id for f in file.frames]),
        ("cameras", [e.name for e in traverse.rig.eyes], [c.name for c in file.cameras]),
    ):
        if own != found:
            raise InputError(f"{path}: {kind}: expected those of {pictures}, found those of another drive")
    _require_one_camera(file, path)
    eyes = [entry.eye(f"{path}: cameras: {entry.name}") for entry in file.cameras]
    poses = [_pose(file, row, path) for row in range(len(file.images))]
    sigmas = [(f.sigma_pan_rad, f.sigma_tilt_rad) for f in file.frames]
    return Drive(
        traverse=traverse,
        cameras=tuple(eyes[eye].camera for eye in traverse.image_eye.tolist()),
        world_R_camera=np.array([R for R, _ in poses]),
        world_t_camera=np.array([t for _, t in poses]),
        angle_sigma_rad=np.array([[np.nan if s is None else s for s in pair] for pair in sigmas]),
    )


def _require_one_camera(file: SolutionFile, path: Path) -> None:
    for entry in file.refined:
        if entry.quantity == "calibration" and (entry.stop is not None or entry.image is not None):
            owner = f"image {entry.image}" if entry.image is not None else f"stop {entry.stop}"
            raise InputError(
                f"{path}: refined: expected one calibration an eye, found one of {owner}: use refine "
                "--terrain"
            )


def _pose(file: SolutionFile, row: int, path: Path) -> tuple[FloatArray, FloatArray]:
    entry = file.images[row].world_T_camera
    if entry is None:
        return np.full((3, 3), np.nan), np.full(3, np.nan)
    pose = entry.pose(f"{path}: images: {file.images[row].id}")
    return pose.rotation().matrix(), pose.translation()
