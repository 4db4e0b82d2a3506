"""Files and folders that appear whole or not at all."""

import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["whole_file", "whole_folder"]


def whole_file(path: Path, content: bytes) -> None:
    """Write a file under another name and rename it: a reader sees the old content or the new, whole."""
    partial = _sibling(path, "partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path, *, keep: str | None = None) -> Iterator[Path]:
    """A new folder beside `path` to write into, renamed to `path` when the block ends.

    What was at `path` is moved aside just before the renaming and deleted just after it, except for its entry
    of the name `keep`, which moves into the new folder. If the block raises or the renaming fails, the new
    folder is deleted and `path` is as before. Missing parents are made.
    """
    path = path.resolve()  # a link stays, and what it leads to is replaced
    path.parent.mkdir(parents=True, exist_ok=True)
    partial, older = _sibling(path, "partial"), _sibling(path, "older")
    partial.mkdir()
    try:
        yield partial
        if path.exists():
            path.rename(older)
            if keep is not None and (older / keep).exists():
                (older / keep).rename(partial / keep)
        partial.rename(path)
    except BaseException:  # an interrupt from the keyboard too
        if keep is not None and older.exists() and (partial / keep).exists():
            (partial / keep).rename(older / keep)
        if older.exists() and not path.exists():
            older.rename(path)
        shutil.rmtree(partial, ignore_errors=True)
        raise
    shutil.rmtree(older, ignore_errors=True)


def _sibling(path: Path, kind: str) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.{kind}")
