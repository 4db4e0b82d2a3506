"""Hostile names: read, solved, shown and written, they do nothing but stand there."""

import csv
import io
import json
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import pytest

from pancam_graph import read_traverse, write_traverse
from pancam_graph.cameras import CAHV
from pancam_graph.cli import main
from pancam_graph.cli._log import logged
from pancam_graph.cli._progress import Progress, TerminalLine
from pancam_graph.cli._summary import print_summary
from pancam_graph.data import Solution, Traverse
from pancam_graph.io import read_cahvor
from pancam_graph.results import write_results
from support.made_solutions import fabricate

NO_TEXT = "caf\udce9"
"""As Python reads the name of a file that is no text. A log that pytest keeps must have none."""
PRINTING = [
    "site [/3] A",
    "[bold red]x",
    "[link=http://x]a[/link]",
    ":boom:",
    "=1+1",
    "@SUM(A1)",
    "</script>",
]
"""Names that a traverse.json may have."""
CONTROLS = ["\x1b]0;owned\x07", "\x1b[2J", "a\nb", "\u202egnp", "\x9b2J", NO_TEXT, "\x00", "\u2028"]
"""Names that only the API lets in."""


class TerminalText(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@contextmanager
def terminals() -> Iterator[tuple[TerminalText, TerminalText]]:
    """Standard output and standard error, both of them terminals without styles."""
    out, err = TerminalText(), TerminalText()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TERM", "dumb")
        patch.setenv("COLUMNS", "200")
        with redirect_stdout(out), redirect_stderr(err):
            yield out, err


def renamed(name: str) -> Solution:
    """A solution in which everything has the name, a number added where names must differ."""
    return fabricate(ids=lambda old: f"{name}{old}", points=40, stops=2, pans=2)


def as_folder(traverse: Traverse, folder: Path) -> Path:
    write_traverse(traverse, folder)
    return folder


@pytest.mark.parametrize("name", PRINTING + CONTROLS)
def test_a_summary_shows_names_as_they_are(name: str) -> None:
    solution = replace(renamed(name), warnings=(f"image {name} is left out",), stop_reason=name)
    with terminals() as (out, err):
        print_summary(solution, f"/tmp/{name}")
        shown = out.getvalue()
        print_summary(solution, f"/tmp/{name}", quiet=True)
    escaped = name if name in PRINTING else repr(name)[1:-1]
    for line in (
        f"{escaped}test traverse",
        f"warning image {escaped} is left out",
        f"results in /tmp/{escaped}",
    ):
        assert line in shown
    assert all(c.isprintable() or c == "\n" for c in shown)
    assert err.getvalue() == f"warning: image {escaped} is left out\n"


@pytest.mark.parametrize("name", PRINTING + [n for n in CONTROLS if n != NO_TEXT])
def test_logs_and_progress_show_names_as_they_are(name: str, tmp_path: Path) -> None:
    with terminals() as (_, err), logged(verbose=True, file=tmp_path / "log"):
        logging.getLogger("pancam_graph.test").info("stop %s", name)
        with Progress(TerminalLine()).shown(f"reading {name}"):
            pass
    escaped = name if name in PRINTING else repr(name)[1:-1]
    assert f"stop {escaped}" in err.getvalue()
    text = (tmp_path / "log").read_text(encoding="utf-8")
    assert f"stop {escaped}\n" in text
    for shown in (err.getvalue(), text):
        assert all(c.isprintable() or c == "\n" for c in shown)


@pytest.mark.parametrize("name", [*PRINTING, *(n for n in CONTROLS if n != NO_TEXT)])
def test_results_hold_any_name_that_is_text(name: str, tmp_path: Path) -> None:
    solution = renamed(name)
    write_results(solution, tmp_path / "out", report=False, csv=True, exports=("cahvor",))
    with (tmp_path / "out" / "residuals.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(solution.used)
    assert not [r for r in rows if r["image"].startswith(("=", "+", "-", "@"))]
    assert {float(r["final_du_px"]) < 0 for r in rows} == {True, False}  # numbers stay numbers
    written = json.loads((tmp_path / "out" / "solution.json").read_text(encoding="utf-8"))
    assert [s["id"] for s in written["stops"]] == [s.id for s in solution.traverse.stops]
    cameras = sorted((tmp_path / "out" / "cahvor").glob("*.cahvor"))
    assert len(cameras) == len(solution.traverse.images)
    assert all(isinstance(read_cahvor(path), CAHV) for path in cameras)


@pytest.mark.skipif(sys.platform == "darwin", reason="its file systems have text names alone")
def test_a_folder_whose_name_is_no_text_is_read_and_its_results_are_written(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    write_traverse(renamed("x").traverse, folder)
    path = folder / "traverse.json"
    data = json.loads(path.read_text(encoding="utf-8"))
    del data["name"]
    path.write_text(json.dumps(data), encoding="utf-8")
    traverse = read_traverse(folder)
    assert traverse.name == r"caf\udce9"
    out = folder.with_name(f"{folder.name} out")
    write_results(replace(renamed("x"), traverse=traverse), out)
    assert r"Adjustment of caf\udce9" in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", PRINTING[:2])
def test_a_run_on_a_terminal_ends_well(name: str, tmp_path: Path) -> None:
    folder = as_folder(renamed(name).traverse, tmp_path / "in")
    with terminals() as (out, _):
        assert main(["refine", str(folder), "--out", str(tmp_path / "out"), "--no-report"]) == 0
    assert f"{name}test traverse" in out.getvalue()


def test_a_warning_of_thousands_of_characters_is_shortened(capsys: pytest.CaptureFixture[str]) -> None:
    print_summary(replace(renamed("x"), warnings=(f"image {'n' * 5000} is left out",)), "out")
    line = capsys.readouterr().err
    assert line.startswith("warning: image nnn")
    assert line.endswith("nnn is left out\n")
    assert len(line) < 200


def test_an_rms_that_is_undefined_at_the_start_is_said_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    solution = fabricate(points=40, pans=2)
    undefined = solution.residual_initial_px.copy()
    undefined[solution.used.argmax()] = float("nan")
    print_summary(replace(solution, residual_initial_px=undefined), "out")
    out = capsys.readouterr().out
    assert "nan" not in out
    assert " px (at the start undefined) over " in out
