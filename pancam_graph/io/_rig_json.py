"""A rig with its covariance as a file of its own: calibrated once, used for other pictures."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import compose, so3_log
from pancam_graph.data import Traverse
from pancam_graph.io._entries import RIG_FORMAT, TRAVERSE_FORMAT, VERSION, Entry, Text
from pancam_graph.io._json import any_json_object, prefixed, read_bytes, read_json, require_format, validated
from pancam_graph.io._schema import AnyRigEntry, OwnRigEntry, TraverseFile, rig_entry
from pancam_graph.io._seen_pictures import require_other_pictures
from pancam_graph.rigs import Eye, Rig, RigUncertainty

__all__ = ["read_any_rig", "read_rig", "rig_json", "use_rig"]


_FARTHEST_SIGMAS = 8.0
"""Difference of a camera by two rigs, in sigmas of mount, tilt axis and angles, from which they are not of
one mast."""


class RigFile(Entry):
    """`rig.json`."""

    format: Literal["pancam-graph/rig"] = "pancam-graph/rig"
    version: Literal[1] = 1
    name: Text
    """Name of the traverse that the rig was calibrated with."""
    passed: bool
    """Whether that solution passed its tests."""
    rig: OwnRigEntry
    """As the rig of a `traverse.json`."""


def rig_json(rig: Rig, *, name: str, passed: bool) -> bytes:
    """A rig as the content of `rig.json`: calibrated in the traverse `name`, whose solution `passed`."""
    content = RigFile(name=name, passed=passed, rig=rig_entry(rig)).model_dump()
    return f"{json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)}\n".encode()


def read_rig(path: Path | str) -> Rig:
    """The rig of a `rig.json`, with its covariance.

    Raises InputError naming file and entry for what is malformed, and for a rig of a solution that failed its
    tests.
    """
    path = Path(path)
    entries = validated(RigFile, read_json(path, RIG_FORMAT, VERSION), path)
    with prefixed(path):
        if not entries.passed:
            raise InputError(
                f"passed: expected the rig of a solution that passed its tests, found that of "
                f"{entries.name}, which did not"
            )
        return entries.rig.rig()


class _RigAlone(Entry):
    """What stands in a file that has nothing but a rig, under the name that a traverse has it under."""

    rig: AnyRigEntry


def read_any_rig(path: Path | str) -> Rig:
    """The rig of a JSON file: of a `rig.json`, of a `traverse.json`, or the entry `rig` of one by itself.

    Raises InputError naming file and entry for what is malformed, and as `read_rig` does.
    """
    path = Path(path)
    data = any_json_object(read_bytes(path), path)
    if data.get("format") == RIG_FORMAT:
        return read_rig(path)
    if "format" in data:
        require_format(data, path, TRAVERSE_FORMAT, VERSION)
        entry = validated(TraverseFile, data, path).rig
    else:
        entry = validated(_RigAlone, {"rig": data}, path).rig
    with prefixed(path):
        return entry.rig()


def use_rig(traverse: Traverse, path: Path | str) -> Traverse:
    """A traverse with the rig of a `rig.json` in place of its own.

    Stops keep where the rover stood: where both rigs know the mast on it, the masts are put there by the
    rig of the file. Cameras go by their names. Telemetry's accuracy stays that of the traverse.

    Raises InputError naming the file where it lacks a camera of the traverse, for a camera of another size,
    for one that is another unit by its labels, where its cameras at the traverse's angles are far from the
    traverse's own, and where the rig was calibrated with pictures of the traverse.
    """
    path, own = Path(path), traverse.rig
    rig = read_rig(path)
    with prefixed(path):
        for row in sorted(set(traverse.image_eye.tolist())):
            _require_same(own.eyes[row], rig)
        _require_near(traverse, rig)
        require_other_pictures(traverse, rig)
    rig = replace(
        rig,
        pointing_sigma=own.pointing_sigma,
        mast_height_m=own.mast_height_m,
        turns=own.turns,
        rover_T_mast=rig.rover_T_mast or own.rover_T_mast,
    )
    stops = traverse.stops
    if own.rover_T_mast is not None and rig.rover_T_mast is not None:
        moved = own.rover_T_mast.inverse() * rig.rover_T_mast
        stops = tuple(replace(stop, world_T_mast=stop.world_T_mast * moved) for stop in stops)
    return replace(traverse, rig=rig, stops=stops)


def _require_near(traverse: Traverse, rig: Rig) -> None:
    """Raise InputError unless a rig has the cameras near where the traverse's own has them at its angles.

    In the frame of the rover where both know the mast on it, else of the mast. Axes that a reader fitted to
    the labels of one folder have zeros of their own: with the angles of another folder they point elsewhere.
    """
    own, eye = traverse.rig, traverse.image_eye
    angles = traverse.pan_tilt_rad[traverse.image_frame]
    other = np.array([rig.eye_index(e.name) if e.name in {o.name for o in rig.eyes} else 0 for e in own.eyes])
    poses = [own.mast_T_camera(angles, eye), rig.mast_T_camera(angles, other[eye])]
    if own.rover_T_mast is not None and rig.rover_T_mast is not None:
        masts = own.rover_T_mast, rig.rover_T_mast
        poses = [
            compose(mast.rotation().matrix(), mast.translation(), *pose)
            for mast, pose in zip(masts, poses, strict=True)
        ]
    (R, t), (R_other, t_other) = poses
    turned = np.linalg.norm(so3_log(R.transpose(0, 2, 1) @ R_other), axis=1)
    moved = np.linalg.norm(t_other - t, axis=1)
    usual, u, pointing = RigUncertainty.usual(own.longest_side_px), own.uncertainty, own.pointing_sigma
    turn = [max(a, b) for a, b in ((usual.mount_rad, u.mount_rad), (usual.tilt_axis_rad, u.tilt_axis_rad))]
    shift = [max(a, b) for a, b in ((usual.mount_m, u.mount_m), (usual.tilt_axis_m, u.tilt_axis_m))]
    turn_rad = float(np.linalg.norm([*turn, pointing.pan_rad, pointing.tilt_rad]))
    shift_m = float(np.linalg.norm(shift)) + turn_rad * float(
        np.linalg.norm(t - t.mean(axis=0), axis=1).max()
    )
    far = np.maximum(turned / turn_rad, moved / shift_m)
    worst = int(np.argmax(far)) if len(far) else 0
    if len(far) and far[worst] > _FARTHEST_SIGMAS:
        raise InputError(
            f"rig: expected cameras near those of the traverse (within {_FARTHEST_SIGMAS * turn_rad:.2g} rad "
            f"and {_FARTHEST_SIGMAS * shift_m:.2g} m), found image {traverse.images[worst].id} turned by "
            f"{turned[worst]:.2g} rad and moved by {moved[worst]:.2g} m; it is another mast, or its axes "
            "were fitted to other labels: calibrate with both folders in one traverse"
        )


def _require_same(eye: Eye, rig: Rig) -> None:
    """Raise InputError unless a rig has an eye of this name, size and unit."""
    other = next((e for e in rig.eyes if e.name == eye.name), None)
    if other is None:
        raise InputError(
            f"rig.cameras: expected {eye.name}, which the traverse has images of; "
            f"found {', '.join(e.name for e in rig.eyes)}"
        )
    sizes = [(e.camera.width_px, e.camera.height_px) for e in (eye, other)]
    if sizes[0] != sizes[1]:
        (width, height), (found_width, found_height) = sizes
        raise InputError(
            f"rig.cameras: {eye.name}: expected images of {width} x {height} px as in the traverse, "
            f"found {found_width} x {found_height}"
        )
    if eye.unit and other.unit and eye.unit != other.unit:
        raise InputError(
            f"rig.cameras: {eye.name}: expected the unit {eye.unit} as in the traverse's labels, "
            f"found {other.unit}"
        )
