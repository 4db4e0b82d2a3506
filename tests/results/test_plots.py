"""Figures of the report as pictures: what is needed is asked for before anything is solved or written."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pancam_graph import Solution, solve
from pancam_graph.base.errors import InputError
from pancam_graph.results import check_plots, write_plots
from support.pictures import read_picture
from support.small_drives import simulated


def with_fakes(monkeypatch: pytest.MonkeyPatch, browser: str | None, failed: tuple[Exception, ...]) -> None:
    def draw(wanted: list[dict[str, Any]]) -> tuple[Exception, ...]:
        for one in wanted:
            Path(one["path"]).write_bytes(b"drawn")
        return failed

    chromium = SimpleNamespace(find_browser=lambda *, skip_local: browser)
    monkeypatch.setitem(sys.modules, "choreographer.browsers.chromium", SimpleNamespace(Chromium=chromium))
    monkeypatch.setitem(sys.modules, "kaleido", SimpleNamespace(write_fig_from_object_sync=draw))


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve(simulated(3, 1).traverse)


def test_without_the_extra_or_a_browser_one_sentence_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with_fakes(monkeypatch, None, ())
    with pytest.raises(InputError, match=r"^plots: expected Chrome or Chromium .* found none$"):
        check_plots(tmp_path / "p")
    monkeypatch.setitem(sys.modules, "kaleido", None)  # an import of it fails
    with pytest.raises(InputError, match=r"kaleido, found none: pip install 'pancam-graph\[plots\]'"):
        check_plots(tmp_path / "p")


def test_a_folder_of_somebody_else_is_refused_before_the_solve(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with_fakes(monkeypatch, "chromium", ())
    (tmp_path / "theirs.txt").write_text("theirs")
    with pytest.raises(InputError, match="expected a new folder or one of an older export"):
        check_plots(tmp_path)
    check_plots(tmp_path / "new")


def test_each_figure_has_its_caption_and_failures_leave_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, solution: Solution
) -> None:
    with_fakes(monkeypatch, "chromium", ())
    for _ in range(2):  # an older export is replaced
        write_plots(solution, tmp_path / "p")
    about = json.loads((tmp_path / "p" / "export.json").read_text())
    assert {"scene", "map", "histogram", "corrections", "lens-0"} <= about["captions"].keys()
    drawn = {f"{name}.{ending}" for name in about["captions"] for ending in ("svg", "png")}
    assert drawn < set(about["files"])
    assert "stops.csv" in about["files"]
    with_fakes(monkeypatch, "chromium", (RuntimeError("no\nway"),))
    with pytest.raises(InputError, match="plots: expected a browser that draws, found: no way"):
        write_plots(solution, tmp_path / "q")
    assert not (tmp_path / "q").exists()


@pytest.mark.slow
def test_a_browser_draws_them(tmp_path: Path, solution: Solution) -> None:
    pytest.importorskip("kaleido", reason="the extra plots is not installed")
    try:
        check_plots(tmp_path / "p")
    except InputError as error:
        pytest.skip(str(error))
    write_plots(solution, tmp_path / "p")
    for name in ("scene", "map", "corrections"):
        picture = read_picture(tmp_path / "p" / f"{name}.png")
        assert picture.shape[:2] == (1240, 2000)
        assert picture.std() > 5  # not an empty page
        assert "<svg" in (tmp_path / "p" / f"{name}.svg").read_text(encoding="utf-8")[:200]
