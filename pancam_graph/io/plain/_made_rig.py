"""A rig made from plain pictures: an eye for each camera that took some, on a head of told arms."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np

from pancam_graph.base.choices import some_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray
from pancam_graph.cameras import Brown
from pancam_graph.io._json import prefixed
from pancam_graph.io.plain._eyes import RiggedPictures
from pancam_graph.io.plain._find_pictures import PlainPicture
from pancam_graph.io.plain._focal import Focal, focal_of
from pancam_graph.io.plain._options import PlainOptions
from pancam_graph.io.plain._pointing import Pointed
from pancam_graph.rigs import Eye, PointingSigma, Rig, RigUncertainty

__all__ = ["made_rig"]

_POINTING_RAD = float(np.deg2rad(0.5))
_ARMS_TOLD_M, _ARMS_UNTOLD_M = 0.01, 0.05
_MOUNT_RAD, _FLEX_RAD = 0.02, 1e-3
_TILT_AXIS_RAD = 2e-3
"""Small beside that of mounts: pictures of one tilt do not tell a tilt axis that is askew from a mount that
is rolled, and wide priors on both leave them to run apart without an effect on the pixels."""
_SCALE = 5e-3
"""Of pans and tilts over their readings, as a share: servos have one, gears with encoders do not."""
_ASPECT = 2e-3
"""Of fy / fx, as a share: sensors have square pixels, pictures that were projected anew not always."""
_PRINCIPAL_POINT, _FIELD = 1e-2, 7e-4
"""Shares of the longer side of a picture: principal point, and what lens and processing distort."""
_MOST_ARM_M = 100.0
_CAMERA = "camera"

_QUARTER_TURNS = {1: 0, 6: 1, 3: 2, 8: 3}
"""How often a picture of each orientation of EXIF is to be turned clockwise to be upright."""

_Group = list[Pointed]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Made:
    """An eye, and what there is to say of it."""

    eye: Eye
    focal: Focal
    source: str
    warnings: tuple[str, ...]


def made_rig(
    pointed: Sequence[Pointed], options: PlainOptions, table: Path, *, guessed: bool
) -> RiggedPictures:
    """A rig with an eye for each camera, and which of them took each picture.

    The table says the camera; without it, pictures of one size, camera and focal length by EXIF are of one
    eye. An eye looks forward; it is rolled as EXIF says that most of its pictures were held.

    `guessed` says that focal length and arms may be guesses, since pictures will tell them. Raises InputError
    for an option that makes no sense, without a focal length, and naming lines for a camera whose EXIF is of
    two.
    """
    groups, left_out = _groups(pointed, table)
    up_m, forward_m, left_m = _arms_m(options)
    made = [
        _made_eye(name, rows, (forward_m, left_m), options, guessed=guessed) for name, rows in groups.items()
    ]
    arms_sigma_m = _arms_sigma_m(options)
    told = (
        "as told by --arms"
        if options.arms_m
        else "not told (--arms): all at one point; where they are not, near ground is not found where it is "
        "looked for, and pictures without --pointing tell the arms"
    )
    arms = (
        f"arms: tilt axis {up_m:g} m above the pan stage's origin, cameras {forward_m:g} m before and "
        f"{left_m:g} m left of the axes, +- {arms_sigma_m:g} m, {told}"
    )
    eye_of = {row.line: name for name, rows in groups.items() for row in rows}
    rig = Rig(
        name="head made by pancam-graph init",
        pan_T_tilt=gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, up_m])),
        eyes=tuple(one.eye for one in made),
        pointing_sigma=PointingSigma(pan_rad=_POINTING_RAD, tilt_rad=_POINTING_RAD),
    )
    return RiggedPictures(
        rig=replace(rig, uncertainty=_uncertainty(rig, max(one.focal.sigma for one in made), arms_sigma_m)),
        pictures=tuple((row, eye_of[row.line]) for row in pointed if row.line in eye_of),
        warnings=(
            *left_out,
            *_shared_serials(groups),
            *(warning for one in made for warning in one.warnings),
        ),
        sources=(*(one.source for one in made), arms),
    )


def _uncertainty(rig: Rig, focal: float, arms_sigma_m: float) -> RigUncertainty:
    """Of a head and cameras of which nothing is known but focal lengths and arms; our stated assumption."""
    side_px = rig.longest_side_px
    return RigUncertainty(
        focal=focal,
        aspect=_ASPECT,
        principal_point_px=_PRINCIPAL_POINT * side_px,
        skew_px=RigUncertainty.usual(side_px).skew_px,
        field_px=_FIELD * side_px,
        mount_rad=_MOUNT_RAD,
        mount_m=arms_sigma_m,
        tilt_axis_rad=_TILT_AXIS_RAD,
        tilt_axis_m=arms_sigma_m,
        flex_rad=_FLEX_RAD,
        pan_scale=_SCALE,
        tilt_scale=_SCALE,
        source="made by pancam-graph init; wide, for a head and cameras without a calibration",
    )


def _made_eye(
    name: str,
    rows: _Group,
    before_and_left_m: tuple[float, float],
    options: PlainOptions,
    *,
    guessed: bool,
) -> _Made:
    """The eye that took some pictures. Raises InputError without a focal length."""
    picture = rows[0].picture
    focal = focal_of(picture, options, guessed=guessed)
    turns, held_otherwise = _quarter_turns([row.picture for row in rows])
    camera = Brown(
        width_px=picture.width_px,
        height_px=picture.height_px,
        fx_px=focal.focal_px,
        fy_px=focal.focal_px,
        cx_px=(picture.width_px - 1) / 2,
        cy_px=(picture.height_px - 1) / 2,
        distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
    )
    head_T_camera = gtsam.Pose3(gtsam.Rot3(_rolled(turns)), np.array([*before_and_left_m, 0.0]))
    held = f", held turned by {90 * turns} degrees" if turns else ""
    warning = (
        f"camera {name}: EXIF of {some_of(held_otherwise)} says another orientation than of its other "
        "pictures; a head does not turn its camera, and pixels are taken as they are stored"
    )
    return _Made(
        eye=Eye(name=name, camera=camera, head_T_camera=head_T_camera),
        focal=focal,
        source=f"camera {name}: {len(rows)} pictures of {picture.width_px} x {picture.height_px} px{held}; "
        f"focal length {focal.focal_px:.1f} px +- {100 * focal.sigma:.1f} %, {focal.source}",
        warnings=(warning,) if held_otherwise else (),
    )


def _arms_m(options: PlainOptions) -> tuple[float, float, float]:
    """The arms: up, forward, left. Raises InputError for lengths that are none of a head."""
    arms_m = options.arms_m or (0.0, 0.0, 0.0)
    for arm_m in arms_m:
        if not abs(arm_m) <= _MOST_ARM_M:
            raise InputError(f"--arms: expected metres up to {_MOST_ARM_M:g}, found {arm_m:g}")
    return arms_m


def _arms_sigma_m(options: PlainOptions) -> float:
    usual = _ARMS_TOLD_M if options.arms_m else _ARMS_UNTOLD_M
    return usual if options.arms_sigma_m is None else options.arms_sigma_m


def _groups(pointed: Sequence[Pointed], table: Path) -> tuple[dict[str, _Group], list[str]]:
    """Pictures by the name of their eye, and warnings of those that are left out."""
    if not any(row.camera for row in pointed):
        by_camera: dict[object, _Group] = {}
        for row in pointed:
            by_camera.setdefault((row.picture.size_px, row.picture.exif.camera), []).append(row)
        one = len(by_camera) == 1
        return {_CAMERA if one else f"{_CAMERA}{n}": rows for n, rows in enumerate(by_camera.values(), 1)}, []
    groups: dict[str, _Group] = {}
    warnings: list[str] = []
    with prefixed(table):
        for row in pointed:
            if row.camera is None:
                raise InputError(
                    f"camera, line {row.line}: expected the name of a camera, as other lines have one; found "
                    "an empty cell"
                )
            groups.setdefault(row.camera, []).append(row)
        for name, rows in groups.items():
            size, _ = Counter(row.picture.size_px for row in rows).most_common(1)[0]
            others = [row.picture.file for row in rows if row.picture.size_px != size]
            if others:
                warnings.append(
                    f"camera {name}: expected pictures of one size, most often {size[0]} x {size[1]}; of "
                    f"another are, and left out: {some_of(others)}"
                )
            groups[name] = [row for row in rows if row.picture.size_px == size]
            _require_one_camera(name, groups[name])
    return groups, warnings


def _require_one_camera(name: str, rows: _Group) -> None:
    """Raise InputError where EXIF says that pictures of one name are of two cameras, or of two zooms."""
    told = [row for row in rows if any(row.picture.exif.camera)]
    for row in told:
        first, other = (r.picture.exif.camera for r in (told[0], row))
        if first != other:
            raise InputError(
                f"camera, line {row.line}: expected pictures of {name!r} by one camera at one focal length, "
                f"found by EXIF {_described(other)}, and {_described(first)} in line {told[0].line}: give "
                "them two names"
            )


def _shared_serials(groups: dict[str, _Group]) -> list[str]:
    """A warning for each serial number that EXIF of two makes or models has."""
    of_serial: dict[str, dict[tuple[str, str], str]] = {}
    for name, rows in groups.items():
        for exif in (row.picture.exif for row in rows):
            if exif.serial:
                of_serial.setdefault(exif.serial, {}).setdefault((exif.make, exif.model), name)
    return [
        f"EXIF of cameras {some_of(list(models.values()))} says one serial number, {serial}, and different "
        "models; they are taken for cameras of their own"
        for serial, models in of_serial.items()
        if len(models) > 1
    ]


def _described(camera: tuple[object, ...]) -> str:
    make, model, serial, focal_mm, focal_35mm = camera
    focal = focal_mm or focal_35mm
    words = [str(word) for word in (make, model, serial) if word]
    return " ".join([*words, f"{focal:g} mm" if focal else ""]).strip() or "nothing"


def _quarter_turns(pictures: Sequence[PlainPicture]) -> tuple[int, list[str]]:
    """Quarter turns clockwise that make most pictures upright, and files whose EXIF says another."""
    orientations = [picture.exif.orientation for picture in pictures]
    most, _ = Counter(orientations).most_common(1)[0]
    others = [p.file for p, o in zip(pictures, orientations, strict=True) if o != most]
    return _QUARTER_TURNS.get(most, 0), others


def _rolled(turns: int) -> FloatArray:
    """`head_R_camera` of a camera that looks forward, and whose pictures are upright after clockwise turns.

    The columns of an upright picture run to the right of the head. Turned clockwise once, those of the stored
    picture run down, twice to the left, three times up.
    """
    angle_rad = turns * np.pi / 2
    c, s = np.rint(np.cos(angle_rad)), np.rint(np.sin(angle_rad))
    upright_R_stored = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rolled: FloatArray = HEAD_R_FORWARD_CAMERA @ upright_R_stored
    return rolled
