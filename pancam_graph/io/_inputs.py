"""Whatever the user points at, as a traverse."""

from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.data import Traverse
from pancam_graph.io._pds import read_pds
from pancam_graph.io._traverse_json import read_traverse

__all__ = ["read_input"]

_PDS_SUFFIXES = {".img", ".lbl"}


def read_input(path: Path | str) -> Traverse:
    """Read a folder: a traverse (with traverse.json), or rover images with PDS labels (*.IMG, *.LBL).

    Raises InputError saying what was expected and what was found, and as `read_traverse` and `read_pds` do.
    """
    path = Path(path)
    expected = f"{path}: expected a folder with traverse.json or with PDS images (*.IMG, *.LBL)"
    try:
        names = sorted(p.name for p in path.iterdir())
    except FileNotFoundError as error:
        raise InputError(f"{expected}, found nothing there") from error
    except NotADirectoryError as error:
        raise InputError(f"{expected}, found a file") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{expected}, found a path that cannot be read ({error})") from error
    if "traverse.json" in names:
        return read_traverse(path)
    if any(Path(n).suffix.lower() in _PDS_SUFFIXES for n in names):
        return read_pds(path)
    found = f"{names[0]} and {len(names) - 1} more" if len(names) > 1 else "".join(names) or "an empty folder"
    raise InputError(f"{expected}, found {found}")
