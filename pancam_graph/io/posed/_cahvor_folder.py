"""A folder of CAHV, CAHVOR and CAHVORE files, one a picture, their vectors in one world frame."""

from pathlib import Path

from pancam_graph.io._cahvor import read_cahvor
from pancam_graph.io.posed._posed_camera import PosedCamera

__all__ = ["is_cahvor_folder", "read_cahvor_folder"]

_SUFFIXES = {".cahv", ".cahvor", ".cahvore"}


def is_cahvor_folder(path: Path) -> bool:
    """Whether a folder has such files."""
    return any(file.suffix.lower() in _SUFFIXES for file in path.iterdir())


def read_cahvor_folder(path: Path) -> list[PosedCamera]:
    """The cameras of all such files, in the order of their names, which are those of pictures.

    Raises InputError as `read_cahvor` does.
    """
    found: list[PosedCamera] = []
    for file in sorted(path.iterdir()):
        if file.suffix.lower() in _SUFFIXES:
            camera, pose = read_cahvor(file).split()
            found.append(PosedCamera(name=file.stem, world_T_camera=pose, camera=camera))
    return found
