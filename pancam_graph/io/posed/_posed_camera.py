"""A camera with its pose as another program found it, and which image of a traverse it is."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import gtsam

from pancam_graph.base.choices import some_of
from pancam_graph.base.errors import GeometryError, InputError
from pancam_graph.base.geometry import pose_from_wxyz
from pancam_graph.base.text import visible
from pancam_graph.cameras import Camera
from pancam_graph.data import Traverse

__all__ = ["PosedCamera", "images_of", "world_T_camera_of"]

_FARTHEST = 1e15


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedCamera:
    """One picture's camera in the world of the program that placed it."""

    name: str
    """The picture, as the program calls it: a path or a name."""
    world_T_camera: gtsam.Pose3
    """Camera x right, y down, z forward; the world is turned, placed and scaled as the program chose."""
    camera: Camera | None
    """Its lens, pixels counting from the centre of the first; None where the files do not say all of it."""


def world_T_camera_of(
    camera_R_world_wxyz: list[float], camera_t_world: list[float], where: str
) -> gtsam.Pose3:
    """The pose of a camera from rotation and translation of the world into it.

    Raises InputError beginning with `where` for a quaternion of norm 0 and numbers that are not finite.
    """
    if not all(abs(number) < _FARTHEST for number in camera_t_world):
        raise InputError(f"{where}: expected a translation of finite numbers, found {camera_t_world}")
    try:
        return pose_from_wxyz(camera_R_world_wxyz, camera_t_world).inverse()
    except GeometryError as error:
        raise InputError(f"{where}: {error}") from error


def images_of(traverse: Traverse, cameras: Sequence[PosedCamera]) -> tuple[dict[int, PosedCamera], list[str]]:
    """Cameras by the row of the image that they are of, and a warning for those that are of none.

    An image is known by the path of its file, else by the file's name, else by either without its ending,
    or by its id. A name that may mean several images is of none. Raises InputError where no camera is of an
    image.
    """
    keys: dict[str, set[int]] = {}
    for row, image in enumerate(traverse.images):
        for key in _keys(image.id, image.file):
            keys.setdefault(key, set()).add(row)
    found: dict[int, PosedCamera] = {}
    strange: list[str] = []
    for camera in cameras:
        rows = next((keys[key] for key in _keys("", camera.name) if key in keys), set())
        if len(rows) == 1:
            found.setdefault(next(iter(rows)), camera)
        else:
            strange.append(visible(camera.name))
    if not found:
        raise InputError(
            f"expected cameras of pictures of {traverse.name}, found others: {some_of(strange) or 'none'}"
        )
    left_out = f"cameras of no picture of {traverse.name} are left out: {some_of(strange)}"
    return found, [left_out] if strange else []


def _keys(name: str, file: str | None) -> list[str]:
    """What a picture may be called, most telling first."""
    path = PurePosixPath((file or "").replace("\\", "/"))
    stem = str(path.with_suffix("")) if path.name else ""
    return [
        key for key in dict.fromkeys((str(path) if file else "", path.name, stem, path.stem, name)) if key
    ]
