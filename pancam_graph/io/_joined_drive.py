"""Traverse folders with parts of one drive, such as the pictures of later sols, put together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.data import Constraint, Image, NamedPoints, Observations, Traverse
from pancam_graph.io._json import prefixed, short
from pancam_graph.io._mask_files import mask_file
from pancam_graph.io._schema import TraverseFile

__all__ = ["Part", "joined_drive", "parts_of"]


def parts_of(root: Path, folders: Sequence[Path]) -> tuple[str, ...]:
    """Folders relative to one that has them all; none where it is the only one."""
    return tuple(folder.relative_to(root).as_posix() for folder in folders) if len(folders) > 1 else ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """A folder of a drive."""

    folder: Path
    traverse: Traverse
    """Paths of its pictures and masks are relative to the folder of the whole drive."""
    entries: TraverseFile
    """What its file says."""

    @staticmethod
    def of(traverse: Traverse, entries: TraverseFile, root: Path) -> "Part":
        """A part as it was read, within the folder `root` of the whole drive."""
        assert traverse.folder is not None
        way = traverse.folder.relative_to(root).as_posix()
        images = tuple(_moved(traverse, row, way) for row in range(len(traverse.images)))
        return Part(folder=traverse.folder, traverse=replace(traverse, images=images), entries=entries)


def _moved(traverse: Traverse, row: int, way: str) -> Image:
    """An image with its files and mask, if any, as paths from a folder above, from which `way` leads here."""
    image, found = traverse.images[row], mask_file(traverse, row)
    mask = None
    if found is not None:
        assert traverse.folder is not None
        mask = f"{way}/{found.relative_to(traverse.folder).as_posix()}"
    tiles = tuple(replace(tile, file=f"{way}/{tile.file}") for tile in image.tiles)
    file = None if image.file is None else f"{way}/{image.file}"
    return replace(image, file=file, tiles=tiles, mask=mask)


def joined_drive(root: Path, parts: Sequence[Part], file_name: str) -> Traverse:
    """The drive of several parts, in their order; `file_name` is that of the files with their entries.

    Raises InputError naming file and entry: where rig, sharing or site differ from the first part's, where
    stops or frames of one id differ, for an image that is there twice, and where only some have observations.
    """
    first = parts[0]
    for part in parts[1:]:
        with prefixed(f"{part.folder / file_name}"):
            for name in ("rig", "sharing", "site"):
                own, other = (_plain(getattr(p.entries, name)) for p in (first, part))
                _require_same(name, own, other, first.folder)
            own, other = ("null" if p.entries.observations is None else "a file" for p in (first, part))
            if own != other:
                raise InputError(f"observations: expected {own} as in {first.folder}, found {other}")
    stops, shared = _once(parts, "stops", file_name)
    frames, _ = _once(parts, "frames", file_name)
    known: dict[str, Part] = {}
    for part in parts:
        for image in part.traverse.images:
            if image.id in known:
                raise InputError(
                    f"{part.folder / file_name}: images: {image.id}: expected another id than one of "
                    f"{known[image.id].folder} has, found the same"
                )
            known[image.id] = part
    begin = np.cumsum([0, *(len(part.traverse.images) for part in parts)])
    points = _points(parts, begin.tolist())
    drive = Traverse(
        name=first.traverse.name,
        rig=first.traverse.rig,
        stops=stops,
        frames=frames,
        images=tuple(image for part in parts for image in part.traverse.images),
        observations=None,
        sharing=first.traverse.sharing,
        folder=root,
        parts=parts_of(root, [part.folder for part in parts]),
        warnings=(
            *dict.fromkeys(warning for part in parts for warning in part.traverse.warnings),
            *(
                f"stop {stop}: frames of {' and '.join(of)} count as taken at one place"
                for stop, of in shared
            ),
        ),
        points=points,
        site=first.traverse.site,
    )
    observations = _observations(parts, begin.tolist())
    if observations is not None:
        drive = replace(drive, observations=observations.with_points(points))
    # Ties name tracks and points of the whole drive.
    return replace(drive, constraints=_ties(parts))


def _plain(entry: Any) -> Any:
    return entry.model_dump() if hasattr(entry, "model_dump") else entry


def _require_same(where: str, own: Any, other: Any, folder: Path) -> None:
    """Raise InputError naming the first entry that differs; the name of a rig may."""
    if isinstance(own, dict) and isinstance(other, dict) and own.keys() == other.keys():
        for key in own:
            if (where, key) != ("rig", "name"):
                _require_same(f"{where}.{key}", own[key], other[key], folder)
    elif isinstance(own, list) and isinstance(other, list) and len(own) == len(other):
        for i, pair in enumerate(zip(own, other, strict=True)):
            _require_same(f"{where}[{i}]", *pair, folder)
    elif own != other:
        raise InputError(
            f"{where}: expected {short(own)} as in {folder}, to which it is added; found {short(other)}"
        )


def _once(
    parts: Sequence[Part], kind: str, file_name: str
) -> tuple[tuple[Any, ...], list[tuple[str, list[str]]]]:
    """Stops or frames of all parts, each once, and the ids that several parts name, with their folders."""
    found: dict[str, Any] = {}
    entry_of: dict[str, Any] = {}
    folders: dict[str, list[Path]] = {}
    for part in parts:
        for value, entry in zip(getattr(part.traverse, kind), getattr(part.entries, kind), strict=True):
            if value.id in found:
                with prefixed(f"{part.folder / file_name}"):
                    own, other = entry_of[value.id].model_dump(), entry.model_dump()
                    _require_same(f"{kind} ({value.id})", own, other, folders[value.id][0])
            found.setdefault(value.id, value)
            entry_of.setdefault(value.id, entry)
            folders.setdefault(value.id, []).append(part.folder)
    shared = [(name, [str(folder) for folder in of]) for name, of in folders.items() if len(of) > 1]
    return tuple(found.values()), shared


def _ties(parts: Sequence[Part]) -> tuple[Constraint, ...]:
    """The ties of all parts; one that an earlier part has too, word for word, counts once.

    Files of surfaces are each part's own: ties on them are not compared.
    """
    ties, known = list[Constraint](), list[dict[str, Any]]()
    for part in parts:
        own = [entry.model_dump() for entry in part.entries.constraints]
        for tie, entry in zip(part.traverse.constraints, own, strict=True):
            if "file" in entry or entry not in known:
                ties.append(tie)
        known += own
    return tuple(ties)


def _points(parts: Sequence[Part], begin: Sequence[int]) -> NamedPoints | None:
    """Marks of all parts; `begin` is the row of each part's first image."""
    there = [(p.traverse.points, first) for p, first in zip(parts, begin, strict=False)]
    marks = [(points, first) for points, first in there if points is not None]
    if not marks:
        return None
    return NamedPoints(
        name=tuple(name for points, _ in marks for name in points.name),
        image=np.concatenate([points.image + first for points, first in marks]),
        uv_px=np.concatenate([points.uv_px for points, _ in marks]),
        sigma_px=np.concatenate([points.sigma_px for points, _ in marks]),
    )


def _observations(parts: Sequence[Part], begin: Sequence[int]) -> Observations | None:
    """Observations of all parts without marks; None where they are still to be found."""
    own = [None if (o := part.traverse.observations) is None else o.without_points() for part in parts]
    given = [o for o in own if o is not None]
    if not given:
        return None
    covariance = None
    if any(o.covariance_px2 is not None for o in given):
        covariance = np.concatenate(
            [
                o.covariance_px2
                if o.covariance_px2 is not None
                else o.sigma_px[:, None, None] ** 2 * np.eye(2)
                for o in given
            ]
        )
    return Observations(
        image=np.concatenate([o.image + first for o, first in zip(given, begin, strict=False)]),
        track=np.concatenate([o.track for o in given]),
        uv_px=np.concatenate([o.uv_px for o in given]),
        sigma_px=np.concatenate([o.sigma_px for o in given]),
        covariance_px2=covariance,
    )
