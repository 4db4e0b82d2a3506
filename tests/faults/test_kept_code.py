"""Compiled code on disk: no place for it, damaged or foreign files, and several processes at once."""

import importlib.util
import itertools
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numba
import pytest

from pancam_graph.base import kept_code
from pancam_graph.base.compiled import is_on_disk
from support.permissions import run_bound, sealed

pytestmark = pytest.mark.skipif(bool(os.environ.get("NUMBA_DISABLE_JIT")), reason="nothing is compiled")

LOOPS = """
from pancam_graph.base.compiled import entry

@entry
def plus(x, y):
    return x + y

@entry
def minus(x, y):
    return x - y
"""
PROGRAM = """
import logging
logging.basicConfig(format="%(message)s")
from loops import minus, plus
print(plus(3.0, 2.0), minus(3.0, 2.0), sum(f.stats.cache_hits.total() for f in (plus, minus)))
"""
_NAMES = map("loops_{}".format, itertools.count())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with compiled functions that may keep their code beside them."""
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "loops.py").write_text(LOOPS)
    return tmp_path / "package"


@pytest.fixture(autouse=True)
def _each_test_is_told() -> Iterator[None]:
    """Forget what was said once to this process, before and after."""
    for _ in range(2):
        for said in (kept_code._say_lost, kept_code._say_folder_damaged, kept_code._temporary_folder):
            said.cache_clear()
        yield
        return


def loaded(folder: Path) -> ModuleType:
    """The functions as a new process would have them."""
    spec = importlib.util.spec_from_file_location(next(_NAMES), folder / "loops.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def hits(folder: Path) -> int:
    """How many functions of a new process were found on disk; they give what they should in any case."""
    loops = loaded(folder)
    assert (loops.plus(3.0, 2.0), loops.minus(3.0, 2.0)) == (5.0, 1.0)
    return sum(f.stats.cache_hits.total() for f in (loops.plus, loops.minus))


def swap(folder: Path, ending: str) -> None:
    """Exchange the files of two functions."""
    one, other = sorted(folder.glob(f"*{ending}"))
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)


def change(how: Callable[[bytes], bytes]) -> Callable[[Path, str], None]:
    def changed(folder: Path, ending: str) -> None:
        for path in folder.glob(f"*{ending}"):
            path.write_bytes(how(path.read_bytes()))

    return changed


DAMAGES: dict[str, Callable[[Path, str], None]] = {
    "empty": change(lambda _: b""),
    "cut off": change(lambda content: content[: len(content) // 2]),
    "one byte": change(lambda content: content[:1]),
    "foreign": change(lambda _: b"a file of somebody else's\n"),
    "foreign pickle": change(lambda _: b"\x80\x04]."),
    "a bit": change(lambda c: c[:-40] + bytes([c[-40] ^ 4]) + c[-39:]),
    "exchanged": swap,
}


@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_made_anew(
    damage: str, ending: str, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert (hits(folder), hits(folder)) == (0, 2)
    DAMAGES[damage](folder / "__pycache__", ending)
    assert not is_on_disk(loaded(folder).plus) or ending == ".nbc" or damage in {"a bit", "exchanged"}
    assert hits(folder) in ({0, 2} if damage == "a bit" and ending == ".nbi" else {0})
    said = caplog.text.count("compiled code that cannot be read is made anew")
    assert said == 1 or (damage in {"a bit", "exchanged", "foreign pickle"} and said == 0)  # once for all
    assert hits(folder) == 2


def test_what_lies_where_code_should_be_is_no_fault(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert hits(folder) == 0
    for path in (folder / "__pycache__").glob("*.nb?"):
        path.unlink()
        (path / "full").mkdir(parents=True)
    assert hits(folder) == 0
    assert caplog.text.count("compiled code cannot be written to") == 1


@pytest.mark.slow
def test_no_place_beside_the_source_nor_at_home(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "temporary").mkdir()
    sealed(folder, tmp_path / "home")
    ours = tmp_path / "temporary" / f"pancam-graph-{os.getuid()}"
    variables = {
        "PYTHONPATH": os.pathsep.join([str(folder), *sys.path]),
        "HOME": str(tmp_path / "home"),
        "XDG_CACHE_HOME": str(tmp_path / "home" / "cache"),
        "NUMBA_CACHE_DIR": "",
        "TMPDIR": str(tmp_path / "temporary"),
    }
    for found in (0, 2):
        done = run_bound(sys.executable, "-c", PROGRAM, **variables)
        assert done.stdout == f"5.0 1.0 {found}\n", done.stderr
        assert done.stderr == f"compiled code is kept in {ours}: no other folder for it can be written to\n"
    assert ours.stat().st_mode & 0o777 == 0o700
    ours.chmod(0o777)  # others could have put code there
    done = run_bound(sys.executable, "-c", PROGRAM, **variables)
    assert done.stdout == "5.0 1.0 0\n", done.stderr
    assert done.stderr.count("\n") == 1
    assert "has no folder that is the user's alone" in done.stderr


@pytest.mark.slow
def test_several_processes_at_once(folder: Path) -> None:
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    for _ in range(3):
        for path in folder.glob("__pycache__/*.nb?"):
            path.unlink()
        running = [
            subprocess.Popen(
                [sys.executable, "-c", PROGRAM], env=variables, stdout=subprocess.PIPE, text=True
            )
            for _ in range(4)
        ]
        assert {process.communicate()[0][:8] for process in running} == {"5.0 1.0 "}
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM], env=variables, stdout=subprocess.PIPE, check=True
        )
        assert done.stdout == b"5.0 1.0 2\n"


def test_numbas_own_choice_of_folder_is_as_it_was(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(folder / "chosen"), raising=False)
    assert hits(folder) == 0
    assert list((folder / "chosen").rglob("*.nbi"))
    assert not (folder / "__pycache__").exists() or not list((folder / "__pycache__").glob("*.nbi"))
