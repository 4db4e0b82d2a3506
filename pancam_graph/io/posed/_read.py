"""The formats of posed cameras there are. To add one: a module with its reader, a line in `POSED_FORMATS`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.io.posed._bundler_file import is_bundler, read_bundler
from pancam_graph.io.posed._cahvor_folder import is_cahvor_folder, read_cahvor_folder
from pancam_graph.io.posed._colmap_model import is_colmap_model, read_colmap_model
from pancam_graph.io.posed._posed_camera import PosedCamera

__all__ = ["POSED_FORMATS", "PosedFormat", "read_posed"]


@dataclass(frozen=True, kw_only=True)
class PosedFormat:
    """A format of folders with posed cameras."""

    needs: str
    """What a folder of it has, as the end of a sentence."""
    matches: Callable[[Path], bool]
    """Whether a folder is of it."""
    read: Callable[[Path], list[PosedCamera]]
    """Its reader."""


POSED_FORMATS: tuple[PosedFormat, ...] = (
    PosedFormat(
        needs="a COLMAP model (images.bin or images.txt)", matches=is_colmap_model, read=read_colmap_model
    ),
    PosedFormat(needs="Bundler's bundle.out", matches=is_bundler, read=read_bundler),
    PosedFormat(needs="*.cahvor files", matches=is_cahvor_folder, read=read_cahvor_folder),
)
_WITHIN = ("", "sparse/0", "sparse", "0", "bundle")
"""Where in a folder programs put their models."""


def read_posed(folder: Path | str) -> list[PosedCamera]:
    """The cameras of a folder of any of the `POSED_FORMATS`, or of a usual folder in it (`sparse/0`).

    Raises InputError saying what was expected and what was found, and as the format's reader does.
    """
    folder = Path(folder)
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing there"
        raise InputError(f"{folder}: expected a folder of cameras, found {found}")
    for place in _WITHIN:
        path = folder / place
        for known in POSED_FORMATS if path.is_dir() else ():
            if _matches(known, path):
                cameras = known.read(path)
                if not cameras:
                    raise InputError(f"{path}: expected cameras with poses, found none")
                return cameras
    needs = " or ".join(known.needs for known in POSED_FORMATS)
    raise InputError(f"{folder}: expected a folder with {needs}, found none of them")


def _matches(known: PosedFormat, path: Path) -> bool:
    try:
        return known.matches(path)
    except OSError as error:
        raise InputError(f"{path}: expected a folder that can be read, found {error.strerror}") from error
