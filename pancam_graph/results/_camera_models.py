"""The refined cameras of a solution as CAHV, CAHVOR and CAHVORE text files, one an image."""

from pathlib import Path

import gtsam
import numpy as np

from pancam_graph.base.errors import CameraError, InputError
from pancam_graph.base.text import visible
from pancam_graph.cameras import CAHV, Camera, as_cahv, without_field
from pancam_graph.data import Solution, Traverse
from pancam_graph.io import cahvor_text
from pancam_graph.results._exported import file_names, whole_export, write_export_json
from pancam_graph.results._left_out_field import field_left_out, warned_of_field
from pancam_graph.results._output import OutputWriter, Written

__all__ = ["CAMERAS", "fill_cameras", "require_cahv_family", "world_models", "write_cameras"]

_FRAME = (
    "frame: the world of the traverse, z up, right-handed, metres",
    "a site frame that is z down (PDS labels) has y and z, of points and of vectors, with the other sign",
    "pixels: the centre of the first is (0, 0); S: zeros, not known",
)


def write_cameras(solution: Solution, folder: Path | str) -> None:
    """Write each image's refined camera as a text file, `IMAGE.cahvor`, into the folder `folder`.

    Vectors are in the world frame of the traverse, z up. A camera keeps the model that the rig has; a pinhole
    is written as CAHV, a Brown lens with k1 and k2 alone as CAHVOR: both exactly. Smooth fields have no place
    in these files: `export.json` says by how many pixels each camera misses its own. Whole or not at all: an
    older export is replaced at the end. Images without a finite pose are left out. `export.json` says which
    file is of which image.

    Raises InputError for a camera of which the family has no equal (a Brown lens with p1, p2 or k3), for a
    folder with anything else in it, and where writing fails.
    """
    with whole_export(Path(folder)) as partial:
        fill_cameras(solution, partial)


def fill_cameras(solution: Solution, folder: Path) -> None:
    """Write the files of `write_cameras` into an empty folder."""
    require_cahv_family(solution.traverse)
    images = solution.traverse.images
    names = file_names([image.id for image in images])
    listed = []
    for image, name, model in zip(images, names, world_models(solution), strict=True):
        if model is not None:
            text = cahvor_text(model, [f"pancam_graph, image {visible(image.id).replace('=', '-')}", *_FRAME])
            (folder / f"{name}.cahvor").write_text(text, encoding="utf-8", newline="\n")
            listed.append({"id": image.id, "file": f"{name}.cahvor"})
    lost = field_left_out(solution)
    about = {"frame": "world", "images": listed} | ({"field_left_out": lost} if lost else {})
    write_export_json(folder, "cahvor", about)


def world_models(solution: Solution) -> list[CAHV | None]:
    """Each image's refined camera with its vectors in the world frame; None without a finite pose.

    Without its smooth field, which the CAHV family has not.
    """
    made: dict[int, CAHV] = {}
    out: list[CAHV | None] = []
    for camera, rotation, centre in zip(
        solution.image_cameras, solution.final.world_R_camera, solution.final.world_t_camera, strict=True
    ):
        if not (np.isfinite(rotation).all() and np.isfinite(centre).all()):
            out.append(None)
            continue
        model = made.setdefault(id(camera), as_cahv(without_field(camera)))
        out.append(model.transformed(gtsam.Pose3(gtsam.Rot3(rotation), centre)))
    return out


def require_cahv_family(traverse: Traverse) -> None:
    """Raise InputError naming a camera of which no CAHV, CAHVOR or CAHVORE model is the equal."""
    for eye in traverse.rig.eyes:
        _require(eye.name, eye.camera)


def _require(name: str, camera: Camera) -> None:
    try:
        as_cahv(without_field(camera))
    except CameraError as error:
        raise InputError(f"cahvor: camera {name}: {error}") from error


def _write(written: Written, folder: Path) -> Written:
    fill_cameras(written.solution, folder)
    return warned_of_field(written, "cahvor")


CAMERAS = OutputWriter(write=_write, check=require_cahv_family)
