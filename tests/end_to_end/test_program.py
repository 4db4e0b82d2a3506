"""The programs as users run them: exit status, one sentence for bad input, nothing half-written."""

import io
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pancam_graph import SimulationOptions, simulate, solve, write_traverse
from pancam_graph.cameras import Brown
from pancam_graph.results import read_solution_json, write_results
from pancam_graph.rigs import mer_navcam
from support.parameters import slow_but_for

SMALL = SimulationOptions(stops=2, pans=2, sweep_rad=0.8, points_per_image=10, outliers=0.02)
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def run(scripts_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """A program within this process: to start another one costs seconds of imports."""
    monkeypatch.chdir(tmp_path)

    def call(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        monkeypatch.setattr(sys, "argv", [str(scripts_folder / script), *arguments])
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as ended:
            runpy.run_path(sys.argv[0], run_name="__main__")
        assert isinstance(ended.value.code, int)
        return subprocess.CompletedProcess(sys.argv, ended.value.code, out.getvalue(), err.getvalue())

    return call


@pytest.fixture
def run_apart(scripts_folder: Path, tmp_path: Path) -> Run:
    """A program in a process of its own, as users start it."""

    def call(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, str(scripts_folder / script), *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONWARNINGS": "ignore"},
            text=True,
            capture_output=True,
            check=False,
        )

    return call


@pytest.fixture(scope="module")
def older_results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("older") / "out"
    write_results(solve(simulate(mer_navcam(), SMALL, seed=0).traverse), out, report=False)
    return out


@pytest.fixture
def traverse_folder(tmp_path: Path) -> Path:
    simulation = simulate(mer_navcam(), SMALL, seed=0)
    write_traverse(simulation.traverse, tmp_path / "traverse")
    return tmp_path / "traverse"


def test_solves_and_writes_the_contract(run_apart: Run, traverse_folder: Path, tmp_path: Path) -> None:
    done = run_apart("optimize_traverse.py", "traverse", "--out", "out")
    assert done.returncode == 0, done.stderr
    # Where the kernel is compiled first, and elsewhere on a slow machine, a line says so now and then.
    assert [line for line in done.stderr.splitlines() if not line.endswith("since the beginning)")] == []
    assert done.stdout.count("\n") == 1
    out = tmp_path / "out"
    assert {p.name for p in out.iterdir()} == {"solution.json", "points.ply", "residuals.npz", "report.html"}
    solution = read_solution_json(out / "solution.json")
    assert solution.model == "mast"
    assert solution.landmarks == "eliminated"
    assert solution.method == "joint"
    raw = json.loads((out / "solution.json").read_text())
    n = len(json.loads((traverse_folder / "traverse.json").read_text())["images"])
    assert len(raw["images"]) == n
    assert np.array(raw["stops"][1]["covariance"]).shape == (6, 6)
    assert raw["observations"]["used"] + raw["observations"]["rejected"] > 100
    assert b"property float sigma_m" in (out / "points.ply").read_bytes().split(b"end_header")[0]


@pytest.mark.parametrize("model", slow_but_for("circle", ["circle", "free", "projective"]))
def test_models_and_no_report(run: Run, traverse_folder: Path, tmp_path: Path, model: str) -> None:
    done = run("optimize_traverse.py", "traverse", "--out", "out", "--model", model, "--no-report")
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "out" / "report.html").exists()
    solution = read_solution_json(tmp_path / "out" / "solution.json")
    assert solution.model == model
    if model == "projective":  # the calibration that each matrix holds
        assert [r.image for r in solution.refined] == [i.id for i in solution.images for _ in range(5)]


def test_a_method_other_than_joint_is_taken_and_named(
    run: Run, traverse_folder: Path, tmp_path: Path
) -> None:
    turns = ("--method", "alternation", "--no-report", "--stop", "max_iterations=3")
    done = run("optimize_traverse.py", "traverse", "--out", "out", "--model", "circle", *turns)
    assert done.returncode == 1, done.stderr
    solution = read_solution_json(tmp_path / "out" / "solution.json")
    assert solution.method == "alternation"
    assert solution.stop_reason == "iteration limit of 3"
    done = run("optimize_traverse.py", "traverse", "--out", "other", "--rig", "held", *turns)
    assert done.returncode == 2
    assert done.stderr == (
        "method: expected joint with the model mast as it is, found alternation: "
        "nothing is free that all stops share\n"
    )
    assert not (tmp_path / "other").exists()


def test_cross_validation_is_written_and_said(run: Run, traverse_folder: Path, tmp_path: Path) -> None:
    done = run("optimize_traverse.py", "traverse", "--out", "out", "--cross-validate")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    first, second = done.stdout.splitlines()
    assert first.startswith("converged")
    assert re.fullmatch(
        r"cross-validation: honest sigmas of relative pointing [\d.]+ times the formal ones \(median\); "
        r"image halves under each other's cameras [\d.]+ px, by noise [\d.]+; 10 half solves, [\d.]+ s",
        second,
    )
    entry = read_solution_json(tmp_path / "out" / "solution.json").cross_validation
    assert entry is not None
    assert len(entry.scores) == 10
    assert "<h2>Cross-validation</h2>" in (tmp_path / "out" / "report.html").read_text()


def test_too_few_tracks_to_cross_validate_are_bad_input(run: Run, tmp_path: Path) -> None:
    t = simulate(mer_navcam(), SMALL, seed=0).traverse
    assert t.observations is not None
    few = np.isin(t.observations.track, np.unique(t.observations.track)[:3])
    write_traverse(t.with_observations(t.observations.select(few)), tmp_path / "traverse")
    done = run("optimize_traverse.py", "traverse", "--out", "out", "--cross-validate", "--loss", "none")
    assert done.returncode == 2
    assert done.stderr == "cross-validation: expected 4 used tracks or more to halve, found 3\n"
    assert not (tmp_path / "out").exists()


BAD: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "truncated json": (
        lambda t: shorten(t / "traverse.json"),
        ("traverse.json", "expected JSON"),
    ),
    "unknown template": (
        lambda t: edit(t, rig={"template": "lunokhod"}),
        ("traverse.json", "template", "mer-navcam", "lunokhod"),
    ),
    "no observations file": (
        lambda t: (t / "observations.npz").unlink(),
        ("observations.npz", "expected a file"),
    ),
    "path that leaves": (lambda t: edit(t, observations="../x.npz"), ("observations", "inside", "../x.npz")),
    "no such folder": (lambda t: t.rename(t.with_name("elsewhere")), ("traverse", "expected")),
}


def shorten(file: Path) -> None:
    file.write_text(file.read_text()[:200])


def edit(folder: Path, **entries: object) -> None:
    path = folder / "traverse.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_and_status_2(
    run: Run, traverse_folder: Path, older_results: Path, tmp_path: Path, case: str
) -> None:
    spoil, words = BAD[case]
    shutil.copytree(older_results, tmp_path / "out")
    before = {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir()}
    spoil(traverse_folder)
    done = run("optimize_traverse.py", "traverse", "--out", "out")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in done.stderr
    assert {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir()} == before
    assert {p.name for p in tmp_path.iterdir()} <= {"out", "traverse", "elsewhere"}


def test_out_that_is_not_ours_is_left_alone(run: Run, traverse_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years of work")
    done = run("optimize_traverse.py", "traverse", "--out", "thesis")
    assert done.returncode == 2
    assert "thesis" in done.stderr
    assert [p.name for p in (tmp_path / "thesis").iterdir()] == ["chapter.tex"]


def test_wrong_option_is_one_line(run: Run, traverse_folder: Path) -> None:
    done = run("optimize_traverse.py", "traverse", "--out", "out", "--model", "ring")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "'ring'" in done.stderr


def test_stopping_is_set_and_said(run: Run, traverse_folder: Path, tmp_path: Path) -> None:
    short = ("--loss", "none", "--no-report", "--stop", "max_iterations=1", "--stop", "relative_decrease=0")
    assert run("optimize_traverse.py", "traverse", "--out", "out", *short).returncode == 1
    solution = read_solution_json(tmp_path / "out" / "solution.json")
    assert (solution.converged, solution.stop_reason) == (False, "iteration limit of 1")
    other = ("--no-report", "--stop", "relative_decrease=0", "--stop", "max_gradient=0.5")
    assert run("optimize_traverse.py", "traverse", "--out", "out", *other).returncode == 0
    assert read_solution_json(tmp_path / "out" / "solution.json").stop_reason == "gradient below 0.5"


@pytest.mark.parametrize(
    ("text", "word"), [("steps=3", "'steps=3'"), ("max_gradient=few", "'few'"), ("relative_step=-1", "-1.0")]
)
def test_wrong_stopping_is_one_sentence_before_anything_is_read(run: Run, text: str, word: str) -> None:
    done = run("optimize_traverse.py", "nowhere", "--out", "out", "--stop", text)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    for part in ("expected", "found", word):
        assert part in done.stderr


def test_matrices_with_explicit_landmarks_are_refused_in_one_line(
    run: Run, traverse_folder: Path, tmp_path: Path
) -> None:
    words = ["--model", "projective", "--landmarks", "explicit"]
    done = run("optimize_traverse.py", "traverse", "--out", "out", *words)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "landmarks: expected eliminated for the model projective, found explicit" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["mounts"], "expected QUANTITY=SCOPE"),
        (["calibration=eye:k1"], "found 'k1'"),
        (["radius=eye"], "expected fixed with the model mast"),
        (["calibration=fixed:fx_px"], "found fixed with fx_px"),
    ],
)
def test_a_sharing_that_means_nothing_is_one_line(
    run: Run, traverse_folder: Path, tmp_path: Path, words: list[str], text: str
) -> None:
    done = run("optimize_traverse.py", "traverse", "--out", "out", "--sharing", *words)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert text in done.stderr
    assert not (tmp_path / "out").exists()


def test_the_command_line_goes_before_the_file(run: Run, traverse_folder: Path, tmp_path: Path) -> None:
    """Quantity by quantity: what it does not name stays as the file has it."""
    edit(traverse_folder, sharing={"mounts": {"scope": "eye"}, "calibration": {"scope": "image"}})
    words = ("calibration=eye:focal~0.01", "pan_T_tilt=fixed")
    done = run("optimize_traverse.py", "traverse", "--out", "out", "--sharing", *words)
    assert done.returncode == 0, done.stderr
    refined = read_solution_json(tmp_path / "out" / "solution.json").refined
    assert [r.entry for r in refined if r.quantity == "calibration"] == ["focal", "focal"]
    assert [r.prior_sigma for r in refined if r.quantity == "calibration"] == [0.01, 0.01]
    assert len([r for r in refined if r.quantity == "mounts"]) == 12
    assert "<h2>What the pictures say of the camera</h2>" in (tmp_path / "out" / "report.html").read_text()


def test_no_observation_twice_is_bad_input(run: Run, tmp_path: Path) -> None:
    simulation = simulate(mer_navcam(), SMALL, seed=0)
    t = simulation.traverse
    assert t.observations is not None
    lonely = replace(t.observations.select(np.arange(5)), track=np.arange(5))
    write_traverse(t.with_observations(lonely), tmp_path / "traverse")
    done = run("optimize_traverse.py", "traverse", "--out", "out")
    assert done.returncode == 2
    assert "two or more images" in done.stderr
    assert not (tmp_path / "out").exists()


def test_exports_are_written_beside_and_dense_work_is_kept(
    run: Run, traverse_folder: Path, tmp_path: Path
) -> None:
    words = ("--export", "colmap", "--export", "cahvor", "--no-report")
    done = run("optimize_traverse.py", "traverse", "--out", "out", *words)
    assert done.returncode == 0, done.stderr
    n = len(json.loads((traverse_folder / "traverse.json").read_text())["images"])
    assert len(list((tmp_path / "out" / "cahvor").glob("*.cahvor"))) == n
    assert {p.name for p in (tmp_path / "out" / "colmap").iterdir()} == {
        "sparse",
        "images",
        "stereo",
        "export.json",
    }
    assert run("optimize_traverse.py", "traverse", "--out", "out", *words).returncode == 0
    (tmp_path / "out" / "colmap" / "fused.ply").write_text("hours of work")
    done = run("optimize_traverse.py", "traverse", "--out", "out", *words)
    assert done.returncode == 2
    assert done.stderr == (
        "out: expected a new folder or one of older results, found what others made in it: colmap/fused.ply\n"
    )
    assert (tmp_path / "out" / "colmap" / "fused.ply").read_text() == "hours of work"


def test_a_lens_that_an_export_cannot_say_is_bad_input_before_the_solve(run: Run, tmp_path: Path) -> None:
    t = simulate(mer_navcam(), SMALL, seed=0).traverse
    k = {name: getattr(t.rig.eyes[0].camera, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    size = {"width_px": t.rig.eyes[0].camera.width_px, "height_px": t.rig.eyes[0].camera.height_px}
    lens = Brown(**size, **k, distortion=(0.0, 0.0, 1e-4, 0.0, 0.0))
    eyes = (replace(t.rig.eyes[0], camera=lens), *t.rig.eyes[1:])
    write_traverse(replace(t, rig=replace(t.rig, name="own", eyes=eyes)), tmp_path / "traverse")
    done = run("optimize_traverse.py", "traverse", "--out", "out", "--export", "cahvor")
    assert done.returncode == 2
    name = t.rig.eyes[0].name
    assert done.stderr == (
        f"cahvor: camera {name}: distortion: expected k1 and k2 alone, all that CAHVOR can say, "
        "found p1 0.0001, p2 0, k3 0\n"
    )
    assert not (tmp_path / "out").exists()
    done = run("optimize_traverse.py", "traverse", "--out", "out", "--export", "nerf")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1


def test_simulate_then_optimize(run: Run, tmp_path: Path) -> None:
    options = ("--stops", "1", "--pans", "2", "--sweep-deg", "45", "--seed", "3", "--noise-stretch", "4")
    assert run("simulate_traverse.py", "made", *options).returncode == 0
    assert run("optimize_traverse.py", "made", "--out", "out", "--no-report", "--csv").returncode == 0
    assert (tmp_path / "out" / "residuals.csv").read_text().splitlines()[0].endswith("cov_vv_px2")
    again = run("simulate_traverse.py", "made", *options)
    assert again.returncode == 2
    assert "made" in again.stderr
