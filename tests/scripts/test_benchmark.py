"""The benchmark's parts: that they say what they mean. Nothing here measures time."""

import json
import runpy
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

pytest.importorskip("benchmarks", reason="the benchmark is part of the repository, not of the package")

from benchmarks.cases import CASES, DEFAULT_CASES, GROWTH, Case, Size, chosen_cases, make
from benchmarks.engines import ENGINES, Measured, NotRun, Setting, ceres_program, measure, solve_first_ever
from benchmarks.peer import write_peer
from benchmarks.report import CaseResult, Report, against_baseline, read_baseline, write_baseline
from benchmarks.steps import Steps
from pancam_graph import SimulationOptions, Traverse, read_traverse, simulate
from pancam_graph.base.errors import InputError
from pancam_graph.rigs import Rig, exomars_pancam, mer_navcam

TINY = SimulationOptions(stops=1, pans=2, sweep_rad=0.8, points_per_image=8, reach_m=30.0)


def setting(folder: Path, ceres: Path | NotRun | None = None) -> Setting:
    missing = NotRun(reason="not asked for", failed=False)
    return Setting(ceres=missing if ceres is None else ceres, numba_cache=folder / "numba")


def measured(seconds: float, *, cost: float = 1000.0, iterations: int = 5, detail: str = "") -> Measured:
    return Measured(
        seconds=(2 * seconds, seconds), iterations=iterations, cost_final=cost, memory_mb=100.0, detail=detail
    )


def case_result(name: str, engines: Mapping[str, Measured | NotRun], observations: int = 1000) -> CaseResult:
    size = Size(stops=3, images=10, tracks=300, observations=observations, stops_per_track=2.0)
    return CaseResult(name=name, size=size, engines=engines)


# --- cases ---


def test_cases_are_of_the_agreed_sizes() -> None:
    """Images exactly; that the observations are as many as agreed is shown for the small case only."""
    images = {
        n: 2 * c.options.stops * (c.options.pans or 0) * len(c.options.tilts_rad or ())
        for n, c in CASES.items()
    }
    assert images == {
        "small": 108,
        "mid": 720,
        "long": 2880,
        "small-rig": 108,
        "mid-rig": 720,
        "long10": 720,
        "long80": 5760,
        "drive300": 21600,
    }
    assert "drive300" not in DEFAULT_CASES
    assert {replace(CASES[name].options, stops=1) for name in ("long", *GROWTH)} == {
        replace(CASES["long"].options, stops=1)
    }
    for name, case in CASES.items():
        assert case.name == name
        assert set(case.engines) <= set(ENGINES)


def test_small_case_as_files(tmp_path: Path) -> None:
    files, size = make(CASES["small"], tmp_path / "small")
    traverse = read_traverse(files.traverse)
    assert traverse.observations is not None
    assert size.observations == len(traverse.observations) == pytest.approx(15_500, rel=0.05)
    assert size.images == len(traverse.images) == 108
    assert (files.rig, traverse.rig.uncertainty.focal) == ("held", 2e-3)  # as the Ceres program has it
    assert 2.3 < size.stops_per_track <= 3
    assert np.load(files.start_m).shape == (size.tracks, 3)
    with files.peer.open() as peer:
        assert [int(n) for n in peer.readline().split()[:4]] == [3, 54, size.tracks, size.observations]


def test_choice_of_cases() -> None:
    chosen = chosen_cases(["long", "small"], engines=["ceres"], repeats=7)
    assert [(c.name, c.engines, c.repeats) for c in chosen] == [
        ("small", ("ceres",), 7),
        ("long", ("ceres",), 7),
    ]
    assert chosen_cases(["mid"]) == (CASES["mid"],)
    with pytest.raises(InputError, match="--repeats: expected 1 or more, found 0"):
        chosen_cases(["mid"], repeats=0)


# --- the peer's file ---


def numbers(path: Path) -> list[list[float]]:
    return [[float(x) for x in line.split()] for line in path.read_text().splitlines()]


@pytest.mark.parametrize("rig", ["mer-pancam", "mer-navcam", "exomars-wac"])
def test_peer_file_is_the_one_of_the_independent_generator(
    rig: str, tmp_path: Path, bench_generator: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["--rig", rig, "--stops", "3", "--pans", "6", "--points", "400"]
    monkeypatch.setattr(sys, "argv", [str(bench_generator), str(tmp_path), *options])
    runpy.run_path(str(bench_generator), run_name="__main__")
    expected = numbers(tmp_path / "peer.txt")
    stops, frames, tracks, _ = (int(n) for n in expected[0][:4])
    start_m = np.array(expected[1 + stops + frames :][:tracks])
    write_peer(read_traverse(tmp_path), start_m, tmp_path / "ours.txt")
    found = numbers(tmp_path / "ours.txt")
    assert len(found) == len(expected)
    for ours, theirs in zip(found, expected, strict=True):
        assert ours == pytest.approx(theirs, rel=1e-12, abs=1e-12)


def tilted_axis(traverse: Traverse) -> Traverse:
    offset = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.1]))
    return replace(traverse, rig=replace(traverse.rig, pan_T_tilt=offset))


def shifted_eye(traverse: Traverse) -> Traverse:
    left, right = traverse.rig.eyes
    up = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.01, 0.0]))
    moved = replace(right, head_T_camera=right.head_T_camera * up)
    return replace(traverse, rig=replace(traverse.rig, eyes=(left, moved)))


def larger_eye(traverse: Traverse) -> Traverse:
    left, right = traverse.rig.eyes
    larger = replace(right, camera=replace(right.camera, fx_px=1300.0, fy_px=1300.0))  # type: ignore[call-arg]  # a pinhole
    return replace(traverse, rig=replace(traverse.rig, eyes=(left, larger)))


def free_first_stop(traverse: Traverse) -> Traverse:
    first, *others = traverse.stops
    return replace(traverse, stops=(replace(first, sigma_translation_m=0.1), *others))


def uneven_noise(traverse: Traverse) -> Traverse:
    assert traverse.observations is not None
    sigma_px = np.linspace(0.3, 0.5, len(traverse.observations))
    return traverse.with_observations(replace(traverse.observations, sigma_px=sigma_px))


def ellipses(traverse: Traverse) -> Traverse:
    assert traverse.observations is not None
    covariance_px2 = np.tile(np.diag([0.1, 0.2]), (len(traverse.observations), 1, 1))
    return traverse.with_observations(traverse.observations.with_covariance(covariance_px2))


def uneven_pointing(traverse: Traverse) -> Traverse:
    first, *others = traverse.frames
    return replace(traverse, frames=(replace(first, sigma_pan_rad=0.1), *others))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (tilted_axis, "axes that meet"),
        (shifted_eye, "mirror each other"),
        (larger_eye, "two equal cameras"),
        (free_first_stop, "held"),
        (uneven_noise, "sigma_px: the peer expects one number"),
        (ellipses, "covariance_px2: the peer expects none"),
        (uneven_pointing, "sigmas of pan and tilt: the peer expects one number"),
        (lambda t: replace(t, observations=None), "observations"),
    ],
)
def test_peer_refuses_what_it_cannot_express(
    change: Callable[[Traverse], Traverse], said: str, tmp_path: Path
) -> None:
    simulation = simulate(mer_navcam(), TINY)
    with pytest.raises(InputError, match=said):
        write_peer(change(simulation.traverse), simulation.truth.landmarks_m, tmp_path / "peer.txt")
    assert not (tmp_path / "peer.txt").exists()


def test_peer_refuses_three_cameras(tmp_path: Path) -> None:
    rig: Rig = exomars_pancam()
    simulation = simulate(rig, TINY)
    with pytest.raises(InputError, match="two cameras, found 3"):
        write_peer(simulation.traverse, simulation.truth.landmarks_m, tmp_path / "peer.txt")


# --- processes ---


def fake_program(path: Path, text: str) -> Path:
    path.write_text(f"#!{sys.executable}\n{text}")
    path.chmod(0o755)
    return path


FAKE_CERES = """
import json, sys
seconds = {"dense": 3.0, "sparse": 1.0, "iterative": 2.0}[sys.argv[2]]
assert sys.argv[3] == "2"
print(json.dumps({"solver": sys.argv[2], "iterations": 4, "seconds": seconds, "final_cost": 12.5}))
"""


def test_the_fastest_solver_of_ceres_counts(tmp_path: Path) -> None:
    files, _ = make(Case(name="tiny", options=TINY, engines=(), repeats=1), tmp_path / "tiny")
    program = fake_program(tmp_path / "ceres", FAKE_CERES)
    found = measure(ENGINES["ceres"], files, setting(tmp_path, program), 3)
    assert isinstance(found, Measured), found
    assert found.seconds == (1.0, 1.0, 1.0)
    assert (found.iterations, found.cost_final) == (4, 12.5)
    assert found.memory_mb > 1
    assert found.detail == "sparse Schur, 2 threads; dense 3 s, iterative 2 s"


def test_an_engine_that_fails_is_told_from_one_that_is_missing(tmp_path: Path) -> None:
    files, _ = make(Case(name="tiny", options=TINY, engines=(), repeats=1), tmp_path / "tiny")
    program = fake_program(tmp_path / "ceres", "import sys; sys.exit(3)")
    failed = measure(ENGINES["ceres"], files, setting(tmp_path, program), 1)
    assert isinstance(failed, NotRun)
    assert failed.failed
    assert "status 3" in failed.reason
    missing = measure(ENGINES["ceres"], files, setting(tmp_path), 1)
    assert missing == NotRun(reason="not asked for", failed=False)
    report = Report(cases=(case_result("tiny", {"ceres": failed, "pycolmap": missing}),))
    assert len(report.complaints()) == 1
    assert "tiny: ceres failed" in report.complaints()[0]
    assert report.notes() == ["tiny: pycolmap skipped: not asked for"]


def test_no_engine_inherits_what_slows_blas(tmp_path: Path) -> None:
    inherited = {"OPENBLAS_CORETYPE": "x", "OPENBLAS_L2_SIZE": "1", "PYTHONPATH": "before", "HOME": "h"}
    found = replace(setting(tmp_path), environment=inherited).child_environment("explicit")
    assert set(found) == {"PYTHONPATH", "HOME", "NUMBA_CACHE_DIR"}
    assert found["PYTHONPATH"].endswith("before")


def test_first_solve_ever_wants_an_empty_cache(tmp_path: Path) -> None:
    files, _ = make(Case(name="tiny", options=TINY, engines=(), repeats=1), tmp_path / "tiny")
    (tmp_path / "numba" / "explicit").mkdir(parents=True)
    (tmp_path / "numba" / "explicit" / "old").touch()
    with pytest.raises(ValueError, match="empty folder"):
        solve_first_ever(ENGINES["explicit"], files, setting(tmp_path))


def test_where_the_ceres_program_comes_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = fake_program(tmp_path / "program", "")
    assert ceres_program(program, None, tmp_path) == program
    missing = ceres_program(tmp_path / "none", None, tmp_path)
    assert isinstance(missing, NotRun)
    assert missing.failed  # it was asked for
    source = tmp_path / "peer.cc"
    no_source = ceres_program(None, source, tmp_path)
    assert isinstance(no_source, NotRun)
    assert not no_source.failed
    source.write_text("")
    monkeypatch.setenv("PATH", str(tmp_path))
    no_compiler = ceres_program(None, source, tmp_path)
    assert isinstance(no_compiler, NotRun)
    assert "g++" in no_compiler.reason


# --- report ---


def test_ratios_compare_the_best_times() -> None:
    report = Report(
        cases=(
            case_result(
                "small", {"eliminated": measured(0.1), "explicit": measured(2.0), "ceres": measured(0.4)}
            ),
            case_result("mid", {"ceres": measured(9.0)}),
        )
    )
    assert report.ratios() == pytest.approx(
        {
            "small: eliminated / ceres": 0.25,
            "small: explicit / ceres": 5,
            "small: eliminated / explicit": 0.05,
        }
    )
    assert report.complaints() == []


@pytest.mark.parametrize(("cost", "fine"), [(1000.09, True), (1000.11, False), (float("nan"), False)])
def test_costs_must_agree(cost: float, fine: bool) -> None:
    """But for COLMAP's, whose problem is another one."""
    engines = {
        "eliminated": measured(1, cost=cost),
        "ceres": measured(1),
        "pycolmap": measured(1, cost=900.0),
    }
    complaints = Report(cases=(case_result("small", engines),)).complaints()
    assert (complaints == []) == fine
    assert all("small: FINAL COSTS DIFFER: eliminated" in c for c in complaints)


def test_costs_must_agree_without_ceres_too() -> None:
    engines = {"eliminated": measured(1), "explicit": measured(1, cost=1001.0)}
    assert len(Report(cases=(case_result("small", engines),)).complaints()) == 1


def test_not_converged_is_a_complaint() -> None:
    result = case_result(
        "small", {"eliminated": measured(1, detail="not converged: the limit of 100 iterations")}
    )
    assert "not converged" in Report(cases=(result,)).complaints()[0]


@pytest.mark.parametrize(("seconds", "growth"), [(20.0, 1.0), (24.0, 1.2), (28.0, 1.4)])
def test_growth_is_per_observation_and_iteration(seconds: float, growth: float) -> None:
    report = Report(
        cases=(
            case_result(GROWTH[0], {"eliminated": measured(1.0, iterations=4)}, 1000),
            case_result(GROWTH[1], {"eliminated": measured(seconds, iterations=10)}, 8000),
        )
    )
    assert report.growth() == pytest.approx(growth)
    assert report.growth(per_iteration=False) == pytest.approx(2.5 * growth)
    assert f"per observation alone times {2.5 * growth:.2f}" in report.notes()[-1]
    assert (report.complaints() == []) == (growth < 1.3)
    assert list(report.ratios()) == ["long80 / long10: time per observation and iteration"]


def test_table_has_a_line_per_engine_that_ran() -> None:
    report = Report(
        cases=(
            case_result(
                "small",
                {
                    "eliminated": replace(
                        measured(0.1), rms_px=0.587, first_s=0.9, initialise_s=0.02, process_s=0.6
                    ),
                    "ceres": replace(measured(0.4), process_s=0.5),
                    "pycolmap": NotRun(reason="", failed=False),
                },
                12_345,
            ),
        )
    )
    head, rule, ours, ceres = report.markdown().splitlines()
    assert head.count("|") == rule.count("|") == ours.count("|") == ceres.count("|") == 13
    assert "12,345 observations" in ours
    assert [cell.strip() for cell in ours.split("|")[3:-1]] == [
        "0.6", "1.20", "0.1 (0.2)", "0.25", "5", "1000.0", "0.587", "0.02", "0.9", "100",
    ]  # fmt: skip
    assert [cell.strip() for cell in ceres.split("|")[1:5]] == ["", "Ceres, C++", "0.5", "1.00"]
    assert report.ratios()["small: eliminated / ceres, whole process"] == pytest.approx(1.2)


def test_baseline_complains_only_of_what_got_worse() -> None:
    baseline = {"a": 0.2, "b": 0.2, "c": 0.2, "not measured": 1.0}
    worse, notes = against_baseline({"a": 0.26, "b": 0.24, "c": 0.1, "new": 3.0}, baseline, 0.25)
    assert len(worse) == 1
    assert worse[0].startswith("a: 0.26, baseline 0.2 (+30%): WORSE")
    assert len(notes) == 3
    assert "better" in notes[1]
    assert "not in the baseline" in notes[2]
    assert against_baseline({"a": float("nan")}, baseline, 0.25)[0]


def test_baseline_is_renewed_where_measured(tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    assert read_baseline(path) == {}
    assert write_baseline(path, {"a": 0.5, "b": 2.0}) == ["a: 0.5, new", "b: 2, new"]
    assert write_baseline(path, {"b": 1.0}) == ["b: 2 -> 1"]
    assert read_baseline(path) == {"a": 0.5, "b": 1.0}
    assert [p.name for p in tmp_path.iterdir()] == ["baseline.json"]


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"format": "pancam-graph/traverse", "version": 1, "ratios": {}}',
        '{"format": "pancam-graph/benchmark-baseline", "version": 1, "ratios": {"a": "fast"}}',
        '{"format": "pancam-graph/benchmark-baseline", "version": 1, "ratios": {"a": 0}}',
    ],
)
def test_another_file_is_no_baseline(content: str, tmp_path: Path) -> None:
    (tmp_path / "baseline.json").write_text(content)
    with pytest.raises(InputError, match=r"baseline\.json: .*expected .*, found"):
        read_baseline(tmp_path / "baseline.json")


def test_committed_baseline_is_of_cases_that_exist(scripts_folder: Path) -> None:
    for name in read_baseline(scripts_folder / "benchmark_baseline.json"):
        assert name.split(":")[0].split(" / ")[0] in CASES


# --- the program ---


@pytest.fixture
def run(scripts_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["benchmark.py", *arguments])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(str(scripts_folder / "benchmark.py"), run_name="__main__")
        assert isinstance(end.value.code, int)
        return end.value.code

    return call


@pytest.mark.slow
def test_a_tiny_run_from_end_to_end(
    run: Callable[..., int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")  # the cache starts empty: compiling would take longer
    monkeypatch.setitem(CASES, "small", replace(CASES["small"], options=TINY, repeats=1))
    assert run("--cases", "small", "--engines", "explicit", "--json", "new/all.json") == 0
    printed = capsys.readouterr().out
    assert "pancam_graph, explicit landmarks" in printed
    assert "new/all.json" in printed
    content = json.loads(Path("new/all.json").read_text())
    assert content["machine"]["gtsam"]
    assert content["complaints"] == []
    assert list(content["first_ever_s"]) == ["explicit"]
    found = content["cases"]["small"]["engines"]["explicit"]
    assert 0.1 < found["rms_px"] < 0.3 * np.sqrt(2)  # two views a track have little freedom
    assert found["cost_final"] > 0
    assert found["memory_mb"] > 50
    assert len(found["seconds"]) == 1


def test_a_failed_engine_is_status_1(
    run: Callable[..., int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(CASES, "small", replace(CASES["small"], options=TINY))
    options = ("--cases", "small", "--engines", "ceres", "--ceres", "none", "--json", "all.json")
    assert run(*options) == 1
    assert "ERROR small: ceres failed: none: expected a program, found none" in capsys.readouterr().out
    assert json.loads((tmp_path / "all.json").read_text())["complaints"]


def test_nothing_is_overwritten(
    run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "old.json").write_text("{}")
    assert run("--json", "old.json") == 2
    assert capsys.readouterr().err == "old.json: expected a new file, found one that is there\n"
    assert (tmp_path / "old.json").read_text() == "{}"


def test_all_time_between_two_reports_belongs_to_the_step_that_reports() -> None:
    wall, processor = iter([0.0, 2.0, 3.0, 7.0, 8.0]), iter([0.0, 4.0, 5.0, 5.5, 7.0])
    steps = Steps(wall=lambda: next(wall), processor=lambda: next(processor))
    for step in ("images", "masks", "masks", "images"):
        steps.done(step, 1, 2)
    assert steps.seconds == {"images": (3.0, 5.5), "masks": (5.0, 1.5)}
    assert steps.table().splitlines()[-1].split() == ["all", "8.0", "7.0"]
