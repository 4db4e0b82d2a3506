"""The folder of results: solution.json, points.ply, residuals.csv, report.html, exports; whole or none."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.base.whole_files import whole_folder
from pancam_graph.data import Solution
from pancam_graph.images import CACHE, is_cache
from pancam_graph.io import MOSAIC_FORMAT, SOLUTION_FORMAT, VERSION, read_json, refused_by_schema
from pancam_graph.mosaic import MOSAIC_INDEX, MosaicOptions, write_mosaics
from pancam_graph.results._brightness import brightness_of
from pancam_graph.results._exported import require_export
from pancam_graph.results._exports import EXPORTS, Export, check_exports, fill_exports
from pancam_graph.results._ply import points_ply
from pancam_graph.results._residuals_csv import residuals_csv
from pancam_graph.results._solution_json import solution_json

__all__ = ["MOSAICS", "RESULT_FILES", "check_out", "write_results"]

RESULT_FILES = ("solution.json", "points.ply", "residuals.csv", "report.html")
"""What a folder of results consists of; the report may be missing."""
MOSAICS = "mosaics"
"""Name of the folder of mosaics in it, where they were asked for."""


def check_out(out: Path | str) -> None:
    """Make sure that results can go to `out`, without writing anything; for before a long solve.

    Raises InputError unless `out` is new, an empty folder, or a folder with nothing but older results and
    the cache of a run, interrupted or not, and its place can be written to.
    """
    out = Path(out)
    expected = f"{out}: expected a new folder or one of older results"
    try:
        if out.is_symlink() and not out.exists():
            raise InputError(f"{expected}, found a link that leads nowhere")
        target = out.resolve()
        if not out.exists():
            parent = next(p for p in target.parents if p.exists())
        elif not out.is_dir():
            raise InputError(f"{expected}, found a file")
        else:
            _require_results(target, expected)
            if target == Path.cwd():
                raise InputError(f"{expected}, found the folder that this program works in")
            if target.is_mount():
                raise InputError(
                    f"{expected}, found a mount point, which cannot be renamed: use a folder in it"
                )
            parent = target.parent
    except (OSError, RuntimeError, ValueError) as error:  # a name too long, a ring of links, a NUL
        raise InputError(f"{expected}, found a path that cannot be used ({error})") from error
    if not parent.is_dir():
        raise InputError(f"{expected}, found a file in its place: {parent}")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"{expected}, found no permission to write in {parent}")


def write_results(
    solution: Solution,
    out: Path | str,
    *,
    report: bool = True,
    exports: Sequence[Export] = (),
    mosaics: MosaicOptions | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Solution:
    """Write the results of a solution into the folder `out`; see `RESULT_FILES` and `exports.EXPORTS`.

    Everything is written into a folder beside and renamed when complete: an older folder of results stays
    whole until then, and is there as before if anything fails. With options of `mosaics`, a folder of them
    is among the results; `progress` is told of each. Returns the solution with the time that writing took as
    its `seconds.report`, and with warnings of images that the mosaics lack. Raises InputError as `check_out`
    and `check_exports` do, and where writing fails.
    """
    out = Path(out)
    check_out(out)
    exports = check_exports(solution.traverse, exports)
    started = time.perf_counter()
    try:
        with whole_folder(out, keep=CACHE) as folder, refused_by_schema(out):
            brightness = brightness_of(solution)
            (folder / "points.ply").write_bytes(points_ply(solution, brightness.grey))
            fill_exports(solution, exports, folder, brightness)
            (folder / "residuals.csv").write_bytes(residuals_csv(solution))
            written = None
            if mosaics is not None:
                (folder / MOSAICS).mkdir()
                written = write_mosaics(solution, folder / MOSAICS, mosaics, progress=progress)
                solution = replace(solution, warnings=(*solution.warnings, *written.warnings))
            if report:
                from pancam_graph.report import write_report  # noqa: PLC0415  Plotly is only for reports

                write_report(solution, folder / "report.html", written)
            # Last: it says how long the others took.
            timed = solution.with_seconds(report=solution.seconds.report + time.perf_counter() - started)
            (folder / "solution.json").write_bytes(solution_json(timed))
    except OSError as error:
        raise InputError(f"{out}: expected a place where results can be written, found: {error}") from error
    return timed


def _no_mosaics(folder: Path) -> list[str]:
    """Names in a folder that its index does not know as mosaics; all where there is no index."""
    found = sorted(p.name for p in folder.iterdir()) if folder.is_dir() and not folder.is_symlink() else [""]
    try:
        index = read_json(folder / MOSAIC_INDEX, MOSAIC_FORMAT, VERSION)
    except InputError:
        return found
    ours = {MOSAIC_INDEX}
    for entry in index["mosaics"] if isinstance(index.get("mosaics"), list) else []:
        files = entry.get("files") if isinstance(entry, dict) else None
        ours |= {f for f in files.values() if isinstance(f, str)} if isinstance(files, dict) else set()
    return [n for n in found if n not in ours or not (folder / n).is_file()]


def _require_results(folder: Path, expected: str) -> None:
    """Raise InputError unless a folder is empty or holds nothing but results."""
    found = sorted(p.name for p in folder.iterdir() if p.name != CACHE or not is_cache(p))
    exports = [n for n in found if n in EXPORTS and (folder / n).is_dir()]
    strangers = [
        n for n in found if n not in exports and (n not in RESULT_FILES or not (folder / n).is_file())
    ]
    if MOSAICS in strangers:
        strangers.remove(MOSAICS)
        strangers += [f"{MOSAICS}/{n}" for n in _no_mosaics(folder / MOSAICS)]
    if strangers:
        more = f" and {len(strangers) - 1} more" if len(strangers) > 1 else ""
        raise InputError(f"{expected}, found other things in it: {strangers[0]}{more}")
    if found and "solution.json" not in found:
        raise InputError(f"{expected}, found {found[0]} but no solution.json")
    if found:
        try:
            read_json(folder / "solution.json", SOLUTION_FORMAT, VERSION)
        except InputError as error:
            raise InputError(f"{expected}, found a solution.json that is none of ours: {error}") from error
    for name in exports:
        require_export(folder / name, expected)
