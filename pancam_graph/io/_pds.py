"""Rover images with labels to a traverse: Mars Exploration Rovers, Curiosity, Perseverance, ExoMars.

What becomes what (docs/conventions.md for the frames):
- world: the site frame of the labels turned to z up, so x is north, y west;
- a stop: one site and drive of ROVER_MOTION_COUNTER. The first (lowest counter) defines the world and is
  held; later ones have the sigma of rover localisation, `LOCALISATION_SIGMA`;
- a frame: images of one stop with the same mast counter (PMA, RSM) whose measured angles agree to
  `SAME_POINTING_RAD`, each eye once;
- an eye: images of one INSTRUMENT_ID with the same model type and intrinsics. Subframes and tiles are
  windows of its picture (`on_detectors`); at another zoom or averaging it is another eye: `navcam-left-2`;
- the rig: the mast's axes of `pancam_graph.rigs`, with mounts averaged over the labels' cameras;
- pan and tilt: of the chain's head frame, so that the chain reproduces the label's camera. They are the
  measured angles where those do (MER: through the label's mast quaternion; Curiosity: through the joints'
  zero points), else angles and axes are fitted to the labels' cameras.
Label pixels count from 0 at the centre of the first one, as ours do.
"""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import gtsam
import numpy as np

from pancam_graph.base.choices import some_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray, wrap_angle
from pancam_graph.base.text import visible
from pancam_graph.data import Frame, Image, Site, Stop, Traverse
from pancam_graph.io._detectors import SAME_PRINCIPAL_POINT_PX, on_detectors, same_focal_lengths
from pancam_graph.io._input_format import InputFormat
from pancam_graph.io._joined_drive import parts_of
from pancam_graph.io._labelled_files import LABEL_SUFFIXES, LabelledFiles, labelled_files
from pancam_graph.io._labelled_image import LabelledImage
from pancam_graph.io._one_group import counted, named_files, one_group
from pancam_graph.io._pds_exposures import one_of_each_exposure
from pancam_graph.io._picture_size import looks_like_picture
from pancam_graph.io._pictures import left_out
from pancam_graph.io._places import site_by_places
from pancam_graph.rigs import MastKinematics, ReferenceSigma, RigFit, RigFitOptions, fit_rig

__all__ = ["LOCALISATION_SIGMA", "PDS3", "SAME_POINTING_RAD", "LocalisationSigma", "read_pds"]

_log = logging.getLogger(__name__)

SAME_POINTING_RAD = 1e-4
"""Measured angles that differ by less belong to one pointing of the head."""

_LABEL_TOLERANCE = 1e-4
"""Metres and radians to which the rig must reproduce each label's camera."""
_FARTHEST_CAMERA_M = 100.0
_AS_DESIGNED = RigFitOptions(
    reference_sigma=ReferenceSigma(mast_rad=0.0, mast_m=0.0, axis_rad=0.0, axis_m=0.0)
)
_AS_LABELLED = RigFitOptions(
    angles="free",
    angle_sigma_rad=5e-3,
    reference_sigma=ReferenceSigma(mast_rad=5e-3, mast_m=5e-3, axis_rad=5e-3, axis_m=5e-3),
)
"""A flight unit's axes may differ from the design, and its angles from the measured ones, by so much."""
_SAME_POSE = 1e-3
"""Metres and radians by which rover poses within a stop may differ without a warning."""


@dataclass(frozen=True, kw_only=True)
class LocalisationSigma:
    """How well a later stop is known relative to the first, one standard deviation."""

    rotation_rad: float = 0.01
    """Standard deviation of each rotation component."""
    translation_m: float = 0.1
    """Standard deviation of each translation component at distance 0."""
    translation_per_m: float = 0.05
    """Its increase with each metre from the first stop: wheel odometry on loose ground."""


LOCALISATION_SIGMA = LocalisationSigma()


def read_pds(folder: Path | str) -> Traverse:
    """Read all labelled images of a folder: PDS3, PDS4, and the raw-image feed (`labelled_files`).

    The traverse has no observations yet: they are to be found in its images. Of several products of one
    exposure the best is used (`one_of_each_exposure`), of several rovers or sites the largest group that can
    be solved together (`one_group`). Files that cannot be used are left out: no regular file, shorter than
    the label says, without a label or an entry of it (camera model, rover pose, mast angles), of a camera
    that is not on the mast. Warnings say what was left out, where the rig misses a label's camera by more
    than 0.1 mm or 0.1 mrad, and where labels of one stop disagree.

    Raises InputError naming the folder without a labelled image, and, where no file can be used, file and
    entry for the first of them.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of rover images, found {_kind(folder)}")
    return _read_folders(folder, [folder])


def _read_folders(root: Path, folders: Sequence[Path]) -> Traverse:
    """All labelled images of folders within `root`, read as `read_pds` does those of one."""
    folder = folders[0]
    found = LabelledFiles.joined([labelled_files(each) for each in folders])
    products, unusable = found.images, found.unusable
    if not products and not unusable:
        pictures = sum(looks_like_picture(file) for file in found.unread)
        hint = f" but {pictures} pictures; pancam-graph init {folder} makes a traverse.json of them"
        found_words = f"none{hint if pictures else ''}"
        raise InputError(
            f"{folder}: expected rover images with labels (*.IMG, *.xml, *.json), found {found_words}"
        )
    if not products:
        raise next(iter(unusable.values()))
    group = one_group(products, found.site_poses)
    exposures = one_of_each_exposure(group.images)
    images = on_detectors(exposures.images, root)
    kinematics = images[0].mast
    warnings = [
        *_left_out(unusable),
        *found.warnings,
        *group.warnings,
        *exposures.warnings,
        *_remarks(images),
    ]
    if found.unread and (unusable or group.warnings):  # all is accounted for where something is left out
        names = named_files([file.name for file in found.unread])
        warnings.append(f"not read, for they are no labels and no labelled pictures: {names}")
    site = _site(found.places, images, warnings)
    eye_of, eye_names = _sort_eyes(images)
    stop_ids, stops = _sort_stops(images, kinematics, warnings)
    frame_of, frames_first = _sort_frames(images, eye_of)
    fit = _fit_rig(images, kinematics, frame_of, eye_of, eye_names, frames_first, warnings)
    # Where the axes were fitted, the mast frame of the fitted chain replaces that of the design.
    stops = tuple(
        replace(s, world_T_mast=images[i].world_T_rover * fit.world_T_mast)
        for s, i in zip(stops, stop_ids.values(), strict=True)
    )
    sigma = kinematics.pointing_sigma
    frame_ids = _frame_ids(images, frames_first)
    frames = tuple(
        Frame(
            id=name,
            stop=_stop_id(images[i].stop),
            pan_rad=float(wrap_angle(fit.pan_tilt_rad[i, 0])),
            tilt_rad=float(fit.pan_tilt_rad[i, 1]),
            sigma_pan_rad=(images[i].pointing_sigma or sigma).pan_rad,
            sigma_tilt_rad=(images[i].pointing_sigma or sigma).tilt_rad,
        )
        for name, i in zip(frame_ids, frames_first, strict=True)
    )
    order = sorted(range(len(frames)), key=lambda r: (images[frames_first[r]].stop, r))
    rig = fit.rig(f"{kinematics.name}-pds")
    rig = replace(
        rig,
        pointing_sigma=sigma,
        mast_height_m=kinematics.mast_height_m,
        source=f"PDS labels of {visible(folder.resolve().name)}; {kinematics.source}",
        uncertainty=images[0].uncertainty_of(rig.longest_side_px),
        rover_T_mast=fit.world_T_mast,
        eyes=tuple(
            replace(eye, unit=images[int(np.argmax(eye_of == eye_names.index(eye.name)))].unit)
            for eye in rig.eyes
        ),
    )
    return Traverse(
        name=visible(folder.resolve().name),
        rig=rig,
        stops=stops,
        frames=tuple(frames[r] for r in order),
        images=tuple(
            Image(
                id=visible(image.file.stem),  # a name that is no text has no place in results
                frame=frame_ids[frame_of[i]],
                camera=eye_names[eye_of[i]],
                file=image.way_from(root),
                tiles=image.tiles,
            )
            for i, image in enumerate(images)
        ),
        folder=root,
        parts=parts_of(root, folders),
        warnings=tuple(warnings),
        site=site,
    )


PDS3 = InputFormat(
    needs="rover images with labels (*.IMG, *.LBL, *.xml, *.json)",
    matches=lambda names: any(Path(name).suffix.lower() in LABEL_SUFFIXES for name in names),
    read=_read_folders,
)


def _site(places: Path | None, images: Sequence[LabelledImage], warnings: list[str]) -> Site | None:
    """Where the world is by the folder's table of localisation; adds to `warnings`."""
    if places is None:
        return None
    if not all(image.levelled and image.placed for image in images):
        warnings.append(f"{places.name}: not used: labels do not say where north is")
        return None
    rovers = {image.stop: image.world_T_rover.translation() for image in reversed(images)}
    try:
        localised = site_by_places(places, min(site for site, _ in rovers), rovers)
    except InputError as error:
        warnings.append(f"not used: {error}")
        return None
    if localised is None:
        warnings.append(f"{places.name}: not used: it has none of these sites and drives")
        return None
    warnings += localised.warnings
    return localised.site


def _left_out(unusable: Mapping[str, InputError]) -> list[str]:
    """Warnings of files that cannot be used: the first five with their reasons, and names of others."""
    said = left_out(unusable)
    others = list(unusable)[sum(warning.startswith("image ") for warning in said) :]
    return [*said[:-1], f"{said[-1]}: {named_files(others)}"] if others else said


def _remarks(images: Sequence[LabelledImage]) -> list[str]:
    """What is true of images, once for all of which it is true."""
    count = Counter(image.remark for image in images if image.remark)
    said = [f"{number} of {counted(len(images))}: {remark}" for remark, number in count.items()]
    of_serial: dict[str, set[str]] = {}
    for image in images:
        if image.serial:
            of_serial.setdefault(image.serial, set()).add(image.instrument)
    said += [
        f"{some_of(sorted(cameras))} have one serial number in their labels, {serial}; they are taken for "
        "cameras of their own"
        for serial, cameras in of_serial.items()
        if len(cameras) > 1
    ]
    unlevel = sorted({_stop_id(image.stop) for image in images if not image.levelled})
    if unlevel:
        said.append(
            f"stop {', '.join(unlevel)}: the labels have no attitude; the world is level and turned as the "
            "rover is, so that azimuths count from its forward direction and its tilt is not in them"
        )
    return said


def _kind(path: Path) -> str:
    return "a file" if path.exists() else "none"


def _sort_eyes(images: Sequence[LabelledImage]) -> tuple[IntArray, list[str]]:
    """Eye of each image (n,), and the eyes' names."""
    firsts: list[LabelledImage] = []
    eye_of: list[int] = []
    for image in images:
        row = next((k for k, first in enumerate(firsts) if _same_eye(first, image)), len(firsts))
        if row == len(firsts):
            firsts.append(image)
        eye_of.append(row)
    names: list[str] = []
    for first in firsts:
        base = first.instrument.lower().replace("_", "-")
        count = sum(name == base or name.startswith(f"{base}-") for name in names)
        names.append(base if count == 0 else f"{base}-{count + 1}")
    return np.array(eye_of, dtype=np.int64), names


def _same_eye(first: LabelledImage, image: LabelledImage) -> bool:
    a, b = first.model, image.model
    if (a.width_px, a.height_px) != (b.width_px, b.height_px):
        return False
    centre = max(abs(a.cx_px - b.cx_px), abs(a.cy_px - b.cy_px))
    return same_focal_lengths(first, image) and centre < SAME_PRINCIPAL_POINT_PX


def _stop_id(stop: tuple[int, int]) -> str:
    return f"site{stop[0]}-drive{stop[1]}"


def _sort_stops(
    images: Sequence[LabelledImage], mast: MastKinematics, warnings: list[str]
) -> tuple[dict[tuple[int, int], int], tuple[Stop, ...]]:
    """First image of each stop, in the order of the motion counter, and the stops."""
    first_of: dict[tuple[int, int], int] = {}
    for i, image in enumerate(images):
        first_of.setdefault(image.stop, i)
    first_of = dict(sorted(first_of.items()))
    rover_T_mast, _ = mast.chain()
    for stop, i in first_of.items():
        poses = [image.world_T_rover for image in images if image.stop == stop]
        apart = [images[i].world_T_rover.between(pose) for pose in poses]
        turn = max(float(np.linalg.norm(gtsam.Rot3.Logmap(pose.rotation()))) for pose in apart)
        shift = max(float(np.linalg.norm(pose.translation())) for pose in apart)
        if max(turn, shift) > _SAME_POSE:
            warnings.append(
                f"stop {_stop_id(stop)}: its labels' rover poses differ by up to {shift * 1e3:.1f} mm and "
                f"{turn * 1e3:.1f} mrad; that of {images[i].file.name} is used"
            )
    origin = images[next(iter(first_of.values()))].world_T_rover.translation()
    stops: list[Stop] = []
    for stop, i in first_of.items():
        distance = float(np.linalg.norm(images[i].world_T_rover.translation() - origin))
        held = not stops
        sigma = LOCALISATION_SIGMA
        stops.append(
            Stop(
                id=_stop_id(stop),
                world_T_mast=images[i].world_T_rover * rover_T_mast,
                sigma_rotation_rad=0.0 if held else sigma.rotation_rad,
                sigma_translation_m=(
                    0.0 if held else sigma.translation_m + sigma.translation_per_m * distance
                ),
            )
        )
    return first_of, tuple(stops)


def _sort_frames(images: Sequence[LabelledImage], eye_of: IntArray) -> tuple[IntArray, list[int]]:
    """Frame of each image (n,), and each frame's first image."""
    firsts: list[int] = []
    eyes_in: list[set[int]] = []
    frame_of: list[int] = []
    for i, image in enumerate(images):
        row = len(firsts)
        for k, j in enumerate(firsts):
            other = images[j]
            same_place = (image.stop, image.mast_counter) == (other.stop, other.mast_counter)
            angles, others = image.told_angles or image.pan_tilt_rad, other.told_angles or other.pan_tilt_rad
            apart = wrap_angle(np.subtract(angles, others))
            if same_place and np.abs(apart).max() < SAME_POINTING_RAD and int(eye_of[i]) not in eyes_in[k]:
                row = k
                break
        if row == len(firsts):
            firsts.append(i)
            eyes_in.append(set())
        eyes_in[row].add(int(eye_of[i]))
        frame_of.append(row)
    return np.array(frame_of, dtype=np.int64), firsts


def _frame_ids(images: Sequence[LabelledImage], firsts: Sequence[int]) -> list[str]:
    """Ids of frames: site, drive and mast counter, and a number where these are not unique."""
    ids: list[str] = []
    for row, i in enumerate(firsts):
        site, drive = images[i].stop
        counter = images[i].mast_counter
        base = f"{site}-{drive}-{row if counter is None else counter}"
        count = sum(name == base or name.startswith(f"{base}.") for name in ids)
        ids.append(base if count == 0 else f"{base}.{count + 1}")
    return ids


def _fit_rig(
    images: Sequence[LabelledImage],
    mast: MastKinematics,
    frame_of: IntArray,
    eye_of: IntArray,
    eye_names: Sequence[str],
    frames_first: Sequence[int],
    warnings: list[str],
) -> RigFit:
    """The chain that reproduces the labels' cameras: the design's, or one fitted to them."""
    for image in images:
        if np.linalg.norm(image.model.C) > _FARTHEST_CAMERA_M:
            raise InputError(
                f"{image.label_file}: camera centre: expected a point within "
                f"{_FARTHEST_CAMERA_M:g} m of the rover, found {image.model.C.tolist()}"
            )
    measured = np.array([images[i].pan_tilt_rad for i in frames_first])
    rover_T_mast, pan_T_tilt = mast.chain()
    fit_of = partial(
        fit_rig,
        [image.model for image in images],
        measured[frame_of],
        eyes=[eye_names[eye] for eye in eye_of],
        pointings=frame_of.tolist(),
        world_T_mast=rover_T_mast,
        pan_T_tilt=pan_T_tilt,
    )
    fit = fit_of(options=_AS_DESIGNED)
    if max(fit.worst_m, fit.worst_rad) > _LABEL_TOLERANCE:
        fit = fit_of(options=_AS_LABELLED)
        change = wrap_angle(fit.pan_tilt_rad[frames_first] - measured)
        _log.info(
            "mast axes and angles fitted to the labels' cameras; angles moved by up to %.2f mrad",
            1e3 * np.abs(change).max(),
        )
        _warn_of_angles(change, mast, images, frame_of, warnings)
    metres, radians = np.linalg.norm(fit.residual_m, axis=1), np.linalg.norm(fit.residual_rad, axis=1)
    misfit = np.maximum(metres, radians)
    bad = misfit > _LABEL_TOLERANCE
    if bad.any():
        worst = int(misfit.argmax())
        warnings.append(
            f"the mast model misses the label's camera in {int(bad.sum())} of {len(images)} images by more "
            f"than 0.1 mm or 0.1 mrad; worst {metres[worst] * 1e3:.2f} mm and "
            f"{radians[worst] * 1e3:.2f} mrad in {images[worst].file.name}"
        )
    return fit


def _warn_of_angles(
    change: FloatArray,
    mast: MastKinematics,
    images: Sequence[LabelledImage],
    frame_of: IntArray,
    warnings: list[str],
) -> None:
    # The zero point of a joint may differ from the design, by the same amount in all frames. Where the angles
    # of one frame alone differ, its label was made with another pointing than was measured.
    alone = np.abs(change - np.median(change, axis=0))
    sigma = np.array([mast.pointing_sigma.pan_rad, mast.pointing_sigma.tilt_rad])
    frames = np.flatnonzero((alone > 3 * sigma).any(axis=1))
    if len(frames):
        worst = int(alone.max(axis=1).argmax())
        name = images[int(np.flatnonzero(frame_of == worst)[0])].file.name
        warnings.append(
            f"{len(frames)} of {len(change)} pointings: the label's camera is turned from the measured "
            f"angles by more than 3 sigma, at most {alone[worst].max() * 1e3:.1f} mrad in {name}; the "
            "camera's pointing is used"
        )
