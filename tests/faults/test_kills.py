"""A writer that is killed at any step: what it wrote to is whole, and nothing stays beside it."""

import json
import signal
from pathlib import Path

import pytest

from pancam_graph.base.whole_files import recover, whole_folder
from pancam_graph.cli import main
from pancam_graph.results import write_results
from support.kills import BYSTANDERS, CACHE, FULL, KEPT, NEW, OLD, killed_at_every_step
from support.made_solutions import fabricate
from support.parameters import slow_but_for

SENT = [signal.SIGKILL, signal.SIGTERM]


@pytest.mark.parametrize("sent", slow_but_for([signal.SIGKILL], SENT))
def test_a_folder_is_whole_old_or_whole_new_whenever_its_writer_is_killed(
    sent: signal.Signals, tmp_path: Path
) -> None:
    runs = killed_at_every_step("folder in place of an older one", sent, tmp_path)
    assert len(runs) > 30
    states = [run.out for run in runs]
    assert [s for s in states if s not in ({**OLD, **KEPT}, {**NEW, **KEPT})] == []
    first_new = states.index({**NEW, **KEPT})
    assert 10 < first_new < len(runs)
    assert all(s == {**NEW, **KEPT} for s in states[first_new:])  # once there, it stays
    assert all(run.beside == BYSTANDERS for run in runs)
    assert all(run.again == {**NEW, **KEPT} for run in runs)
    assert {run.status for run in runs[:-1]} <= {-sent if sent == signal.SIGKILL else 130}


def test_a_new_folder_is_whole_or_not_there(tmp_path: Path) -> None:
    runs = killed_at_every_step("new folder", signal.SIGKILL, tmp_path)
    assert [run.out for run in runs if run.out not in ({}, NEW)] == []
    assert all(run.beside == BYSTANDERS for run in runs)
    assert all(run.again == NEW for run in runs)


def test_a_file_is_whole_old_or_whole_new_and_leaves_nothing_for_the_next(tmp_path: Path) -> None:
    for sent in SENT:
        (tmp_path / sent.name).mkdir()
        runs = killed_at_every_step("file", sent, tmp_path / sent.name)
        assert {run.out["a"] for run in runs} == {"old", "new"}
        assert all(run.again == {**OLD, **KEPT, "a": "new"} for run in runs)


def test_a_recovery_that_is_killed_is_done_by_the_next(tmp_path: Path) -> None:
    runs = killed_at_every_step("recovery", signal.SIGKILL, tmp_path)
    assert len(runs) > 20
    assert all(run.out == {**OLD, **KEPT} for run in runs)
    assert all(run.beside == BYSTANDERS for run in runs)


@pytest.mark.slow
@pytest.mark.parametrize("sent", [*SENT, FULL])
def test_results_are_whole_old_or_whole_new_whenever_their_writer_is_killed(
    sent: int, tmp_path: Path
) -> None:
    """A folder of results with an export and a cache, which stays in any case."""
    runs = killed_at_every_step("results", sent, tmp_path)
    assert len(runs) > 40
    assert runs[-1].status == 0
    older, newer = runs[0].out, runs[-1].out
    assert older["residuals.npz"] != newer["residuals.npz"]
    assert sorted(newer) == sorted([*older, *(name for name in newer if name.startswith("cahvor/"))])
    for run in runs:
        whole = older if run.out["residuals.npz"] == older["residuals.npz"] else newer
        assert sorted(run.out) == sorted(whole)
        assert {k: v for k, v in run.out.items() if k in CACHE} == CACHE
        assert json.loads(run.out["solution.json"])["format"] == "pancam-graph/solution"
        assert {k: v for k, v in run.out.items() if k.endswith((".csv", ".ply", ".cahvor"))} == {
            k: v for k, v in whole.items() if k.endswith((".csv", ".ply", ".cahvor"))
        }
        assert run.beside == BYSTANDERS
        assert sorted(run.again) == sorted(newer)


def test_check_restores_what_a_killed_run_moved_aside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    write_results(fabricate(points=40, pans=2), out, report=False)
    out.rename(tmp_path / ".out.01234567.older")
    (tmp_path / ".out.01234567.partial").mkdir()
    assert main(["check", str(out)]) == 2  # results without a verdict
    assert "verdict: expected the tests of a solution" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_what_a_living_writer_writes_stays(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with whole_folder(out) as first:
        (first / "a").write_text("first")
        recover(out)
        with whole_folder(out) as second:
            (second / "a").write_text("second")
        assert (first / "a").read_text() == "first"
        assert (out / "a").read_text() == "second"
    assert (out / "a").read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_older_results_whose_place_was_taken_get_a_name(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out = tmp_path / "out"
    for name in (".out.01234567.older", ".out.01234567.partial", "out"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text(name)
    recover(out)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "out.older-01234567"]
    assert (out / "a").read_text() == "out"
    assert (tmp_path / "out.older-01234567" / "a").read_text() == ".out.01234567.older"
    assert "out.older-01234567" in caplog.text


def test_names_as_long_as_they_may_be(tmp_path: Path) -> None:
    for name in ("n" * 255, "\N{EURO SIGN}" * 85):
        with whole_folder(tmp_path / name) as partial:
            (partial / "a").write_text("")
    assert len(list(tmp_path.iterdir())) == 2
