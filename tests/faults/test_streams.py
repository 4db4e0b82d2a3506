"""Streams that are closed, full, or of any encoding: the work is done all the same."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pancam_graph import SimulationOptions, simulate, write_traverse
from pancam_graph.rigs import mer_navcam
from support.parameters import slow_for

pytestmark = pytest.mark.skipif(os.name == "nt", reason="streams are another thing there")

NAMES = "Šárka 火星 [/3] \N{WHITE SMILING FACE}"
WORK = f"""
import sys
from pathlib import Path
from pancam_graph.cli import run
from pancam_graph.cli._streams import write
def work():
    for _ in range(2000):
        write("stdout", {NAMES!a})
        write("stderr", {NAMES!a})
    with open(sys.argv[1], "w") as file:  # gets the lowest number that is free
        print({NAMES!a})
        Path(sys.argv[1] + ".number").write_text(str(file.fileno()))
    return int(sys.argv[2])
run(work)
"""
CLOSED = [">&-", "2>&-", ">&- 2>&-", ">&- 2>&- <&-", ">/dev/full", "2>/dev/full", ">/dev/full 2>/dev/full"]
ENCODINGS = ["ascii:strict", "latin-1", "cp1252:strict", "utf-16"]


def run(command: str, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """A command of the shell, in which $PYTHON is this interpreter."""
    variables = {
        k: v for k, v in os.environ.items() if not k.startswith(("LC_", "LANG", "PYTHONIO", "PYTHONUTF8"))
    }
    return subprocess.run(
        ["bash", "-c", command],
        env={**variables, "PYTHON": sys.executable, "PYTHONWARNINGS": "ignore", **environment},
        capture_output=True,
        check=False,
    )


@pytest.mark.parametrize("streams", CLOSED)
def test_the_status_is_that_of_the_work_whatever_streams_take(streams: str, tmp_path: Path) -> None:
    if "/dev/full" in streams and not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    status = len(streams) % 2
    done = run(f'"$PYTHON" -c "$WORK" "{tmp_path}/made" {status} {streams}', WORK=WORK, PYTHONUTF8="1")
    assert done.returncode == status
    assert b"Traceback" not in done.stderr
    assert b"Exception ignored" not in done.stderr
    if streams == ">/dev/full":
        assert done.stderr.count(b"standard output: expected a place that can be written to") == 1
    # No file of results has the number of a stream, to which libraries print.
    assert int((tmp_path / "made.number").read_text()) > 2
    assert (tmp_path / "made").read_text() == ""


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_stream_of_any_encoding_shows_what_it_can(encoding: str, tmp_path: Path) -> None:
    done = run(f'"$PYTHON" -c "$WORK" "{tmp_path}/made" 1', WORK=WORK, PYTHONIOENCODING=encoding)
    assert done.returncode == 1
    assert b"Traceback" not in done.stderr
    codec = encoding.partition(":")[0]
    assert NAMES.encode(codec, "backslashreplace").decode(codec) in done.stdout.decode(codec)


def test_a_locale_without_letters_shows_what_it_can(tmp_path: Path) -> None:
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = run(f'"$PYTHON" -c "$WORK" "{tmp_path}/made" 1', WORK=WORK, **plain)
    assert done.returncode == 1
    assert NAMES.encode("ascii", "backslashreplace") in done.stdout


@pytest.mark.parametrize(
    ("words", "streams"),
    slow_for(
        [("completion bash", ">/dev/full")],
        [("--version", ">&-"), ("--help", ">/dev/full"), ("completion bash", ">/dev/full")],
    ),
)
def test_what_is_only_to_be_shown_fails_where_it_cannot_be(words: str, streams: str) -> None:
    if "/dev/full" in streams and not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    done = run(f'"$PYTHON" -m pancam_graph {words} {streams}')
    assert done.returncode == 2
    assert b"standard output: expected a place that can be written to" in done.stderr
    assert b"Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("streams", [*CLOSED, *ENCODINGS])
def test_a_solve_ends_well_whatever_streams_take(streams: str, tmp_path: Path) -> None:
    small = SimulationOptions(stops=2, pans=2, sweep_rad=0.8, points_per_image=10)
    write_traverse(simulate(mer_navcam(), small, seed=0).traverse, tmp_path / NAMES.replace("/", ""))
    words = f'"{tmp_path}"/* --out "{tmp_path}/out é" --verbose --log "{tmp_path}/log"'
    command = f'"$PYTHON" -m pancam_graph refine {words}'
    done = run(f"{command} {streams}") if streams in CLOSED else run(command, PYTHONIOENCODING=streams)
    assert (done.returncode, b"Traceback" in done.stderr) == (0, False)
    assert (tmp_path / "out é" / "report.html").is_file()
