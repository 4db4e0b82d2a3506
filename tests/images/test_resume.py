"""The program with images: what it keeps in OUT/cache, an interrupt, and going on after it."""

import io
import json
import os
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pancam_graph import write_traverse
from pancam_graph.images import _steps
from pancam_graph.images._match_pair import PairMatches, match_pair
from support.image_scenes import make_traverse

Run = Callable[..., tuple[int, str, str]]
ARGUMENTS = ("traverse", "--out", "out", "--no-report")


@pytest.fixture
def run(scripts_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """The program within this process, in a folder with a traverse of four images."""
    (tmp_path / "traverse").mkdir()
    truth, _ = make_traverse(tmp_path / "traverse", pans_deg=(0.0, 20.0))
    write_traverse(truth, tmp_path / "traverse")
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", [str(scripts_folder / "optimize_traverse.py"), *arguments])
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as ended:
            runpy.run_path(sys.argv[0], run_name="__main__")
        assert isinstance(ended.value.code, int)
        return ended.value.code, out.getvalue(), err.getvalue()

    return call


def results(out: Path) -> dict[str, object]:
    content = json.loads((out / "solution.json").read_text())
    del content["seconds"]
    return {**content, "residuals": (out / "residuals.npz").read_bytes()}


@pytest.fixture
def calls() -> list[int]:
    """One for each pair of images that was matched."""
    return []


@pytest.fixture
def gone_on(run: Run, calls: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The results of a command that was interrupted at the third pair and given again."""
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "1")  # which pairs are done by then is counted

    def interrupted(*arguments: Any) -> PairMatches:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return match_pair(*arguments)

    monkeypatch.setattr(_steps, "match_pair", interrupted)
    status, out, err = run(*ARGUMENTS)
    cache = Path("out") / "cache"
    assert (status, out) == (130, "")
    assert err == (
        "interrupted; no results were written; what was found in the images so far is in "
        f"{cache}: run the same command again to go on from there\n"
    )
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["cache"]
    kept = {p.name for p in cache.glob("features-*")} | {p.name for p in cache.glob("matches-*")}
    assert len(kept) == 4 + 2
    assert run(*ARGUMENTS)[0] == 0
    pairs = len(list(cache.glob("matches-*")))
    assert len(calls) == 3 + pairs - 2
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "cache",
        "points.ply",
        "residuals.npz",
        "solution.json",
        "stereo.npz",
    ]
    return tmp_path / "out"


@pytest.mark.slow
def test_an_interrupt_is_one_line_and_the_same_command_goes_on(gone_on: Path) -> None:
    assert json.loads((gone_on / "solution.json").read_text())["converged"]


@pytest.mark.slow
def test_the_cache_outlives_results_which_are_those_without_it(
    run: Run, gone_on: Path, calls: list[int], tmp_path: Path
) -> None:
    first = results(gone_on)
    before = len(calls)
    assert run(*ARGUMENTS)[0] == 0
    assert len(calls) == before
    assert results(gone_on) == first
    assert run("traverse", "--out", "fresh", "--no-report")[0] == 0
    assert results(tmp_path / "fresh") == first


def test_an_interrupt_before_anything_is_kept_says_so(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(_steps, "read_pictures", interrupted)
    assert run(*ARGUMENTS) == (130, "", "interrupted; nothing was written\n")
    assert not Path("out").exists()


@pytest.mark.slow
def test_bad_input_that_shows_late_leaves_nothing_behind_that_was_not_there(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "traverse" / "traverse.json"
    good = path.read_text()
    content = json.loads(good)
    for k, frame in enumerate(content["frames"]):
        frame["tilt_rad"] = 0.4 * (1 - 2 * k)  # no frame overlaps another, and the eyes look apart
    content["rig"]["cameras"][1]["head_T_camera"]["rotation_wxyz"] = [1.0, 0.0, 0.0, 0.0]
    path.write_text(json.dumps(content))
    status, _, err = run(*ARGUMENTS)
    assert (status, err.count("\n")) == (2, 1)
    assert "found none" in err
    assert not (tmp_path / "out").exists()
    path.write_text(good)
    assert run(*ARGUMENTS)[0] == 0
    before = {p.name: p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file()}
    path.write_text(json.dumps(content))
    assert run(*ARGUMENTS)[0] == 2
    after = {p.name: p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file()}
    assert before.items() <= after.items()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is another thing there")
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_a_process_of_its_own(scripts_folder: Path, tmp_path: Path, sent: signal.Signals) -> None:
    (tmp_path / "traverse").mkdir()
    pans = tuple(np.linspace(-80, 80, 9))
    truth, _ = make_traverse(tmp_path / "traverse", pans_deg=pans)
    write_traverse(truth, tmp_path / "traverse")
    command = [sys.executable, str(scripts_folder / "optimize_traverse.py"), *ARGUMENTS]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    cache = tmp_path / "out" / "cache"
    while process.poll() is None and not list(cache.glob("matches-*")):
        time.sleep(0.02)
    process.send_signal(sent)
    _, err = process.communicate()
    assert process.returncode == 130
    assert "run the same command again to go on from there" in err
    assert "Traceback" not in err
    kept = {p.name: p.stat().st_mtime_ns for p in cache.glob("features-*")}
    assert len(kept) == len(truth.images)
    assert subprocess.run(command, cwd=tmp_path, check=False, capture_output=True).returncode == 0
    assert {p.name: p.stat().st_mtime_ns for p in cache.glob("features-*")} == kept
