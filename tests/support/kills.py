"""A process that is killed at each step of what it does to the file system, one step after the other.

Run as a program of its own, which has one thread and may fork: `kills.py WORK SIGNAL FOLDER`. Each child does
the work in a folder of its own and gets the signal before or after its n-th call of `STEPS`, or finds the
disk full there if the signal is 0; the last comes to its end. Then the parent starts as the next run does,
and prints what is there, a line of JSON for each.
"""

import errno
import io
import itertools
import json
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from pancam_graph.base.whole_files import recover, whole_file, whole_folder

__all__ = ["BYSTANDERS", "CACHE", "FULL", "KEPT", "NEW", "OLD", "Left", "killed_at_every_step"]

STEPS = {os: ("rename", "replace", "mkdir", "unlink", "rmdir", "open", "close"), io: ("open",)}
"""Functions by module; a write without its renaming is what "after open" leaves."""
NEW, OLD, KEPT = {"a": "new", "b/c": "new"}, {"a": "old", "b/c": "old", "d": "old"}, {"cache/x": "kept"}
CACHE = {"cache/cache.json": '{"format": "pancam-graph/cache", "version": 1}', "cache/x": "kept"}
BYSTANDERS = {
    "thesis.tex": "mine",
    ".out.partial/x": "mine",
    ".out.0123.partial": "mine",
    ".other.01234567.partial/x": "",
}
"""Files of others beside the place, with names nearly like those that are cleared away."""


@dataclass(frozen=True, kw_only=True)
class Left:
    """What a process left, once the next has begun."""

    status: int
    """How it ended: below 0 killed, 130 after a signal or a full disk, 0 if it met none."""
    out: dict[str, str]
    """Files at the place where it writes."""
    beside: dict[str, str]
    """Files beside it."""
    again: dict[str, str]
    """Files at the place after the next has done the same."""


FULL = 0
"""In place of a signal: the step fails, as on a full disk."""


def killed_at_every_step(work: str, sent: int, folder: Path) -> list[Left]:
    """What is left by a process that does some work of `WORK` and gets a signal, for each of its steps."""
    program = [sys.executable, __file__, work, str(int(sent)), str(folder)]
    done = subprocess.run(
        program,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return [Left(**json.loads(line)) for line in done.stdout.splitlines()]


def _write_folder(out: Path) -> None:
    with whole_folder(out, keep="cache") as partial:
        _fill(partial, NEW)


def _write_file(out: Path) -> None:
    whole_file(out / "a", b"new")


def _recover(out: Path) -> None:
    recover(out, keep="cache")


def _write_results(out: Path) -> None:
    from pancam_graph.results import write_results
    from support.made_solutions import fabricate

    write_results(fabricate(points=40, pans=2), out, report=False, exports=("cahvor",))


def _prepare_results(out: Path) -> None:
    from pancam_graph.results import write_results
    from support.made_solutions import fabricate

    write_results(fabricate(points=40, pans=2, seed=1), out, report=False)
    _fill(out, CACHE)


def _prepare_older(out: Path) -> None:
    _fill(out, {**OLD, **KEPT})


def _prepare_new(out: Path) -> None:
    out.parent.mkdir()


def _prepare_killed(out: Path) -> None:
    """A folder whose writer was killed between the renamings, after the cache had moved."""
    _fill(out.with_name(".out.0badcafe.older"), OLD)
    _fill(out.with_name(".out.0badcafe.partial"), {**NEW, **KEPT})
    out.with_name(".out.0badcafe.lock").touch()


WORK: dict[str, tuple[Callable[[Path], None], Callable[[Path], None]]] = {
    "folder in place of an older one": (_prepare_older, _write_folder),
    "new folder": (_prepare_new, _write_folder),
    "file": (_prepare_older, _write_file),
    "recovery": (_prepare_killed, _recover),
    "results": (_prepare_results, _write_results),
}
"""What is there before, and what is done."""


def _fill(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def _files(folder: Path) -> dict[str, str]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_text(encoding="latin-1") for path in files}


def _patch(waiting: int, sent: int) -> list[bool]:
    """Send this process a signal, or fail, at its step of the number `waiting`.

    The list that is returned gets an entry then.
    """
    steps, struck = itertools.count(), list[bool]()

    def hit() -> None:
        struck.append(True)
        if sent == FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.kill(os.getpid(), sent)

    def watched(call: Callable[..., Any]) -> Callable[..., Any]:
        def with_steps(*args: Any, **others: Any) -> Any:
            if next(steps) == waiting:
                hit()
            result = call(*args, **others)
            if next(steps) == waiting:
                hit()
            return result

        return with_steps

    for module, names in STEPS.items():
        for name in names:
            setattr(module, name, watched(getattr(module, name)))
    return struck


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


def _child(work: Callable[[Path], None], out: Path, waiting: int, sent: int) -> NoReturn:
    signal.signal(signal.SIGTERM, _interrupt)  # as the command does
    struck = _patch(waiting, sent)
    status = 0
    try:
        work(out)
    except BaseException:
        if not struck:
            traceback.print_exc()
            status = 1
    finally:
        os._exit(130 if struck else status)


def _runs(work: str, sent: int, folder: Path) -> Iterator[Left]:
    prepare, do = WORK[work]
    for waiting in itertools.count():
        out = folder / str(waiting) / "out"
        prepare(out)
        _fill(out.parent, BYSTANDERS)
        child = os.fork()
        if child == 0:
            _child(do, out, waiting, sent)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        recover(out, keep="cache")
        left, beside = _files(out), _files(out.parent)
        do(out)
        rest = {k: v for k, v in beside.items() if not k.startswith("out/")}
        yield Left(status=status, out=left, beside=rest, again=_files(out))
        if status in {0, 1}:
            return


if __name__ == "__main__":
    for run in _runs(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])):
        print(json.dumps(vars(run)))
