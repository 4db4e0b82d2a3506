"""The formats of input folders there are. To add one: a module with its reader, and a line in `FORMATS`."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.data import Traverse
from pancam_graph.io._input_format import InputFormat
from pancam_graph.io._pds import PDS3
from pancam_graph.io._picture_size import looks_like_picture
from pancam_graph.io._traverse_json import TRAVERSE_FOLDER

__all__ = ["FORMATS", "read_input"]

FORMATS: tuple[InputFormat, ...] = (TRAVERSE_FOLDER, PDS3)
"""All formats; a folder that is of several is read as the first of them."""


def read_input(path: Path | str, *added: Path | str) -> Traverse:
    """Read a drive from a folder of any of the `FORMATS`: a traverse folder, or rover images with PDS labels.

    `added` are folders with more of the same drive, such as the pictures of later sols, in the format of the
    first. Rover images of all are read as if they lay in one folder; of traverse folders the entries are put
    one after the other: rig, `sharing` and `site` must be the same, a stop or frame that several name must
    be the same too, and track numbers and names of points are common to all. The drive's `folder` is then
    the nearest one that has all of them, and `parts` names them.

    Raises InputError saying what was expected and what was found, and as the format's reader does
    (`read_traverse`, `read_pds`); for an added folder of another format or another rig, and for one that is
    named twice.
    """
    path = Path(path)
    known = _format_of(path)
    if not added:
        return known.read(path, [path])
    folders = [Path(os.path.normpath(Path(folder).absolute())) for folder in (path, *added)]
    for i, folder in enumerate(folders[1:]):
        other = _format_of(Path(added[i]))
        if other is not known:
            raise InputError(
                f"{added[i]}: expected a folder with {known.needs} as {path}, found one with {other.needs}"
            )
        if folder.resolve() in {before.resolve() for before in folders[: i + 1]}:
            raise InputError(f"{added[i]}: expected each folder once, found it twice")
    return known.read(Path(os.path.commonpath(folders)), folders)


def _format_of(path: Path) -> InputFormat:
    """The format of a folder. Raises InputError saying what was expected and what was found."""
    expected = f"{path}: expected a folder {' or '.join(f'with {known.needs}' for known in FORMATS)}"
    try:
        names = sorted(p.name for p in path.iterdir())
    except FileNotFoundError as error:
        raise InputError(f"{expected}, found nothing there") from error
    except NotADirectoryError as error:
        raise InputError(f"{expected}, found a file") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{expected}, found a path that cannot be read ({error})") from error
    for known in FORMATS:
        if known.matches(names):
            return known
    pictures = sum(looks_like_picture(name) for name in _names_within(path, names))
    if pictures:
        raise InputError(
            f"{expected}, found {pictures} pictures without; pancam-graph init "
            f"{path} makes a traverse.json of them"
        )
    content = f"{names[0]} and {len(names) - 1} more" if len(names) > 1 else "".join(names)
    raise InputError(f"{expected}, found {content or 'an empty folder'}")


def _names_within(folder: Path, names: Sequence[str]) -> Iterator[str]:
    """Names of what lies in a folder and in the folders in it; of those that cannot be read, none."""
    yield from names
    for name in names:
        try:
            yield from (path.name for path in (folder / name).iterdir())
        except (OSError, ValueError):
            continue
