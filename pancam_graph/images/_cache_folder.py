"""The cache's folder, which lies within the folder of results."""

import json
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.base.whole_files import whole_file
from pancam_graph.io import read_json

__all__ = ["CACHE", "begin_cache", "cache_folder", "is_cache"]

CACHE = "cache"
"""Name of the cache's folder."""

_FORMAT, _VERSION = "pancam-graph/cache", 1
_MARK = "cache.json"


def cache_folder(out: Path | str) -> Path:
    """Where the cache of a folder of results is."""
    return Path(out) / CACHE


def begin_cache(folder: Path) -> None:
    """Make the folder, and the file that marks it as a cache. Raises OSError if that fails."""
    folder.mkdir(parents=True, exist_ok=True)
    mark = json.dumps({"format": _FORMAT, "version": _VERSION})
    whole_file(folder / _MARK, f"{mark}\n".encode())


def is_cache(folder: Path) -> bool:
    """Whether a folder is a cache of this version."""
    if folder.is_symlink() or not folder.is_dir():
        return False
    try:
        read_json(folder / _MARK, _FORMAT, _VERSION)
    except InputError:
        return False
    return True
