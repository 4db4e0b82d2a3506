"""Limits of the system: a full disk, small files, few open files, folders that may only be read."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pancam_graph import write_traverse
from pancam_graph.cli import main
from support.kills import BYSTANDERS, FULL, KEPT, NEW, OLD, killed_at_every_step
from support.made_solutions import fabricate
from support.permissions import run_bound, sealed

FILES = ["points.ply", "report.html", "residuals.npz", "solution.json"]
RESULTS = """
import json, os, resource, sys
from pathlib import Path
from pancam_graph.base.errors import InputError
from pancam_graph.results import write_results
from support.made_solutions import fabricate

out, kind = Path(sys.argv[1]), getattr(resource, sys.argv[2])
solution = fabricate(points=60, pans=2)

def contents():
    return {p.name: p.read_bytes() for p in out.iterdir()}

write_results(fabricate(points=30, pans=2, seed=1), out)
older, (soft, hard) = contents(), resource.getrlimit(kind)
for limit in map(int, sys.argv[3:]):
    resource.setrlimit(kind, (limit, hard))
    try:
        write_results(solution, out)
    except InputError as error:
        said = str(error)
    else:
        said = ""
    finally:
        resource.setrlimit(kind, (soft, hard))
    beside = [p.name for p in out.parent.iterdir()]
    left = {"is_older": contents() == older, "files": sorted(contents()), "beside": beside}
    print(json.dumps({"said": said, **left}))
"""


def results_under(kind: str, limits: list[int], out: Path) -> list[dict[str, object]]:
    """What writing results over older ones says and leaves under each of some limits."""
    words = [sys.executable, "-c", RESULTS, str(out), kind, *map(str, limits)]
    path = os.pathsep.join(sys.path)
    done = subprocess.run(
        words, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True, check=True
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_folder_is_whole_old_or_whole_new_wherever_the_disk_is_full(tmp_path: Path) -> None:
    runs = killed_at_every_step("folder in place of an older one", FULL, tmp_path)
    assert [run.out for run in runs if run.out not in ({**OLD, **KEPT}, {**NEW, **KEPT})] == []
    assert all(run.beside == BYSTANDERS for run in runs)
    assert all(run.again == {**NEW, **KEPT} for run in runs)


def test_a_file_is_whole_old_or_whole_new_wherever_the_disk_is_full(tmp_path: Path) -> None:
    runs = killed_at_every_step("file", FULL, tmp_path)
    assert {run.out["a"] for run in runs} == {"old", "new"}
    assert all(run.again == {**OLD, **KEPT, "a": "new"} for run in runs)


@pytest.mark.slow
def test_results_that_are_too_large_leave_the_older_ones(tmp_path: Path) -> None:
    """Sizes at which each of the files is the one that does not fit; under the last all fit."""
    out = tmp_path / "out"
    *short, enough = results_under("RLIMIT_FSIZE", [0, 1000, 10_000, 10**8], out)
    for run in short:
        assert str(run["said"]).startswith(f"{out}: expected a place where results can be written, found: ")
        assert "File too large" in str(run["said"])
        assert run["is_older"]
    assert (enough["said"], enough["is_older"]) == ("", False)
    assert enough["files"] == FILES
    assert enough["beside"] == ["out"]


@pytest.mark.slow
def test_results_with_few_open_files_are_whole_or_the_older_ones(tmp_path: Path) -> None:
    *runs, enough = results_under("RLIMIT_NOFILE", [*range(3, 12), 256], tmp_path / "out")
    assert runs[0]["said"]
    is_older = True
    for run in runs:
        is_older = is_older and bool(run["said"])
        assert run["is_older"] == is_older
        assert run["files"] == FILES
        assert not run["said"] or "Too many open files" in str(run["said"])
    assert (enough["said"], enough["files"], enough["beside"]) == ("", FILES, ["out"])


def test_a_log_that_is_full_does_not_end_the_work(tmp_path: Path) -> None:
    write_traverse(fabricate(points=60, pans=2).traverse, tmp_path / "in")
    code = """
import resource, sys
from pancam_graph.cli import main
from pancam_graph.cli._log import logged
import logging
with logged(verbose=False, file=__import__("pathlib").Path(sys.argv[1])):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, hard))
    for _ in range(100):
        logging.getLogger("pancam_graph.test").info("a line of the log")
print("went on")
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "log")], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "went on\n")
    assert done.stderr == f"warning: {tmp_path / 'log'}: the log is not whole: [Errno 27] File too large\n"
    assert (tmp_path / "log").stat().st_size == 200


def test_a_folder_that_may_only_be_read_is_said_before_anything_is_done(tmp_path: Path) -> None:
    write_traverse(fabricate(points=60, pans=2).traverse, tmp_path / "in")
    (tmp_path / "place").mkdir()
    sealed(tmp_path / "place")
    out = tmp_path / "place" / "out"
    done = run_bound(sys.executable, "-m", "pancam_graph", "refine", str(tmp_path / "in"), "--out", str(out))
    assert (done.returncode, done.stdout) == (2, "")
    expected = f"{out}: expected a new folder or one of older results"
    assert done.stderr == f"{expected}, found no permission to write in {out.parent}\n"


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["drive", str(tmp_path / "none" / "page.html"), "--stops", "2", "--quiet"]) == 2
    assert "page.html" in capsys.readouterr().err
