"""From our folders and files of other programs to files of other programs."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.base.regular_files import instead_of_file
from pancam_graph.results._doors import Door, door_of
from pancam_graph.results._exported import require_export, whole_export
from pancam_graph.results._read_source import TAKEN_IN, read_any
from pancam_graph.results.formats import Source

__all__ = ["Converted", "convert"]


@dataclass(frozen=True, kw_only=True)
class Converted:
    """What was written."""

    to: str
    """Name of the format."""
    passed: bool
    """False where a solution was written that failed a test or did not converge."""
    warnings: tuple[str, ...]
    """What the format could not say."""


def convert(
    path: Path | str,
    out: Path | str,
    *,
    to: str | None = None,
    images: Path | str | None = None,
    overwrite: bool = False,
) -> Converted:
    """Write a folder or a file as a file or a folder of another program.

    `path` is a folder of results, a folder of a drive (as telemetry has it), a `.cahvor` file, or a `.tpt`,
    `.nav`, `.rvf` or control network (`.csv`), which are taken into the drive of the folder `images`. `to` is
    a name of `DOORS`; None: the ending of `out` says it, else such a file becomes a drive. For results,
    `images` is the folder that was refined, where it is not any more where it was then. Whole or not at all;
    with `overwrite` an older file, or an older folder of ours, is replaced.

    Raises InputError for a format that is none, for what it cannot say, for an `out` that is there, and as
    the readers do.
    """
    path, out = Path(path), Path(out)
    if to is None and path.suffix.lower() in TAKEN_IN and not out.suffix and not path.is_dir():
        to = "traverse"
    door = door_of(out, to)
    _require_free(out, door, overwrite=overwrite)
    if not path.exists():
        raise InputError(f"{path}: expected a folder or a file to convert, found nothing there")
    if path.is_dir() and out.resolve() == path.resolve():
        raise InputError(f"{out}: expected another place than the folder that is converted, found the same")
    source = read_any(path, None if images is None else Path(images))
    if door.is_folder:
        with whole_export(out) as folder:
            door.writer()(source, folder)
    else:
        _write_file(source, out, door)
    passed = not source.is_solved or source.solution.passed
    return Converted(to=door.name, passed=passed, warnings=tuple(source.warnings))


def _write_file(source: Source, out: Path, door: Door) -> None:
    """Write a file under another name beside it, and rename it."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".convert-", dir=out.parent) as place:
            written = Path(place) / "file"
            door.writer()(source, written)
            written.replace(out)
    except OSError as error:
        raise InputError(f"{out}: expected a place where files can be written, found: {error}") from error


def _require_free(out: Path, door: Door, *, overwrite: bool) -> None:
    """Raise InputError unless the format can go to a path."""
    there = instead_of_file(out)
    if door.is_folder:
        expected = f"{out}: expected a new folder for {door.name}"
        if there is None:
            raise InputError(f"{expected}, found a file")
        if out.is_dir() and any(out.iterdir()):
            if not overwrite:
                raise InputError(
                    f"{expected}, found one with files in it; --overwrite replaces an older export"
                )
            require_export(out, f"{expected} or one of an older export")
        return
    if out.is_dir():
        raise InputError(f"{out}: expected a new file for {door.name}, found a folder")
    if there is None and not overwrite:
        raise InputError(f"{out}: expected a new file for {door.name}, found one; --overwrite replaces it")
