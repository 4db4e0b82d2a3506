"""Regular files, the only kind that is read: opening a pipe or a device may wait for ever."""

import stat
from pathlib import Path

__all__ = ["instead_of_file", "is_missing"]

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


_MISSING, _DANGLING = "nothing there", "a link to nothing"


def instead_of_file(path: Path) -> str | None:
    """What stands in place of a regular file, as error messages say it; None for a regular file.

    Links are followed. A path that the system refuses (a name too long, a folder that may not be entered) is
    said in the system's words.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return _DANGLING if path.is_symlink() else _MISSING
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        return (error.strerror if isinstance(error, OSError) else None) or str(error)
    return None if stat.S_ISREG(mode) else _KINDS.get(stat.S_IFMT(mode), "something else")


def is_missing(path: Path) -> bool:
    """Whether there is nothing, or a link to nothing."""
    return instead_of_file(path) in {_MISSING, _DANGLING}
