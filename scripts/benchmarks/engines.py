"""Engines of the benchmark: whether each can run here, and the processes in which they are measured."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.cases import Files

__all__ = [
    "ENGINES",
    "Engine",
    "Measured",
    "NotRun",
    "Setting",
    "ceres_program",
    "measure",
    "run_module",
    "solve_first_ever",
]

THREADS = 2
"""Threads of Ceres and COLMAP. This package takes as many as BLAS and its own solver choose."""

_RUNS = 3
"""Whole processes of which the fastest counts."""
_SLOWS_BLAS = ("OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE")
"""Environment variables that slow OpenBLAS; they are removed for every engine."""
_SCRIPTS = Path(__file__).resolve().parents[1]
_CERES_HEADER = "ceres/ceres.h"
_INCLUDE = (Path("/usr/include"), Path("/usr/local/include"))
_EIGEN = "eigen3"


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Time, memory and result of an engine on one case."""

    seconds: tuple[float, ...]
    """Wall-clock seconds of each warm solve alone."""
    iterations: int
    cost_final: float
    """Half the sum of squared whitened residuals, priors included."""
    memory_mb: float
    """Peak of the process that read the problem and solved it once, megabytes."""
    rms_px: float | None = None
    first_s: float | None = None
    """Seconds of the first solve of a process, with preparation and loading of compiled code."""
    initialise_s: float | None = None
    """Seconds of preparation before a warm solve: triangulation and what `seconds` does not count."""
    read_s: float | None = None
    process_s: float | None = None
    """Seconds of a whole process as a user starts it, with reading and results; the fastest of some."""
    detail: str = ""

    @property
    def best_s(self) -> float:
        """The fastest solve."""
        return min(self.seconds)

    @property
    def median_s(self) -> float:
        """The middle solve, of an even number the slower of two."""
        return sorted(self.seconds)[len(self.seconds) // 2]


@dataclass(frozen=True, kw_only=True)
class NotRun:
    """The reason why an engine has no figures for a case."""

    reason: str
    failed: bool
    """True if the engine ran and failed; False if it is not installed or was not asked for."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """Programs, folders and variables for the processes of the engines."""

    ceres: Path | NotRun
    """The compiled Ceres program."""
    numba_cache: Path
    """Folder of compiled code, a subfolder per engine; empty before the first solve ever."""
    environment: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))
    """Environment variables of the starting process."""

    def child_environment(self, engine: str) -> dict[str, str]:
        """Environment variables for the processes of an engine."""
        kept = {k: v for k, v in self.environment.items() if k not in _SLOWS_BLAS}
        paths = [str(_SCRIPTS), *filter(None, [kept.get("PYTHONPATH")])]
        return {
            **kept,
            "PYTHONPATH": os.pathsep.join(paths),
            "NUMBA_CACHE_DIR": str(self.numba_cache / engine),
        }


@dataclass(frozen=True, kw_only=True)
class Engine:
    """One way to solve."""

    name: str
    title: str
    """Name in the table."""
    command: Callable[[Files, Setting, int], list[str] | NotRun]
    """Makes the command (module of this package, arguments) of a case, a setting and a number of repeats."""
    process: Callable[[Files, Path], list[str]] | None = None
    """Makes the arguments of the package's command for a case and a folder of results; None: not measured, or
    the module that solves measures it."""
    compiles: bool = False
    """Whether its first solve ever compiles code that later ones load from disk."""
    same_problem: bool = True
    """Whether its final cost must be that of the others."""


def _ours(landmarks: str) -> Callable[[Files, Setting, int], list[str] | NotRun]:
    def command(files: Files, setting: Setting, repeats: int) -> list[str] | NotRun:
        return [
            "benchmarks.solve_with_us",
            str(files.traverse),
            f"--landmarks={landmarks}",
            f"--rig={files.rig}",
            f"--repeats={repeats}",
        ]

    return command


def _refine(files: Files, out: Path) -> list[str]:
    options = ["--loss", "none", "--no-report", "--rig", files.rig, "--quiet"]
    return ["pancam_graph", "refine", str(files.traverse), "--out", str(out), *options]


def _ceres(files: Files, setting: Setting, repeats: int) -> list[str] | NotRun:
    if isinstance(setting.ceres, NotRun):
        return setting.ceres
    options = ["--solvers", "dense", "sparse", "iterative", f"--threads={THREADS}", f"--repeats={repeats}"]
    options += [f"--rig={files.rig}"]
    return ["benchmarks.solve_with_ceres", str(setting.ceres), str(files.peer), *options]


def _pycolmap(files: Files, setting: Setting, repeats: int) -> list[str] | NotRun:
    if importlib.util.find_spec("pycolmap") is None:
        return NotRun(reason="pycolmap is not installed (pip install 'pancam-graph[bench]')", failed=False)
    options = ["--solvers", "auto", "SPARSE_SCHUR", f"--threads={THREADS}", f"--repeats={repeats}"]
    return ["benchmarks.solve_with_pycolmap", str(files.traverse), str(files.start_m), *options]


ENGINES = {
    engine.name: engine
    for engine in (
        Engine(
            name="eliminated",
            title="pancam_graph",
            command=_ours("eliminated"),
            process=_refine,
            compiles=True,
        ),
        Engine(
            name="explicit",
            title="pancam_graph, explicit landmarks",
            command=_ours("explicit"),
            compiles=True,
        ),
        Engine(name="ceres", title="Ceres, C++", command=_ceres),
        Engine(name="pycolmap", title="COLMAP, rig", command=_pycolmap, same_problem=False),
    )
}
"""The engines by name."""


def measure(engine: Engine, files: Files, setting: Setting, repeats: int) -> Measured | NotRun:
    """Solve a case in a new process."""
    command = engine.command(files, setting, repeats)
    if isinstance(command, NotRun):
        return command
    figures = run_module(command, setting.child_environment(engine.name))
    if isinstance(figures, NotRun):
        return figures
    measured = Measured(**{**figures, "seconds": tuple(figures["seconds"])})
    if engine.process is None:
        return measured
    environment, seconds = setting.child_environment(engine.name), []
    for _ in range(_RUNS):
        run_s = _process_s(engine.process, files, environment)
        if isinstance(run_s, NotRun):
            return run_s
        seconds.append(run_s)
    return replace(measured, process_s=min(seconds))


def _process_s(
    command: Callable[[Files, Path], list[str]], files: Files, environment: dict[str, str]
) -> float | NotRun:
    """Seconds from the start to the end of the command in a new process, with its results in a new folder."""
    with tempfile.TemporaryDirectory(prefix="pancam-graph-benchmark-") as folder:
        begin = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-m", *command(files, Path(folder) / "out")],
            env=environment,
            text=True,
            capture_output=True,
            check=False,
        )
        seconds = time.perf_counter() - begin
    if done.returncode != 0:
        lines = (done.stderr.strip() or done.stdout.strip()).splitlines() or ["no message"]
        return NotRun(reason=f"refine: {lines[-1]} (status {done.returncode})", failed=True)
    return seconds


def solve_first_ever(engine: Engine, files: Files, setting: Setting) -> float | NotRun:
    """Seconds of the very first solve: nothing compiled yet. Leaves the compiled code behind.

    Raises ValueError where the cache of compiled code is not empty.
    """
    cache = setting.numba_cache / engine.name
    if cache.exists() and any(cache.iterdir()):
        raise ValueError(f"{cache}: expected an empty folder for compiled code, found files")
    measured = measure(engine, files, setting, 1)
    if isinstance(measured, NotRun):
        return measured
    return measured.first_s if measured.first_s is not None else NotRun(reason="not measured", failed=False)


def run_module(command: list[str], environment: dict[str, str]) -> dict[str, Any] | NotRun:
    """JSON that a module of this package prints when it runs with its arguments in a new process."""
    done = subprocess.run(
        [sys.executable, "-m", *command],
        env=environment,
        text=True,
        capture_output=True,
        check=False,
    )
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["no message"]
        return NotRun(reason=f"{lines[-1]} (status {done.returncode})", failed=True)
    result: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return result


def ceres_program(given: Path | None, source: Path | None, folder: Path) -> Path | NotRun:
    """Path of the Ceres program, given or compiled from `source` into `folder`; else why there is none."""
    if given is not None:
        if given.is_file() and os.access(given, os.X_OK):
            return given.resolve()
        return NotRun(reason=f"{given}: expected a program, found none", failed=True)
    if source is None or not source.is_file():
        return NotRun(
            reason="no source of the Ceres program beside the repository; see --ceres", failed=False
        )
    compiler = shutil.which("g++")
    if compiler is None:
        return NotRun(reason="no g++ to compile the Ceres program with; see --ceres", failed=False)
    include = next((i for i in _INCLUDE if (i / _CERES_HEADER).is_file()), None)
    if include is None:
        return NotRun(reason="the headers of Ceres Solver are not installed; see --ceres", failed=False)
    program = folder / source.stem
    folder.mkdir(parents=True, exist_ok=True)
    flags = ["-O3", "-march=native", f"-I{include}", f"-I{include / _EIGEN}"]
    command = [compiler, *flags, str(source), "-o", str(program), "-lceres", "-lglog"]
    done = subprocess.run(command, text=True, capture_output=True, check=False)
    if done.returncode != 0:
        first = next((line for line in done.stderr.splitlines() if "error" in line), "no message")
        return NotRun(reason=f"{source.name} does not compile: {first}", failed=True)
    return program
