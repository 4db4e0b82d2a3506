"""Compiled code on disk: no place for it, damaged or foreign files, and several processes at once."""

import importlib.util
import itertools
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from types import ModuleType

import pytest

from pancam_graph.base import by_numba, kept_code
from pancam_graph.base.compiled import is_on_disk
from support.parameters import slow_for
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
print(plus(3.0, 2.0), minus(3.0, 2.0), sum(f.n_found for f in (plus, minus)))
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
    return sum(f.n_found for f in (loops.plus, loops.minus))


def swap(folder: Path) -> None:
    """Exchange the files of two functions."""
    one, other = sorted(folder.glob("*.native"))
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)


def change(how: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def changed(folder: Path) -> None:
        for path in folder.glob("*.native"):
            path.write_bytes(how(path.read_bytes()))

    return changed


def signed(rest: bytes) -> bytes:
    """A file that says of itself that it is whole."""
    return sha256(rest).digest() + rest


def of_another_processor(content: bytes) -> bytes:
    """The same code with a label that names another processor, and a digest that is right."""
    length = int.from_bytes(content[32:36])
    label = json.loads(content[36 : 36 + length]) | {"environment": "another"}
    written = json.dumps(label).encode()
    return signed(len(written).to_bytes(4) + written + content[36 + length :])


def without_function(content: bytes) -> bytes:
    """A whole file that has no code to call."""
    length = int.from_bytes(content[32:36])
    label = json.loads(content[36 : 36 + length]) | {"sizes": []}
    written = json.dumps(label).encode()
    return signed(len(written).to_bytes(4) + written)


def with_a_strange_need(content: bytes) -> bytes:
    """A whole file whose code calls a function that no library has."""
    length = int.from_bytes(content[32:36])
    label = json.loads(content[36 : 36 + length]) | {"outside": ["no_such_function_anywhere"]}
    written = json.dumps(label).encode()
    return signed(len(written).to_bytes(4) + written + content[36 + length :])


DAMAGES: dict[str, Callable[[Path], None]] = {
    "empty": change(lambda _: b""),
    "cut off": change(lambda content: content[: len(content) // 2]),
    "one byte": change(lambda content: content[:1]),
    "a digest alone": change(lambda content: content[:32]),
    "foreign": change(lambda _: b"a file of somebody else's\n"),
    "foreign, signed": change(lambda _: signed(b"\0\0\0\2[]")),
    "label cut off, signed": change(lambda content: signed(content[32:60])),
    "a bit": change(lambda c: c[:-40] + bytes([c[-40] ^ 4]) + c[-39:]),
    "a bit of the label": change(lambda c: c[:50] + bytes([c[50] ^ 4]) + c[51:]),
    "exchanged": swap,
    "another processor": change(of_another_processor),
    "no function": change(without_function),
    "a strange need": change(with_a_strange_need),
}
SILENT = {"exchanged", "another processor"}
"""Whole files, but of something else."""
LOOKS_RIGHT = {"no function", "a strange need"}
"""Whole files of the right label: that they are of no use shows when they are linked."""


@pytest.mark.parametrize(
    "damage",
    slow_for(
        ["one byte", "foreign", "a digest alone", "another processor", "label cut off, signed"], DAMAGES
    ),
)
def test_damaged_files_are_made_anew(damage: str, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert (hits(folder), hits(folder)) == (0, 2)
    DAMAGES[damage](folder / "__pycache__")
    assert is_on_disk(loaded(folder).plus) == (damage in LOOKS_RIGHT)
    assert hits(folder) == 0
    said = caplog.text.count("compiled code that cannot be read is made anew")
    assert said == (0 if damage in SILENT else 1)  # once for all
    assert hits(folder) == 2


def test_what_lies_where_code_should_be_is_no_fault(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert hits(folder) == 0
    for path in (folder / "__pycache__").glob("*.native"):
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
        for path in folder.glob("__pycache__/*.native"):
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


def test_a_folder_can_be_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder / "chosen"))
    assert (hits(folder), hits(folder)) == (0, 2)
    assert len(list((folder / "chosen").glob("*.native"))) == 2
    assert not (folder / "__pycache__").exists() or not list((folder / "__pycache__").glob("*.native"))


def test_code_beside_the_source_is_found_where_nothing_can_be_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a container that was built with compiled code."""
    assert hits(folder) == 0
    monkeypatch.setattr(kept_code, "_is_writable", lambda _: False)
    assert hits(folder) == 2


def test_what_numba_alone_can_call_is_called_by_numba(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Where its insides are others than those that are known here: slower, and said once."""

    def other(*_: object) -> None:
        raise AttributeError("no such attribute")

    monkeypatch.setattr(by_numba, "_outside", other)
    assert (hits(folder), hits(folder)) == (0, 0)
    assert caplog.text.count("cannot be called without Numba (AttributeError: no such attribute)") == 1
    assert not list(folder.rglob("*.native"))
