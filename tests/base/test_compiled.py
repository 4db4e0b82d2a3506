"""Compiled code on disk: found again as long as no source file of its folder changes."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pancam_graph
from pancam_graph import SimulationOptions, simulate, solve
from pancam_graph.base.compiled import Entry, folder_digest
from pancam_graph.cameras import LENS_SOURCES
from pancam_graph.landmarks import kernel
from pancam_graph.rigs import mer_navcam

CALLEE = """
from pancam_graph.base.compiled import part

@part
def times(x):
    return {factor} * x
"""
CALLER = """
from pancam_graph.base.compiled import entry, is_on_disk
from loops.callee import times

@entry
def plus_one(x):
    return times(x) + 1.0
"""
PROGRAM = """
from loops.caller import is_on_disk, plus_one

before = is_on_disk(plus_one)
print(before, plus_one(10.0), plus_one.n_found, is_on_disk(plus_one))
"""


@pytest.mark.skipif(bool(os.environ.get("NUMBA_DISABLE_JIT")), reason="nothing is compiled")
@pytest.mark.slow
def test_an_edit_of_a_part_makes_its_callers_on_disk_stale(tmp_path: Path) -> None:
    """In fresh processes: the caller's own file stays as it is, to the time it was written at."""
    folder = tmp_path / "loops"
    folder.mkdir()
    for name, text in (("__init__", ""), ("callee", CALLEE.format(factor=2.0)), ("caller", CALLER)):
        (folder / f"{name}.py").write_text(text)

    def run() -> list[str]:
        path = os.pathsep.join([str(tmp_path), *sys.path])
        environment = {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path / "disk")}
        ended = subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
        )
        return ended.stdout.split()

    assert run() == ["False", "21.0", "0", "True"]
    assert run() == ["True", "21.0", "1", "True"]
    (folder / "callee.py").write_text(CALLEE.format(factor=3.0))
    assert run() == ["False", "31.0", "0", "True"]
    assert run() == ["True", "31.0", "1", "True"]


def test_a_digest_sees_the_names_and_contents_of_all_source_files_of_a_folder(tmp_path: Path) -> None:
    digests = []
    for name, text in (("a", "x = 1"), ("b", "y = 1"), ("b", "y = 2"), ("a", "x = 1y = 2"), ("c", "")):
        (tmp_path / f"{name}.py").write_text(text)
        digests.append(folder_digest.__wrapped__(tmp_path))
    assert len(set(digests)) == len(digests)
    (tmp_path / "notes.txt").write_text("no source")
    assert folder_digest.__wrapped__(tmp_path) == digests[-1]


def test_nothing_must_be_compiled_where_compilation_is_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel._eliminate, "eliminate_poses", lambda: None)
    assert not kernel.must_compile()


@pytest.mark.skipif(bool(os.environ.get("NUMBA_DISABLE_JIT")), reason="nothing is compiled")
def test_loops_on_disk_are_named_after_the_sources_of_lenses_too() -> None:
    """An edit of a lens, whose distortion they call, makes them stale."""
    entries = [f for f in vars(kernel).values() if isinstance(f, Entry)]
    assert len(entries) > 10
    digest = folder_digest(LENS_SOURCES)
    assert (LENS_SOURCES / "_cahvore.py").exists()
    assert all(digest in entry.sources for entry in entries)


def test_every_entry_point_returns_what_can_be_handed_on_without_numba() -> None:
    """Of any other result, such as a tuple, code is not kept, and each process would compile it anew."""
    decorated = re.compile(r"@(?:\w+\.)?entry\ndef (\w+)\(.*?\) -> (.+?):\n", re.DOTALL)
    returned = {
        f"{path.name}: {name}": kind
        for path in Path(pancam_graph.__file__).parent.rglob("*.py")
        for name, kind in decorated.findall(path.read_text(encoding="utf-8"))
    }
    assert len(returned) > 20
    assert {name: kind for name, kind in returned.items() if kind not in {"None", "int", "float"}} == {}


@pytest.mark.skipif(bool(os.environ.get("NUMBA_DISABLE_JIT")), reason="nothing is compiled")
def test_the_loops_of_a_solve_are_called_without_numba() -> None:
    made = simulate(mer_navcam(), SimulationOptions(stops=2, pans=3, points_per_image=12), seed=1)
    solve(made.traverse)
    modules = [module for name, module in sys.modules.items() if name.startswith("pancam_graph.")]
    entries = {value for module in modules for value in vars(module).values() if isinstance(value, Entry)}
    assert len([entry for entry in entries if entry.signatures]) > 5
    assert [entry for entry in entries if entry._dispatcher is not None] == []
