"""The images of one eye at one stop, where telemetry and where the adjustment puts them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pancam_graph.base.errors import ImageError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras import Camera
from pancam_graph.data import Solution
from pancam_graph.images import usable_mask
from pancam_graph.io import GreyImage, mask_file, read_mask, read_picture

__all__ = [
    "POINTINGS",
    "PlacedCamera",
    "PlacedImage",
    "Pointing",
    "View",
    "placed_images",
    "view_from_stop",
]

Pointing = Literal["telemetry", "refined"]
POINTINGS: tuple[Pointing, ...] = ("telemetry", "refined")


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedCamera:
    """A camera at a pose in the world."""

    camera: Camera
    world_R_camera: FloatArray
    """(3, 3) rotation of the camera in the world."""
    centre_m: FloatArray
    """(3,) centre in the world."""

    def project(self, points_m: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, 2) of world points (n, 3) and their validity; see `Camera.project`."""
        return self.camera.project((points_m - self.centre_m) @ self.world_R_camera)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedImage:
    """An image with its camera as telemetry and as the adjustment place it."""

    id: str
    grey: GreyImage
    usable: BoolArray
    """Where the image has data, of the image's shape."""
    wanted: BoolArray
    """Where the user's mask is white, of the same shape; everywhere without one."""
    at: dict[Pointing, PlacedCamera]


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """All cameras and landmarks as one pointing has them, in the world, seen from one stop's refined mast."""

    world_R_camera: FloatArray
    """(images, 3, 3) orientation of each camera."""
    world_t_camera: FloatArray
    """(images, 3) centre of each camera, metres."""
    landmarks_m: FloatArray
    """(landmarks, 3) metres; a row of NaN where there is no usable point."""


def view_from_stop(solution: Solution, stop: int, pointing: Pointing) -> View:
    """Cameras and landmarks of a pointing, with the stop's mast where the adjustment has it.

    Telemetry, and the landmarks that it gives, are carried along with the stop's mast: where a mosaic stands
    in the world is then the same for both pointings, and only what the stop's images say of each other
    differs.
    """
    final, initial = solution.final, solution.initial
    if pointing == "refined":
        return View(
            world_R_camera=final.world_R_camera,
            world_t_camera=final.world_t_camera,
            landmarks_m=final.landmarks_m,
        )
    move = final.world_T_mast[stop].compose(initial.world_T_mast[stop].inverse())
    R, t = move.rotation().matrix(), move.translation()
    return View(
        world_R_camera=R @ initial.world_R_camera,
        world_t_camera=initial.world_t_camera @ R.T + t,
        landmarks_m=initial.landmarks_m @ R.T + t,
    )


def placed_images(
    solution: Solution, stop: int, eye: int, views: dict[Pointing, View], twice: Mapping[int, int]
) -> tuple[list[PlacedImage], list[str]]:
    """The images that an eye took at a stop, and a warning for each that cannot be shown.

    `twice` is what `same_pictures` gives: a picture that is there twice is shown at its first place.
    Where the rig was adjusted, its calibration and smooth field belong to the refined pointing only.
    """
    traverse = solution.traverse
    images, warnings = [], []
    for row in np.flatnonzero((traverse.image_stop == stop) & (traverse.image_eye == eye)).tolist():
        entry = traverse.images[row]
        if entry.file is None:
            warnings.append(f"mosaic: image {entry.id} is left out: it has no file")
            continue
        if row in twice:
            first = traverse.images[twice[row]]
            warnings.append(
                f"mosaic: image {entry.id} ({entry.file}) is left out: the same picture as image {first.id} "
                f"({first.file})"
            )
            continue
        poses = [(v.world_R_camera[row], v.world_t_camera[row]) for v in views.values()]
        if not all(np.isfinite(a).all() for pose in poses for a in pose):
            warnings.append(f"mosaic: image {entry.id} is left out: its camera has no pose")
            continue
        try:
            grey = read_picture(traverse, row).samples
            mask = mask_file(traverse, row)
            wanted = np.ones(grey.shape, dtype=bool)
            if mask is not None:
                wanted = read_mask(mask, grey.shape[1], grey.shape[0], entry.file)
        except ImageError as error:
            warnings.append(f"mosaic: image {entry.id} is left out: {error}")
            continue
        camera: dict[Pointing, Camera] = {
            "telemetry": traverse.rig.eyes[eye].camera,
            "refined": solution.image_cameras[row],
        }
        cameras = {
            pointing: PlacedCamera(
                camera=camera[pointing],
                world_R_camera=view.world_R_camera[row],
                centre_m=view.world_t_camera[row],
            )
            for pointing, view in views.items()
        }
        images.append(
            PlacedImage(id=entry.id, grey=grey, usable=usable_mask(grey), wanted=wanted, at=cameras)
        )
    return images, warnings
