"""The command and its subcommands: parsing, how they end, what they print and log."""

import json
import logging
import os
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from pancam_graph import RenderOptions, SimulationOptions, __version__, write_traverse
from pancam_graph.base.errors import InputError
from pancam_graph.cli import Progress, main
from pancam_graph.cli._drive_options import drive_options
from pancam_graph.cli._ending import status_of
from pancam_graph.cli._log import logged
from pancam_graph.cli._main import parse
from pancam_graph.cli._parser import degrees
from pancam_graph.cli._progress import Event, JsonLines, PlainLines
from pancam_graph.cli._registry import COMMANDS
from pancam_graph.io import rig_json
from support import io_samples
from support.parameters import slow_but_for

Captured = pytest.CaptureFixture[str]


def program(*words: str, **others: object) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    command = [sys.executable, "-m", "pancam_graph", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, **others)  # type: ignore[call-overload,no-any-return]  # handed on


def test_version_and_help(capsys: Captured) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"pancam-graph {__version__}\n"
    assert main(["--help"]) == 0
    listed = capsys.readouterr().out
    for name, command in COMMANDS.items():
        assert re.search(rf"^ +{name}\b", listed, flags=re.MULTILINE)
        assert command.summary in " ".join(listed.split())  # whatever the width of the terminal
        assert main([name, "--help"]) == 0
        assert capsys.readouterr().out.startswith(f"usage: pancam-graph {name} ")


def test_python_m_is_the_command() -> None:
    done = program("--version")
    assert (done.returncode, done.stdout) == (0, f"pancam-graph {__version__}\n")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            [],
            "expected a subcommand (refine, init, check, terrain, register, convert, simulate, render, "
            "drive, completion), found none",
        ),
        (["refin"], "found 'refin'; is 'refine' meant?"),
        (["--vers"], "expected one of its options, found --vers; is '--version' meant?"),
        (["simulate", "--out", "a"], "expected one of its options, found --out"),
        (["terrain", "a", "--cell", "0"], "argument --cell: expected a number above 0, found '0'"),
        (["--versoin"], "expected one of its options, found --versoin; is '--version' meant?"),
        (["refine", "F", "--moddel", "mast"], "found --moddel; is '--model' meant?"),
        (["refine", "F", "--out", "o", "more"], "expected no more arguments, found 'more'"),
        (["refine", "--out", "o"], "FOLDER"),
        (["refine", "F", "--out", "o", "--model", "ring"], "'ring'"),
        (["refine", "F", "--out", "o", "--export", "colmop"], "expected one of colmap, cahvor, rig, gis; found 'colmop'; is 'colmap' meant?"),  # noqa: E501  the whole sentence
        (["drive", "page.html", "--rig", "mer-navcan"], "found 'mer-navcan'; is 'mer-navcam' meant?"),
        (["refine", "F", "--out", "o", "--quiet", "--verbose"], "expected --verbose or --quiet, found both"),
    ],
)  # fmt: skip
def test_a_wrong_command_line_is_one_sentence(words: list[str], says: str, capsys: Captured) -> None:
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert says in err
    assert err.endswith("(--help explains)\n")


@pytest.mark.parametrize(
    "words",
    [
        ["F", "--out", "o", "--export", "colmap", "cahvor"],
        ["--export", "colmap", "cahvor", "F", "--out", "o"],
        ["--export", "colmap", "F", "--export=cahvor", "--out", "o"],
        ["--export=colmap", "cahvor", "--out", "o", "F"],
    ],
)
def test_several_exports_in_one_option_or_in_several(words: list[str]) -> None:
    arguments = parse(COMMANDS["refine"], words, "pancam-graph refine")
    assert arguments.export == ["colmap", "cahvor"]
    assert arguments.folder == Path("F")


@pytest.mark.parametrize(
    "words",
    [
        ["F", "--out", "o", "--sharing", "mounts=eye", "radius=all", "--stop", "max_iterations=3"],
        ["--stop", "max_iterations=3", "--sharing", "mounts=eye", "radius=all", "F", "--out", "o"],
        ["--sharing=mounts=eye", "radius=all", "--out", "o", "--stop=max_iterations=3", "F"],
        ["--sharing", "mounts=eye", "--sharing", "radius=all", "--out", "o", "--stop=max_iterations=3", "F"],
    ],
)
def test_a_list_of_assignments_ends_before_the_folder(words: list[str]) -> None:
    arguments = parse(COMMANDS["refine"], words, "pancam-graph refine")
    assert (arguments.sharing, arguments.stop) == (["mounts=eye", "radius=all"], ["max_iterations=3"])
    assert arguments.folder == Path("F")


def test_defaults_of_the_command_line_are_those_of_the_options() -> None:
    simulate = parse(COMMANDS["simulate"], ["OUT"], "x")
    assert drive_options(simulate, SimulationOptions) == SimulationOptions()
    render = parse(COMMANDS["render"], ["--out", "OUT"], "x")
    assert drive_options(render, RenderOptions) == RenderOptions()
    # What help says in degrees where the option holds radians.
    assert round(57.29577951308232 * SimulationOptions().sigma_stop_rad, 2) == 0.57
    assert SimulationOptions().sweep_rad == degrees("360")


@pytest.mark.parametrize(
    ("script", "name"),
    [
        ("optimize_traverse.py", "refine"),
        ("simulate_traverse.py", "simulate"),
        ("render_traverse.py", "render"),
        ("drive.py", "drive"),
    ],
)
def test_scripts_have_the_help_of_the_subcommands(
    scripts_folder: Path, script: str, name: str, capsys: Captured
) -> None:
    command = [sys.executable, str(scripts_folder / script)]
    done = subprocess.run([*command, "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert main([name, "--help"]) == 0
    # Where lines break depends on the length of the program's name.
    ours = capsys.readouterr().out.replace(f"pancam-graph {name}", script, 1)
    assert done.stdout.split() == ours.split()
    wrong = subprocess.run([*command, "--nonsense"], capture_output=True, text=True, check=False)
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1)


def test_how_programs_end(capsys: Captured) -> None:
    def raises(error: BaseException) -> int:
        def work() -> int:
            raise error

        return status_of(work)

    assert status_of(lambda: 0) == 0
    assert status_of(lambda: 1) == 1
    assert capsys.readouterr().err == ""
    assert raises(InputError("x: expected this, found that")) == 2
    assert capsys.readouterr().err == "x: expected this, found that\n"
    assert raises(KeyboardInterrupt()) == 130
    assert capsys.readouterr().err == "interrupted; nothing was written\n"
    assert raises(MemoryError("Unable to allocate 7 TiB")) == 2
    assert capsys.readouterr().err == (
        "expected more memory than this machine has left (Unable to allocate 7 TiB); nothing was written\n"
    )
    assert raises(PermissionError(13, "Permission denied", "there")) == 2
    assert capsys.readouterr().err == "[Errno 13] Permission denied: 'there'\n"


def test_a_fault_is_one_sentence_and_a_full_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["pancam-graph", "refine", "a folder"])

    def fault() -> int:
        raise KeyError("two\nlines")

    assert status_of(fault) == 2
    out, err = capsys.readouterr()
    (report,) = tmp_path.iterdir()
    assert out == ""
    assert err == (
        "a fault of the program, not of your input: KeyError: 'two\\nlines'; "
        f"send the full report to its developers: {report}\n"
    )
    text = report.read_text(encoding="utf-8")
    assert f"pancam-graph {__version__}\n" in text
    assert "command: pancam-graph refine 'a folder'\n" in text
    assert re.search(r"^numpy \d", text, flags=re.MULTILINE)
    assert "Traceback (most recent call last)" in text
    assert "in fault" in text


def test_a_fault_without_a_place_for_its_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    assert status_of(lambda: 1 // 0) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "ZeroDivisionError" in err
    assert f"at {Path(__file__).name}:" in err
    assert "no report of it could be written" in err


@pytest.mark.slow
def test_a_fault_in_a_subcommand_is_no_traceback_on_the_terminal(tmp_path: Path) -> None:
    code = (
        "import pancam_graph.simulate as _, sys\n"
        "room = sys.modules['pancam_graph.simulate']\n"
        "room.check_new = lambda out: 1 // 0\n"
        "from pancam_graph.cli import main\n"
        f"sys.exit(main(['simulate', {str(tmp_path / 'made')!r}]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "ZeroDivisionError" in done.stderr
    assert len(list(tmp_path.glob("pancam-graph-fault-*.txt"))) == 1


@pytest.mark.skipif(os.name == "nt", reason="signals and pipes are another thing there")
@pytest.mark.parametrize("sent", ["SIGINT", "SIGTERM", "SIGHUP"])  # by name: Windows has no SIGHUP
def test_a_signal_ends_the_program_after_it_has_cleaned_up(sent: str) -> None:
    code = """
import signal, sys, time
from pancam_graph.cli import run
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background would ignore it
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and one under nohup this
def work():
    try:
        print("ready", flush=True)
        time.sleep(600)
    finally:
        print("cleaned up", flush=True)
run(work)
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(getattr(signal, sent))
        out, err = process.communicate()
    assert (process.returncode, out, err) == (130, "cleaned up\n", "interrupted; nothing was written\n")


def test_an_interrupt_that_c_code_made_an_error_of_is_one(capsys: Captured) -> None:
    """As imports of extension modules do, and callbacks through C++."""

    def work() -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt as interrupt:
            raise ImportError("initialization failed") from interrupt
        return 0

    assert status_of(work) == 130
    assert capsys.readouterr().err == "interrupted; nothing was written\n"


@pytest.mark.skipif(os.name == "nt", reason="signals and pipes are another thing there")
def test_a_hangup_that_nohup_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:

        def work() -> int:
            signal.raise_signal(signal.SIGHUP)
            return 0

        assert status_of(work) == 0
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.skipif(os.name == "nt", reason="signals and pipes are another thing there")
@pytest.mark.parametrize("words", slow_but_for("--help", ["--help", "completion bash"]))
def test_a_reader_who_leaves_early_is_no_error(words: str) -> None:
    command = f"{sys.executable} -m pancam_graph {words} | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.stderr == ""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals and pipes are another thing there")
def test_work_goes_on_where_nobody_reads(tmp_path: Path) -> None:
    words = f"simulate {tmp_path}/made --stops 1 --pans 2 --sweep-deg 45"
    command = f"{sys.executable} -m pancam_graph {words} | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "made" / "traverse.json").exists()
    closed = f"{sys.executable} -m pancam_graph {words.replace('made', 'second')} >&- 2>&-"
    assert subprocess.run(["bash", "-c", closed], check=False).returncode == 0


MAKE = ("--stops", "1", "--pans", "2", "--sweep-deg", "45")


def test_a_log_has_times_and_grows(tmp_path: Path, capsys: Captured) -> None:
    log = tmp_path / "run.log"
    for name in ("first", "second"):
        assert main(["simulate", str(tmp_path / name), *MAKE, "--log", str(log)]) == 0
    assert main(["refine", str(tmp_path / "first"), "--out", str(tmp_path / "out"), "--log", str(log)]) == 0
    assert "DEBUG" not in capsys.readouterr().err  # progress may be there, on a slow machine
    first, *lines = log.read_text(encoding="utf-8").splitlines()
    assert first == "# log of pancam-graph"
    stamped = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} [A-Z]+ [\w.]+: .*")
    assert [line for line in lines if not stamped.fullmatch(line)] == []
    assert len([line for line in lines if f"pancam-graph {__version__}: " in line]) == 3
    assert any("iteration 1: cost" in line for line in lines)
    assert logging.getLogger("pancam_graph").level == logging.NOTSET


def test_a_log_takes_the_place_of_nothing(tmp_path: Path, capsys: Captured) -> None:
    words = ["simulate", str(tmp_path / "made"), *MAKE, "--log"]
    (tmp_path / "thesis.tex").write_text("years of work")
    for place in ("thesis.tex", "no/such/folder", "."):
        assert main([*words, str(tmp_path / place)]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert "expected a new file or an older log of this program" in err
    assert (tmp_path / "thesis.tex").read_text() == "years of work"
    assert main([*words, str(tmp_path / "made" / "log")]) == 2
    assert "expected a log outside" in capsys.readouterr().err
    assert main([*words, str(tmp_path / "made")]) == 2
    assert "expected a log at another place than the results, found the same" in capsys.readouterr().err
    assert not (tmp_path / "made").exists()
    page = str(tmp_path / "page.html")
    assert main(["drive", page, "--stops", "2", "--log", page]) == 2
    assert "found the same" in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize(("place", "says"), [(".", "found a folder"), ("no/page.html", "found no folder")])
def test_a_place_for_no_page_is_told_before_the_drive(
    tmp_path: Path, capsys: Captured, place: str, says: str
) -> None:
    assert main(["drive", str(tmp_path / place), "--stops", "2"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert says in err


def test_a_fault_is_in_the_log_too(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), logged(verbose=False, file=tmp_path / "log"):
        _ = 1 // 0
    text = (tmp_path / "log").read_text()
    assert "Traceback" in text
    assert "ZeroDivisionError" in text


def test_quiet_prints_nothing(tmp_path: Path, capsys: Captured) -> None:
    made, out = str(tmp_path / "made"), str(tmp_path / "out")
    assert main(["simulate", made, *MAKE, "--quiet"]) == 0
    assert main(["refine", made, "--out", out, "--quiet", "--incremental", "--no-report"]) == 0
    assert capsys.readouterr() == ("", "")
    assert (tmp_path / "out" / "solution.json").exists()


def test_verbose_logs_on_standard_error(tmp_path: Path, capsys: Captured) -> None:
    assert main(["simulate", str(tmp_path / "made"), *MAKE]) == 0
    capsys.readouterr()
    words = ["--out", str(tmp_path / "out"), "--no-report", "--incremental", "--verbose"]
    assert main(["refine", str(tmp_path / "made"), *words]) == 0
    assert re.search(r"^INFO +.*: cost ", capsys.readouterr().err, flags=re.MULTILINE)


def test_progress_as_json(tmp_path: Path, capsys: Captured) -> None:
    made = str(tmp_path / "made")
    assert main(["simulate", made, "--stops", "3", "--pans", "2", "--sweep-deg", "45", "--quiet"]) == 0
    words = ["refine", made, "--out", str(tmp_path / "out"), "--no-report", "--progress", "json"]
    assert main([*words, "--incremental"]) == 0
    out, err = capsys.readouterr()
    assert "converged" in out
    events = [json.loads(line) for line in err.splitlines()]
    keys = ["stage", "done", "total", "seconds_left", "per_second"]
    assert all(list(event) == keys for event in events)
    assert events[0] == {**dict.fromkeys(keys), "stage": f"reading {made}"}
    stops = [e for e in events if e["stage"] == "adding stops"]
    assert [(e["done"], e["total"]) for e in stops] == [(1, 3), (2, 3), (3, 3)]
    assert stops[0]["seconds_left"] is None
    assert stops[1]["seconds_left"] >= 0
    assert stops[2]["seconds_left"] == 0
    assert events[-1]["stage"] == "writing the results"
    assert main(words) == 0
    stages = [json.loads(line)["stage"] for line in capsys.readouterr().err.splitlines()]
    assert {"looking for outliers", "adjusting to the end"} <= set(stages)


def test_time_left_is_at_the_pace_of_the_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Event] = []

    @dataclass
    class Kept(JsonLines):
        def show(self, event: Event) -> None:
            shown.append(event)

    now_s = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    progress = Progress(Kept())
    for done, passing_s in ((4, 0.0), (5, 3.0), (7, 3.0), (10, 3.0)):
        now_s[0] += passing_s
        progress.counted("matching", done, 10)
    progress.counted("masks", 1, 2)
    assert [e.seconds_left for e in shown] == pytest.approx([None, 15.0, 6.0, 0.0, None])
    assert [e.per_second for e in shown] == pytest.approx([None, 1 / 3, 1 / 2, 2 / 3, None])
    assert [e.pace for e in shown[:2]] == ["", ", 0.33 a second, about 15 s left"]
    assert [e.text for e in shown[:2]] == ["matching 4 of 10", "matching 5 of 10"]


def test_plain_lines_come_while_one_step_gives_no_event(capsys: Captured) -> None:
    progress = Progress(PlainLines(period_s=0.01))
    text = ""
    with progress.shown("compiling"):
        while text.count("\n") < 3:
            text += capsys.readouterr().err
        progress.counted("matching", 2, 9)
        while "matching" not in text:
            text += capsys.readouterr().err
    assert re.match(r"compiling \(0 s since the beginning\)\n", text)
    assert re.search(r"^matching 2 of 9 \(0 s since the beginning\)$", text, flags=re.MULTILINE)
    assert "pancam-graph-progress" not in [t.name for t in threading.enumerate()]


def test_short_work_has_no_plain_lines(capsys: Captured) -> None:
    with Progress(PlainLines(period_s=600)).shown("compiling"):
        pass
    assert capsys.readouterr().err == ""


def test_a_rig_of_another_run_is_read_before_anything_is_solved(tmp_path: Path, capsys: Captured) -> None:
    write_traverse(io_samples.traverse(), tmp_path / "in")
    words = ["refine", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--use-rig"]
    assert main([*words, str(tmp_path / "rig.json")]) == 2
    assert "rig.json: expected a file, found nothing there" in capsys.readouterr().err
    failed = rig_json(io_samples.traverse().rig, name="first", passed=False)
    (tmp_path / "rig.json").write_bytes(failed)
    assert main([*words, str(tmp_path / "rig.json")]) == 2
    assert "expected the rig of a solution that passed its tests" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
