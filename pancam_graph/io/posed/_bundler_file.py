"""Bundler: `bundle.out` and the list of its images.

Source: the manual of Bundler (version 0.3). Its camera looks along -z, y up. The principal point is the
middle of a picture, whose size the files do not say, so that no lens is read.
"""

from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import wxyz_from_rotation
from pancam_graph.io._json import read_bytes, short
from pancam_graph.io._told_numbers import told_number
from pancam_graph.io.posed._posed_camera import PosedCamera, world_T_camera_of

__all__ = ["is_bundler", "read_bundler"]

_FILES = ("bundle.out", "bundle.rd.out")
_LISTS = ("list.txt", "bundle.rd.out.list.txt")
_CAMERA_R_BUNDLER = np.diag([1.0, -1.0, -1.0])
_OF_CAMERA = 15
"""Numbers of a camera: focal length, k1, k2, a rotation by rows, a translation."""
_NOT_A_TURN = 1e-3


def is_bundler(path: Path) -> bool:
    """Whether a folder has Bundler's output."""
    return any((path / name).is_file() for name in _FILES)


def read_bundler(path: Path) -> list[PosedCamera]:
    """The cameras of a folder with `bundle.out`, and `list.txt` in it or in the folder above.

    Cameras of focal length 0, which were not placed, are left out. Raises InputError naming file and entry
    for what is missing, cut off or malformed.
    """
    file = next(path / name for name in _FILES if (path / name).is_file())
    lists = [folder / name for folder in (path, path.parent) for name in _LISTS]
    listed = next((one for one in lists if one.is_file()), None)
    if listed is None:
        raise InputError(f"{path}: expected list.txt with the names of the pictures, found none")
    names = [line.split()[0] for line in _text(listed).splitlines() if line.strip()]
    words = [word for line in _text(file).splitlines() if not line.startswith("#") for word in line.split()]
    count = told_number(words[0]) if words else None
    if count is None or count != int(count) or count < 0:
        raise InputError(f"{file}: expected the count of cameras first, found {short(words[:1])}")
    if count > len(names):
        raise InputError(
            f"{listed}: expected {int(count)} names as {file.name} has cameras, found {len(names)}"
        )
    found: list[PosedCamera] = []
    for i in range(int(count)):
        where, begin = f"{file}: camera {i}", 2 + _OF_CAMERA * i
        told = [told_number(word) for word in words[begin : begin + _OF_CAMERA]]
        if len(told) != _OF_CAMERA or None in told:
            raise InputError(
                f"{where}: expected {_OF_CAMERA} numbers, found {short(words[begin:][:_OF_CAMERA])}"
            )
        numbers = np.array([number for number in told if number is not None])
        if numbers[0] == 0:
            continue
        R = numbers[3:12].reshape(3, 3)
        if np.abs(R @ R.T - np.eye(3)).max() > _NOT_A_TURN or np.linalg.det(R) < 0:
            raise InputError(f"{where}: expected a rotation, found {R.tolist()}")
        wxyz = wxyz_from_rotation(_CAMERA_R_BUNDLER @ R).tolist()
        translation = (_CAMERA_R_BUNDLER @ numbers[12:]).tolist()
        pose = world_T_camera_of(wxyz, translation, where)
        found.append(PosedCamera(name=names[i], world_T_camera=pose, camera=None))
    return found


def _text(file: Path) -> str:
    try:
        return read_bytes(file).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: expected text in UTF-8, found other bytes at {error.start}") from error
