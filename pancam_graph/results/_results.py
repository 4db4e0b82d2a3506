"""The folder of results: whole or not there."""

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pancam_graph.base.errors import InputError
from pancam_graph.base.whole_files import recover, whole_folder
from pancam_graph.data import Solution
from pancam_graph.images import CACHE, is_cache
from pancam_graph.io import refused_by_schema
from pancam_graph.results._brightness import brightness_of
from pancam_graph.results._older import TERRAIN
from pancam_graph.results._output import Written
from pancam_graph.results._outputs import OUTPUTS, SOLUTION, check_exports

if TYPE_CHECKING:
    from pancam_graph.mosaic import MosaicOptions
    from pancam_graph.smoother import TraverseSmoother
    from pancam_graph.terrain import TerrainOptions

__all__ = ["check_out", "recover_results", "write_results"]


def check_out(out: Path | str) -> None:
    """Make sure that results can go to `out`, without writing anything; for before a long solve.

    Where a run that wrote to `out` was killed, the older results that it had moved aside come back first.
    Raises InputError unless `out` is new, an empty folder, or a folder with nothing but older results and
    the cache of a run, interrupted or not, and its place can be written to.
    """
    out = Path(out)
    expected = f"{out}: expected a new folder or one of older results"
    try:
        target = out.resolve()
        recover_results(target)
        if out.is_symlink() and not out.exists():
            raise InputError(f"{expected}, found a link that leads nowhere")
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
        reason = getattr(error, "strerror", None) or error  # without the path, which stands in front
        raise InputError(f"{expected}, found a path that cannot be used ({reason})") from error
    if not parent.is_dir():
        raise InputError(f"{expected}, found a file in its place: {parent}")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"{expected}, found no permission to write in {parent}")


def recover_results(out: Path | str) -> None:
    """Bring back the results that a run had moved aside from `out` when it was killed, and delete its own.

    Does nothing for a folder that no killed run wrote to.
    """
    recover(Path(out), keep=CACHE)
    if Path(out).is_dir():
        recover(Path(out) / TERRAIN)


def write_results(
    solution: Solution,
    out: Path | str,
    *,
    report: bool = True,
    csv: bool = False,
    exports: Sequence[str] = (),
    mosaics: "MosaicOptions | None" = None,
    terrain: "TerrainOptions | None" = None,
    progress: Callable[[str, int, int], None] | None = None,
    client: Any = None,
    smoother: "TraverseSmoother | None" = None,
) -> Solution:
    """Write the results of a solution into the folder `out`: all `OUTPUTS` that are asked for.

    Everything is written into a folder beside and renamed when complete: an older folder of results stays
    whole until then, and is there as before if anything fails. `csv`: whether residuals are written as CSV
    too. `exports` are names of `EXPORTS`. With options of `mosaics` and of `terrain`, folders of them are
    among the results; `progress` is told of each. Workers of `client`, a distributed.Client, match frames for
    terrain, and must see `out` at the same path. `smoother` is kept as `smoother.npz`. Returns the solution
    with the time that writing took as its `seconds.report`, and with warnings of images that mosaics and
    terrain lack, or why there is no terrain. Raises InputError as `check_out` and `check_exports` do, and
    where writing fails.
    """
    out = Path(out)
    check_out(out)
    exports = check_exports(solution.traverse, exports)
    asked = {
        "always": True,
        "report": report,
        "csv": csv,
        "mosaics": mosaics is not None,
        "terrain": terrain is not None,
        "smoother": smoother is not None,
    }
    chosen = [o for o in OUTPUTS if asked.get(o.when, o.name in exports)]
    started = time.perf_counter()
    try:
        with whole_folder(out, keep=CACHE) as folder, refused_by_schema(out):
            written = Written(
                solution=solution,
                brightness=brightness_of(solution),
                mosaic_options=mosaics,
                terrain_options=terrain,
                out=out,
                progress=progress,
                client=client,
                smoother=smoother,
                seconds=lambda: time.perf_counter() - started,
            )
            for output in chosen:
                path = folder / output.name
                if output.older.is_folder:
                    path.mkdir()
                written = output.writer().write(written, path)
    except OSError as error:
        raise InputError(f"{out}: expected a place where results can be written, found: {error}") from error
    return written.solution


def _require_results(folder: Path, expected: str) -> None:
    """Raise InputError unless a folder is empty or holds nothing but results."""
    names = sorted(p.name for p in folder.iterdir() if p.name != CACHE or not is_cache(p))
    known = {output.name: output.older for output in OUTPUTS}
    strangers = [s for n in names for s in (known[n].strangers(folder / n) if n in known else [n])]
    if strangers:
        more = f" and {len(strangers) - 1} more" if len(strangers) > 1 else ""
        raise InputError(f"{expected}, found other things in it: {strangers[0]}{more}")
    if names and SOLUTION not in names:
        raise InputError(f"{expected}, found {names[0]} but no {SOLUTION}")
    # First that the folder is one of results at all, then that each export in it is whole.
    for name in sorted(names, key=lambda n: n != SOLUTION):
        known[name].require(folder / name, expected)
