"""A drive from a folder of results: pictures from the folder that was refined, cameras as they were found."""

from pathlib import Path

import numpy as np

from pancam_graph.results._solved_folder import SOLUTION_JSON, camera_poses, read_solved
from pancam_graph.results._stereo import STEREO_FILE, read_stereo
from pancam_graph.terrain import Drive

__all__ = ["read_drive"]


def read_drive(out: Path | str, folder: Path | str | None = None) -> Drive:
    """The drive of a folder of results. `folder` is the one that was refined; None: where it was then.

    Raises InputError as `read_solved` does.
    """
    out = Path(out)
    file, traverse = read_solved(out, None if folder is None else Path(folder), "use refine --terrain")
    path = out / SOLUTION_JSON
    eyes = [entry.eye(f"{path}: cameras: {entry.name}") for entry in file.cameras]
    rotations, centres = camera_poses(file, path)
    sigmas = [(f.sigma_pan_rad, f.sigma_tilt_rad) for f in file.frames]
    return Drive(
        traverse=traverse,
        cameras=tuple(eyes[eye].camera for eye in traverse.image_eye.tolist()),
        world_R_camera=rotations,
        world_t_camera=centres,
        stereo=read_stereo(out / STEREO_FILE, traverse),
        angle_sigma_rad=np.array([[np.nan if s is None else s for s in pair] for pair in sigmas]),
    )
