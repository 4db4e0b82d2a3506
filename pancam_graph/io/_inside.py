"""Files that entries name, which must lie in their own folder."""

from pathlib import Path, PurePosixPath, PureWindowsPath

from pancam_graph.base.errors import InputError
from pancam_graph.io._json import short

__all__ = ["inside"]


def inside(folder: Path, name: str, entry: str) -> Path:
    """Path of a file that an entry names. Raises InputError unless it lies in the folder, links followed."""
    expected = f"{entry}: expected a path inside the traverse folder"
    for kind in (PurePosixPath, PureWindowsPath):
        pure = kind(name)
        if pure.is_absolute() or pure.drive or ".." in pure.parts:
            raise InputError(f"{expected}, found {short(name)}")
    try:
        lies_inside = (folder / name).resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError) as error:  # a ring of links, a NUL in the name
        raise InputError(f"{expected}, found {short(name)} ({error})") from error
    if not lies_inside:
        raise InputError(f"{expected}, found {short(name)}, a link that leads out of it")
    return folder / name
