"""Plain pictures in a folder and in folders below it, by their headers."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from pancam_graph.base.choices import some_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.regular_files import instead_of_file
from pancam_graph.io._picture_size import MAX_PIXELS, PICTURE_FORMATS, looks_like_picture, picture_size
from pancam_graph.io.plain._exif import Exif, read_exif

__all__ = ["PlainPicture", "find_pictures"]

_DEPTH = 2
"""Folders below the folder of pictures that are looked into: stops, and eyes in them."""
_NOT_LOOKED_INTO = frozenset({"masks", "cache"})
"""Names of folders whose pictures are none of the traverse."""
_RESULTS = "solution.json"
"""What a folder of results has."""
_OURS = frozenset({"traverse.json", "traverse.txt"})


@dataclass(frozen=True, kw_only=True)
class PlainPicture:
    """A picture as its header says it."""

    file: str
    """Path in the folder, with / between names."""
    path: Path
    """The file."""
    width_px: int
    height_px: int
    """As the pixels are stored, whatever EXIF says of turning them."""
    exif: Exif

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.width_px, self.height_px


def find_pictures(folder: Path, others: Collection[Path]) -> tuple[dict[str, PlainPicture], list[str]]:
    """Pictures by their path in the folder, and warnings of files that are none.

    Looks into folders below, down to two, but not into hidden ones, masks, and results of this program.
    `others` are files that may lie there and are no pictures.

    Raises InputError for what is no folder, and for one without a picture.
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing there"
        raise InputError(f"{folder}: expected a folder with pictures, found {found}")
    known = {_resolved(path) for path in others} - {None}
    root = folder.resolve()
    pictures: dict[str, PlainPicture] = {}
    warnings: list[str] = []
    foreign: list[str] = []
    for path in _files(folder, _DEPTH):
        name = path.relative_to(folder).as_posix()
        if name in _OURS or _resolved(path) in known:
            continue
        if not looks_like_picture(path):
            foreign.append(name)
            continue
        picture = _picture(path, name, root)
        if isinstance(picture, str):
            warnings.append(f"{name} is left out: {picture}")
            continue
        pictures[name] = picture
        if picture.exif.problem:
            warnings.append(f"{name}: EXIF is not used where it is nonsense: {picture.exif.problem}")
    if not pictures:
        found = some_of([*foreign, *(w.partition(" ")[0] for w in warnings)])
        raise InputError(
            f"{folder}: expected pictures ({PICTURE_FORMATS}) in it or in folders below it, found "
            f"{found or 'an empty folder'}"
        )
    if foreign:
        warnings.append(f"files that are no pictures are left alone: {some_of(foreign)}")
    return pictures, warnings


def _resolved(path: Path) -> Path | None:
    """The path without links; None for a ring of links, and for what the system refuses."""
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):
        return None


def _files(folder: Path, depth: int) -> Iterator[Path]:
    """Files of a folder and of those below it, in order of their names."""
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise InputError(
            f"{folder}: expected a folder that can be read, found: {error.strerror or error}"
        ) from error
    for path in entries:
        if path.name.startswith("."):
            continue
        if not path.is_dir():
            yield path
        elif depth and path.name not in _NOT_LOOKED_INTO and not (path / _RESULTS).exists():
            yield from _files(path, depth - 1)


def _picture(path: Path, name: str, root: Path) -> PlainPicture | str:
    """The picture, or why it is none."""
    other = instead_of_file(path)
    if other is not None:
        return f"expected an image file, found {other}"
    try:
        resolved = _resolved(path)
        if resolved is None or not resolved.is_relative_to(root):
            return "expected a file inside the folder, found a link that leads out of it"
        data = path.read_bytes()
    except OSError as error:
        return f"expected an image file, could not read it: {error.strerror}"
    size = picture_size(data)
    if size is None or min(size) < 1:
        return (
            f"expected an image that can be read ({PICTURE_FORMATS}), found {len(data)} bytes that are none"
        )
    if size[0] * size[1] > MAX_PIXELS:
        return f"expected a picture of at most {MAX_PIXELS} pixels, found {size[0]} x {size[1]}"
    return PlainPicture(file=name, path=path, width_px=size[0], height_px=size[1], exif=read_exif(data))
