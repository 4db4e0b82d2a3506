"""The public names of the package, and what an import of them loads."""

import ast
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import pancam_graph
from pancam_graph.rigs import mer_navcam

PUBLIC = {
    "CrossValidation",
    "Frame",
    "Freedom",
    "Image",
    "Observations",
    "PancamGraphError",
    "RenderOptions",
    "Rendering",
    "Sharing",
    "SimulationOptions",
    "SmootherOptions",
    "Solution",
    "SolveOptions",
    "Stop",
    "StopRule",
    "Traverse",
    "TraverseSmoother",
    "build_graph",
    "cross_validate",
    "find_observations",
    "graph_keys",
    "read_input",
    "read_pds",
    "read_traverse",
    "render",
    "simulate",
    "solve",
    "write_cameras",
    "write_colmap",
    "write_rendering",
    "write_report",
    "write_results",
    "write_traverse",
}
HEAVY = {"cv2", "gtsam", "llvmlite", "numba", "numpy", "plotly", "pvl", "pydantic", "rich", "scipy", "shtab"}


def python(code: str) -> list[str]:
    """What a fresh interpreter prints, as words."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def loaded_by(code: str) -> set[str]:
    """Modules that a fresh interpreter has after running some code."""
    return set(python(f"import sys\n{code}\nprint('MODULES', *sys.modules)"))


def test_the_public_names_are_these() -> None:
    assert set(pancam_graph.__all__) == PUBLIC
    assert len(pancam_graph.__all__) == len(PUBLIC)
    assert set(dir(pancam_graph)) >= PUBLIC


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_a_public_name_is_a_class_or_a_function_of_its_own(name: str) -> None:
    value = getattr(pancam_graph, name)
    assert callable(value)
    assert not isinstance(value, ModuleType)
    assert value.__name__ == name


def test_type_checkers_see_the_same_names_from_the_same_rooms() -> None:
    tree = ast.parse(Path(pancam_graph.__file__).read_text(encoding="utf-8"))
    (block,) = [n for n in tree.body if isinstance(n, ast.If)]
    seen = {
        alias.asname: str(line.module)
        for line in block.body
        if isinstance(line, ast.ImportFrom)
        for alias in line.names
    }
    assert seen == {name: f"pancam_graph.{room}" for name, room in pancam_graph._ROOM_OF.items()}


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'pancam_graph' has no attribute 'unsolve'"):
        _ = pancam_graph.unsolve
    with pytest.raises(ImportError, match="unsolve"):
        exec("from pancam_graph import unsolve")


def test_everything_can_be_imported_at_once() -> None:
    names: dict[str, object] = {}
    exec("from pancam_graph import *", names)
    assert set(names) >= PUBLIC


_BEFORE = (
    "",
    "import pancam_graph.{name}",
    "import pancam_graph.{name}.{module}",
    "from pancam_graph.{name} import {name}",
    "import importlib; importlib.import_module('pancam_graph.{name}')",
    "import pancam_graph; pancam_graph.{name}",
    "from pancam_graph import {name}; import pancam_graph.{name}.{module}; import pancam_graph.{name}",
    "import pancam_graph; from pancam_graph.{name} import {module}",
    "import pancam_graph.cli; import pancam_graph.results; import pancam_graph.smoother",
)
"""What was imported first."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "module", "before"),
    [
        *(("solve", "_options", before) for before in _BEFORE),
        *(("simulate", "_simulation_options", before) for before in _BEFORE[:3]),
    ],
)
def test_no_room_hides_the_function_of_its_name(name: str, module: str, before: str) -> None:
    code = f"""
{before.format(name=name, module=module)}
import pancam_graph, sys
from pancam_graph import {name}
from pancam_graph.{name} import {name} as same
assert {name} is same is pancam_graph.{name}
assert callable({name}) and {name}.__name__ == "{name}"
room = sys.modules["pancam_graph.{name}"]
import pancam_graph.{name}.{module}
assert pancam_graph.{name} is {name}
assert sys.modules["pancam_graph.{name}"] is room and room.{name} is {name}
"""
    python(code)


def test_the_package_alone_loads_no_room_and_no_library() -> None:
    loaded = loaded_by("import pancam_graph")
    assert {m for m in loaded if m.startswith("pancam_graph")} == {"pancam_graph"}
    assert loaded & HEAVY == set()
    assert len(loaded) < 120


@pytest.mark.parametrize("words", [["--help"], ["refin"], ["refine", "--help"], ["render", "-h"]])
def test_help_loads_no_library(words: list[str]) -> None:
    loaded = loaded_by(f"from pancam_graph.cli import main\nmain({words})")
    assert loaded & HEAVY == set()
    assert {m.split(".")[1] for m in loaded if m.startswith("pancam_graph.")} == {"base", "cli"}


KERNEL = {"gtsam", "numpy", "scipy"}
"""What the adjustment cannot do without; of SciPy only its top, whose parts load when they are called."""


@pytest.mark.parametrize(
    ("name", "libraries", "rooms"),
    [
        pytest.param(
            "solve",
            KERNEL,
            {"base", "cameras", "data", "elimination", "factors", "graph", "initialise", "landmarks", "rigs"}
            | {"solve"},
            marks=pytest.mark.slow,
        ),
        (
            "read_traverse",
            KERNEL | {"pydantic"},
            {"base", "cameras", "data", "elimination", "io", "landmarks", "rigs"},
        ),
    ],
)
def test_a_public_name_loads_what_it_needs_and_no_more(
    name: str, libraries: set[str], rooms: set[str]
) -> None:
    loaded = loaded_by(f"from pancam_graph import {name}")
    assert loaded & HEAVY == libraries
    assert {m.split(".")[1] for m in loaded if m.startswith("pancam_graph.")} <= rooms
    parts = {m.split(".")[1] for m in loaded if m.startswith("scipy.")}
    assert not parts & {"fft", "interpolate", "linalg", "ndimage", "optimize", "sparse", "spatial", "special"}


@pytest.mark.slow
@pytest.mark.skipif(bool(os.environ.get("NUMBA_DISABLE_JIT")), reason="nothing is compiled")
def test_a_solve_of_observations_loads_nothing_for_pictures_reports_or_compiling(tmp_path: Path) -> None:
    """A whole command, whose loops were compiled before."""
    options = pancam_graph.SimulationOptions(stops=1, pans=7, points_per_image=15)
    pancam_graph.write_traverse(
        pancam_graph.simulate(mer_navcam(), options, seed=2).traverse, tmp_path / "in"
    )
    words = ["refine", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--no-report"]
    code = f"""
from pancam_graph.cli import main
assert main({words}) == 0
"""
    python(code)  # compiles what is not on disk
    loaded = loaded_by(code)
    assert loaded & {"cv2", "numba", "plotly", "pvl", "rich", "shtab"} == set()
    rooms = {m.split(".")[1] for m in loaded if m.startswith("pancam_graph.")}
    assert not rooms & {"mosaic", "report", "simulate", "smoother"}
    parts = {m.split(".")[1] for m in loaded if m.startswith("scipy.")}
    assert not parts & {"fft", "interpolate", "ndimage", "optimize", "spatial", "stats"}
    code = f"""
from pancam_graph import SolveOptions, read_traverse, solve
solve(read_traverse({str(tmp_path / "in")!r}), SolveOptions(loss="none"))
"""
    python(code)
    # Extension modules of `scipy.linalg` are loaded without it, with the rig estimated too.
    assert not loaded_by(code) & {"scipy.linalg", "scipy.sparse", "scipy.special"}


def test_the_collector_looks_at_nothing_that_a_command_imports() -> None:
    """In a process of its own; where the work is called from a program that has begun, that decides."""
    code = """
import gc, sys
from pancam_graph.cli._collector import loading
with loading():
    print(gc.isenabled())
print(gc.isenabled(), gc.get_freeze_count() > 0)
gc.unfreeze()
sys.modules["gtsam"] = sys
with loading():
    print(gc.isenabled())
print(gc.isenabled(), gc.get_freeze_count())
"""
    assert python(code) == ["False", "True", "True", "True", "True", "0"]
