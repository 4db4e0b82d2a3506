"""The adjusted rig of a solution: as a file that another run reads as its rig, and as CAHVOR models."""

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from pancam_graph.base.errors import CameraError
from pancam_graph.base.text import visible
from pancam_graph.cameras import CAHV, as_cahv, without_field
from pancam_graph.data import Solution
from pancam_graph.io import cahvor_text, picture_digests, rig_json
from pancam_graph.results._exported import file_names, whole_export, write_export_json
from pancam_graph.results._left_out_field import field_left_out, warned_of_field
from pancam_graph.results._output import OutputWriter, Written
from pancam_graph.rigs import Rig, camera_z_up

__all__ = ["RIG", "calibrated_rig", "fill_rig", "rover_models", "write_rig"]

_MAST = (
    "frame: the mast at pan 0 and tilt 0, z up, x forward, metres",
    "pixels: the centre of the first is (0, 0); S: zeros, see the covariance of rig.json",
)
_ROVER = (
    "frame: the rover frame of PDS labels, z down, metres, as GEOMETRIC_CAMERA_MODEL",
    "pixels: the centre of the first is (0, 0); S: zeros, see the covariance of rig.json",
)


def write_rig(solution: Solution, folder: Path | str) -> None:
    """Write the adjusted rig into the folder `folder`, whole or not at all; an older export is replaced.

    `rig.json` is the rig with the covariance of its numbers, as `io.read_rig` reads it. Each eye is there
    as `EYE.cahvor` in the mast frame at pan 0 and tilt 0, and, where the rig knows the mast on the rover,
    each image's camera as `rover/IMAGE.cahvor` in the frame of labels. A lens that the CAHV family has no
    equal of is left out of these.

    Raises InputError for a folder with anything else in it, and where writing fails.
    """
    with whole_export(Path(folder)) as partial:
        fill_rig(solution, partial)


def fill_rig(solution: Solution, folder: Path) -> None:
    """Write the files of `write_rig` into an empty folder."""
    rig, traverse = calibrated_rig(solution), solution.traverse
    (folder / "rig.json").write_bytes(rig_json(rig, name=traverse.name, passed=solution.passed))
    names = [eye.name for eye in rig.eyes]
    eyes = _written(folder, "", names, _mast_models(rig), _MAST)
    about: dict[str, object] = {"rig": "rig.json", "frame": "mast", "cameras": eyes}
    models = rover_models(solution)
    if models:
        (folder / "rover").mkdir()
        ids = [image.id for image in traverse.images]
        about["images"] = _written(folder, "rover/", ids, models, _ROVER)
    if lost := field_left_out(solution):
        about["field_left_out"] = lost
    write_export_json(folder, "rig", about)


def calibrated_rig(solution: Solution) -> Rig:
    """The adjusted rig, with the covariance of its numbers and the digests of the pictures behind it.

    Without a covariance (a rig held or considered, or a sharing of the user's) the rig keeps its uncertainty.
    """
    rig, found, traverse = solution.rig, solution.rig_covariance, solution.traverse
    if found is None:
        return rig
    before = rig.uncertainty.covariance
    pictures = list(() if before is None else before.pictures)
    if traverse.observations is not None:
        used = set(traverse.observations.image[solution.used].tolist())
        pictures += [d for row, d in enumerate(picture_digests(traverse)) if d and row in used]
    joint = replace(found, pictures=tuple(dict.fromkeys(pictures)))
    # A chain of calibrations names its last alone: the source does not grow with it.
    source = re.sub(r"; refined with .*", "", rig.uncertainty.source)
    return replace(
        rig,
        uncertainty=replace(
            rig.uncertainty, covariance=joint, source=f"{source}; refined with {traverse.name}"
        ),
    )


def rover_models(solution: Solution) -> list[CAHV | None]:
    """Each image's camera in the rover frame of labels, z down; empty where the rig does not know it.

    None for an image without a finite pose, and for a lens without an equal in the CAHV family.
    """
    traverse, final, mounted = solution.traverse, solution.final, solution.rig.rover_T_mast
    if mounted is None:
        return []
    out: list[CAHV | None] = []
    for i, camera in enumerate(solution.image_cameras):
        R, t = final.world_R_camera[i], final.world_t_camera[i]
        rover_T_world = mounted * final.world_T_mast[int(traverse.image_stop[i])].inverse()
        try:
            model = as_cahv(without_field(camera))
        except CameraError:
            out.append(None)
            continue
        known = np.isfinite(R).all() and np.isfinite(t).all()
        pose = rover_T_world * gtsam.Pose3(gtsam.Rot3(R), t) if known else None
        # A turn between z up and z down is its own inverse.
        out.append(None if pose is None else camera_z_up(model.transformed(pose)))
    return out


def _mast_models(rig: Rig) -> list[CAHV | None]:
    rotations, centres = rig.mast_T_camera(np.zeros((len(rig.eyes), 2)), np.arange(len(rig.eyes)))
    out: list[CAHV | None] = []
    for eye, rotation, centre in zip(rig.eyes, rotations, centres, strict=True):
        try:
            out.append(
                as_cahv(without_field(eye.camera)).transformed(gtsam.Pose3(gtsam.Rot3(rotation), centre))
            )
        except CameraError:
            out.append(None)
    return out


def _written(
    folder: Path, within: str, ids: list[str], models: Iterable[CAHV | None], frame: tuple[str, ...]
) -> list[dict[str, str]]:
    """Write the models that there are; the id and the file of each."""
    listed = []
    for identity, name, model in zip(ids, file_names(ids), models, strict=True):
        if model is not None:
            text = cahvor_text(model, [f"pancam_graph, {visible(identity).replace('=', '-')}", *frame])
            file = f"{within}{name}.cahvor"
            (folder / file).write_text(text, encoding="utf-8", newline="\n")
            listed.append({"id": identity, "file": file})
    return listed


def _write(written: Written, folder: Path) -> Written:
    fill_rig(written.solution, folder)
    return warned_of_field(written, "rig")


RIG = OutputWriter(write=_write)
