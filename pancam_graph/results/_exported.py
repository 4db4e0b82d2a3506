"""Folders of exports: each lists its own files, so that nothing else in it is ever deleted."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.base.whole_files import whole_folder
from pancam_graph.io import VERSION, read_json, short

__all__ = ["EXPORT_JSON", "check_export", "file_names", "require_export", "whole_export", "write_export_json"]

EXPORT_JSON = "export.json"
_FORMAT = "pancam-graph/export"


def file_names(ids: Sequence[str]) -> list[str]:
    """A name for each id that is safe in a path and in a table split at blanks, all different.

    Letters, digits, dots, dashes and underscores stay, anything else becomes an underscore.
    """
    taken: dict[str, int] = {}
    out = []
    for identity in ids:
        name = re.sub(r"[^A-Za-z0-9._-]", "_", identity).lstrip(".") or "_"
        unique = name
        while unique.lower() in taken:  # some file systems do not tell upper from lower case
            taken[name.lower()] += 1
            unique = f"{name}-{taken[name.lower()]}"
        taken[unique.lower()] = 1
        out.append(unique)
    return out


def write_export_json(folder: Path, kind: str, about: Mapping[str, object]) -> None:
    """Write `export.json`: the kind of the export, the entries of `about`, and the files in the folder."""
    files = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    content = {"format": _FORMAT, "version": VERSION, "kind": kind, **about, "files": files}
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    (folder / EXPORT_JSON).write_text(f"{text}\n", encoding="utf-8")


def require_export(folder: Path, expected: str) -> None:
    """Raise InputError, beginning with `expected`, unless a folder is an export and holds nothing else."""
    try:
        files = read_json(folder / EXPORT_JSON, _FORMAT, VERSION).get("files")
    except InputError as error:
        raise InputError(f"{expected}, found {folder.name}, which is no export of ours: {error}") from error
    if not isinstance(files, list):
        raise InputError(f"{expected}, found {folder / EXPORT_JSON}: files: {short(files)}")
    ours = {EXPORT_JSON, *(f for f in files if isinstance(f, str))}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not path.is_dir() and name not in ours:
            raise InputError(f"{expected}, found what others made in it: {folder.name}/{name}")


def check_export(folder: Path) -> None:
    """Raise InputError unless a folder is new, empty, or an older export with nothing else in it."""
    expected = f"{folder}: expected a new folder or one of an older export"
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{expected}, found a file")
    if folder.is_dir() and any(folder.iterdir()):
        require_export(folder, expected)


@contextmanager
def whole_export(folder: Path) -> Iterator[Path]:
    """A folder to write an export into, renamed to `folder` when the block ends; see `whole_folder`.

    Raises InputError unless `folder` is new, empty, or an older export with nothing else in it, and where
    writing fails.
    """
    try:
        check_export(folder)
        with whole_folder(folder) as partial:
            yield partial
    except OSError as error:
        raise InputError(f"{folder}: expected a place where files can be written, found: {error}") from error
