"""A traverse as a folder: `traverse.json`, its observations and its image files."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import ImageError, InputError, PancamGraphError
from pancam_graph.base.regular_files import instead_of_file, is_missing
from pancam_graph.base.text import visible
from pancam_graph.base.whole_files import whole_file
from pancam_graph.data import Frame, NamedPoints, Observations, Stop, Surface, Traverse
from pancam_graph.io._constraint_entries import constraint_entry, points_csv, read_points, surface_files
from pancam_graph.io._entries import TRAVERSE_FORMAT, VERSION, PoseEntry
from pancam_graph.io._input_format import InputFormat
from pancam_graph.io._inside import inside
from pancam_graph.io._joined_drive import Part, joined_drive
from pancam_graph.io._json import prefixed, read_json, refused_by_schema, validated
from pancam_graph.io._mask_files import mask_file, read_mask
from pancam_graph.io._observations import observations_npz, read_observations
from pancam_graph.io._pictures import left_out, read_picture
from pancam_graph.io._schema import (
    FrameEntry,
    ImageEntry,
    SharingEntry,
    SiteEntry,
    StopEntry,
    TraverseFile,
    rig_entry,
)
from pancam_graph.io._seen_pictures import require_other_pictures
from pancam_graph.io._surfaces import write_surface
from pancam_graph.io._ties_file import constraints_of

__all__ = ["TRAVERSE_FOLDER", "read_traverse", "traverse_entries", "traverse_of", "write_traverse"]

_TRAVERSE_JSON = "traverse.json"
_OBSERVATIONS = "observations.npz"
_POINTS = "points.csv"
_IN_OBSERVATIONS = "observations: "
"""Beginning of what `Traverse` says about observations."""


def read_traverse(folder: Path | str) -> Traverse:
    """Read a traverse folder: `traverse.json`, the observations and image files that it names.

    Every image file and mask is decoded once, to check that it exists, is whole, has its camera's size and,
    where it has a label, is of the same rover as the others; its samples are not kept. Image files that fail
    are warned of, and later steps leave them out. `observations` is None where the file says null: they are
    then to be found in the images.

    Raises InputError with one sentence naming file, entry, what was expected and what was found; ImageError
    for a mask that cannot be used, and if no image file can be: unless observations are given and all image
    files are missing.
    """
    folder = Path(folder)
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing there"
        raise InputError(f"{folder}: expected a traverse folder with {_TRAVERSE_JSON}, found {found}")
    path = folder / _TRAVERSE_JSON
    entries = validated(TraverseFile, read_json(path, TRAVERSE_FORMAT, VERSION), path)
    with prefixed(path):
        files = [
            [inside(folder, name, f"images[{row}].{entry}") for entry, name in i.named_files.items()]
            for row, i in enumerate(entries.images)
        ]
        if entries.observations is None and not any(files):
            raise InputError(
                "observations: expected a file, or image files to find them in; found null and no image file"
            )
        for row, image in enumerate(entries.images):
            if image.mask is not None:
                inside(folder, image.mask, f"images[{row}].mask")
        source = None
        if entries.observations is not None:
            source = inside(folder, entries.observations, "observations")
        marks = None if entries.points is None else inside(folder, entries.points, "points")
    observations = None if source is None else read_observations(source)
    points = None if marks is None else read_points(marks, [i.id for i in entries.images])
    traverse = _checked(entries, path, observations, source, points)
    with prefixed(f"{path}: rig.uncertainty.covariance"):
        require_other_pictures(traverse, traverse.rig)
    unusable = _unusable_images(files, traverse)
    # Without observations, the search for them in images gives the same warnings.
    return traverse if source is None else traverse.with_warnings(left_out(unusable))


def _checked(
    entries: TraverseFile,
    path: Path,
    observations: Observations | None,
    source: Path | None,
    points: NamedPoints | None,
) -> Traverse:
    """The traverse of a file. Raises InputError naming the file at fault: itself, or that of observations."""
    try:
        # Numbers that are too large overflow. The constructors refuse the result; NumPy need not warn too.
        with np.errstate(all="ignore"):
            return traverse_of(entries, path.parent, observations, points)
    except PancamGraphError as error:
        in_observations = source is not None and str(error).startswith(_IN_OBSERVATIONS)
        with prefixed(source if in_observations else path):
            raise type(error)(str(error).removeprefix(_IN_OBSERVATIONS if in_observations else "")) from error


def write_traverse(traverse: Traverse, folder: Path | str, *, overwrite: bool = False) -> None:
    """Write a traverse folder that `read_traverse` reads back, poses and pixels to double precision.

    The rig is written with its own numbers. Image files of a traverse that was read from another folder are
    copied along. That observations were found in images (`Observations.origin`) is not in the format.

    Raises InputError where `folder` has a `traverse.json` already and `overwrite` is not set, for an image
    file outside its folder, for names that the format does not take, and for files that cannot be written.
    """
    folder = Path(folder)
    path = folder / _TRAVERSE_JSON
    if path.exists() and not overwrite:
        raise InputError(f"{path}: expected a folder without a traverse, found one; overwrite is off")
    copies = _copies(traverse, folder)
    observations = traverse.observations
    with refused_by_schema(path):
        entries = traverse_entries(traverse)
    content = entries.model_dump(exclude={"sharing", "constraints", "points", "site"})
    if entries.sharing is not None:
        content["sharing"] = entries.sharing.model_dump(exclude_defaults=True)
    if entries.constraints:
        content["constraints"] = [one.model_dump() for one in entries.constraints]
    if entries.points is not None:
        content["points"] = entries.points
    if entries.site is not None:
        content["site"] = entries.site.model_dump()
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for source, target in copies:
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
        for surface, name in surface_files(traverse.constraints, traverse.folder).items():
            _write_surface(surface, folder / name)
        if observations is not None:
            whole_file(folder / _OBSERVATIONS, observations_npz(observations.without_points()))
        if traverse.points is not None:
            whole_file(folder / _POINTS, points_csv(traverse.points, [i.id for i in traverse.images]))
        whole_file(path, f"{text}\n".encode())  # last, so that a folder with it is complete
    except OSError as error:
        raise InputError(f"{folder}: expected a folder to write to, found: {error}") from error


def _write_surface(surface: Surface, target: Path) -> None:
    """Copy a surface's own file, or write one."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if surface.file is None:
        write_surface(surface, target)
    elif surface.file.resolve() != target.resolve():
        shutil.copyfile(surface.file, target)


def traverse_of(
    entries: TraverseFile,
    folder: Path,
    observations: Observations | None = None,
    points: NamedPoints | None = None,
) -> Traverse:
    """The traverse that a file's entries say. Raises InputError as `Traverse` does."""
    stops = tuple(
        Stop(
            id=s.id,
            world_T_mast=s.world_T_mast.pose(f"stops[{i}].world_T_mast"),
            sigma_rotation_rad=s.sigma_rotation_rad,
            sigma_translation_m=s.sigma_translation_m,
        )
        for i, s in enumerate(entries.stops)
    )
    site = None
    if entries.site is not None:
        with prefixed("site"):
            site = entries.site.site()
    places = np.array([s.world_T_mast.translation()[:2] for s in stops])
    return Traverse(
        name=entries.name if entries.name is not None else visible(folder.resolve().name),
        rig=entries.rig.rig(),
        stops=stops,
        frames=tuple(Frame(**f.model_dump()) for f in entries.frames),
        images=tuple(i.image() for i in entries.images),
        observations=None if observations is None else observations.with_points(points),
        sharing=None if entries.sharing is None else entries.sharing.sharing(),
        folder=folder,
        constraints=constraints_of(entries.constraints, folder, places, site),
        points=points,
        site=site,
    )


def traverse_entries(traverse: Traverse) -> TraverseFile:
    """A traverse as the entries of its file."""
    stops = [
        StopEntry(
            id=s.id,
            world_T_mast=PoseEntry.of(s.world_T_mast),
            sigma_rotation_rad=float(s.sigma_rotation_rad),
            sigma_translation_m=float(s.sigma_translation_m),
        )
        for s in traverse.stops
    ]
    frames = [
        FrameEntry(
            id=f.id,
            stop=f.stop,
            pan_rad=float(f.pan_rad),
            tilt_rad=float(f.tilt_rad),
            sigma_pan_rad=float(f.sigma_pan_rad),
            sigma_tilt_rad=float(f.sigma_tilt_rad),
        )
        for f in traverse.frames
    ]
    surfaces = surface_files(traverse.constraints, traverse.folder)
    return TraverseFile(
        name=traverse.name,
        rig=rig_entry(traverse.rig),
        stops=stops,
        frames=frames,
        images=[ImageEntry.of(i) for i in traverse.images],
        observations=None if traverse.observations is None else _OBSERVATIONS,
        sharing=None if traverse.sharing is None else SharingEntry.of(traverse.sharing),
        constraints=[constraint_entry(one, surfaces) for one in traverse.constraints],  # type: ignore[misc]  # of its union
        points=None if traverse.points is None else _POINTS,
        site=None if traverse.site is None else SiteEntry.of(traverse.site),
    )


def _read_folders(root: Path, folders: Sequence[Path]) -> Traverse:
    parts = [read_traverse(folder) for folder in folders]
    if len(parts) == 1:
        return parts[0]
    return joined_drive(root, [Part.of(each, traverse_entries(each), root) for each in parts], _TRAVERSE_JSON)


TRAVERSE_FOLDER = InputFormat(
    needs=_TRAVERSE_JSON, matches=lambda names: _TRAVERSE_JSON in names, read=_read_folders
)


def _unusable_images(files: list[list[Path]], traverse: Traverse) -> dict[str, ImageError]:
    """The image files that cannot be used, by id.

    Raises ImageError for a mask that cannot be used and if no image file can, InputError for images of two
    rovers.
    """
    hosts: dict[str, Path] = {}
    masks: set[tuple[Path, int, int]] = set()
    unusable: dict[int, ImageError] = {}
    for row, of_image in enumerate(files):
        if not of_image:
            continue
        file = of_image[0]
        camera = traverse.rig.eyes[int(traverse.image_eye[row])].camera
        mask = mask_file(traverse, row)
        try:
            # Most often one mask serves many images; it is read once.
            if mask is not None and (mask, camera.width_px, camera.height_px) not in masks:
                read_mask(mask, camera.width_px, camera.height_px, file.name)
                masks.add((mask, camera.width_px, camera.height_px))
        except ImageError as error:
            raise _at(traverse, row, error) from error
        try:
            content = read_picture(traverse, row)
        except ImageError as error:
            unusable[row] = error
            continue
        if content.host is not None:
            hosts.setdefault(content.host, file)
            first = next(iter(hosts))
            if content.host != first:
                raise InputError(
                    f"{file}: INSTRUMENT_HOST_ID: expected {first} as in {hosts[first].name}, "
                    f"found {content.host}: images of two rovers"
                )
    named = [of_image for of_image in files if of_image]
    lost = traverse.observations is not None and all(is_missing(file) for of in named for file in of)
    if len(unusable) == len(named) > 0 and not lost:
        row, first_error = next(iter(unusable.items()))
        raise _at(traverse, row, first_error) from first_error
    return {traverse.images[row].id: error for row, error in unusable.items()}


def _at(traverse: Traverse, row: int, error: ImageError) -> ImageError:
    """An error that says which entry of the traverse it is about."""
    return ImageError(
        f"{traverse.folder}/{_TRAVERSE_JSON}: images[{row}] ({traverse.images[row].id}): {error}"
    )


def _copies(traverse: Traverse, folder: Path) -> list[tuple[Path, Path]]:
    if traverse.folder is None or traverse.folder.resolve() == folder.resolve():
        return []
    named = [
        (f"images[{row}].{kind}", name)
        for row, i in enumerate(traverse.images)
        for kind, name in (*((f"file {file}", file) for file in i.files), ("mask", i.mask))
        if name is not None
    ]
    files = {folder / name: inside(traverse.folder, name, entry) for entry, name in named}
    for row in range(len(traverse.images)):
        mask = mask_file(traverse, row)  # also a mask that no entry names
        if mask is not None:
            files[folder / mask.relative_to(traverse.folder)] = mask
    for source in files.values():
        other = instead_of_file(source)
        if other is not None:
            raise ImageError(f"{source}: expected an image file to copy along, found {other}")
    return [(source, target) for target, source in files.items()]
