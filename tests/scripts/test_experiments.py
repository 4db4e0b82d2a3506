"""The thesis's experiments: that errors are aligned as they say, and that no failed run is lost."""

import json
import math
import re
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

pytest.importorskip("experiments", reason="the experiments are part of the repository, not of the package")

from experiments.alternation import AlternationTask
from experiments.conditioning import ConditioningTask, name_of
from experiments.errors import errors_of, mean_rotation, umeyama
from experiments.figures import require_matplotlib
from experiments.models import KNOWN_RIG, RIG_OFF, ClusterTask
from experiments.output import require_new, write_results
from experiments.registry import CLUSTERS, FAMILIES, plan
from experiments.running import Row, Sample, attempt, quantile, run_tasks, summarise
from experiments.scenarios import Scenario
from experiments.validation import ValidationTask, compare
from experiments.verdicts import Results, verdicts
from pancam_graph import Solution, solve
from pancam_graph.base.errors import InputError, SolveError
from pancam_graph.base.geometry import FloatArray

KEYS = ["experiment", "model", "sharing", "noise_px", "seeds", "metric", "median", "q05", "q95", "failed"]
TINY = Scenario(name=CLUSTERS[1].name, eyes="both eyes", images=6, points_per_image=20)


def some_rotation(seed: int) -> FloatArray:
    return np.asarray(gtsam.Rot3.Expmap(np.random.default_rng(seed).standard_normal(3)).matrix())


def sample(seed: int, value: float | None, **changes: object) -> Sample:
    fields = {"experiment": "e", "model": "mast", "sharing": "fixed", "noise_px": 0.5, "seed": seed}
    outcome = {"failure": "no"} if value is None else {"metrics": {"centre_mm": value}}
    return Sample(**{**fields, **outcome, **changes})  # type: ignore[arg-type]  # names and types as above


# --- alignment ---


@pytest.mark.parametrize("seed", range(5))
def test_a_known_similarity_is_found_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, rotation, shift = rng.standard_normal((12, 3)), some_rotation(seed), rng.standard_normal(3)
    found = umeyama(points, 2.5 * points @ rotation.T + shift)
    assert found.scale == pytest.approx(2.5, rel=1e-13)
    assert found.rotation == pytest.approx(rotation, abs=1e-13)
    assert found.translation_m == pytest.approx(shift, abs=1e-13)


def test_a_mirror_image_is_never_the_answer() -> None:
    """Points in a plane are their own mirror images: the rotation must stay one."""
    points = np.random.default_rng(0).standard_normal((12, 3)) * [1.0, 1.0, 0.0]
    assert np.linalg.det(umeyama(points, points * [1.0, -1.0, 1.0]).rotation) == pytest.approx(1.0)
    noisy = umeyama(np.random.default_rng(1).standard_normal((5, 3)), np.random.default_rng(2).random((5, 3)))
    assert np.linalg.det(noisy.rotation) == pytest.approx(1.0)


def test_no_other_similarity_is_nearer() -> None:
    rng = np.random.default_rng(3)
    source, target = rng.standard_normal((2, 9, 3))
    best = umeyama(source, target)
    least = np.sum((best.points(source) - target) ** 2)
    for _ in range(50):
        other = replace(
            best,
            scale=best.scale * (1 + 0.01 * rng.standard_normal()),
            rotation=best.rotation @ gtsam.Rot3.Expmap(0.01 * rng.standard_normal(3)).matrix(),
            translation_m=best.translation_m + 0.01 * rng.standard_normal(3),
        )
        assert np.sum((other.points(source) - target) ** 2) > least


def test_mean_of_turns_about_one_axis_is_the_turn_by_their_mean() -> None:
    turns = np.array([gtsam.Rot3.Rz(a).matrix() for a in (0.1, 0.2, 0.6)])
    pair = mean_rotation(turns[:2])
    assert pair == pytest.approx(gtsam.Rot3.Rz(0.15).matrix(), abs=1e-12)


def moved(solution: Solution, scale: float, rotation: FloatArray, shift: FloatArray) -> Solution:
    final = solution.final
    return replace(
        solution,
        final=replace(
            final,
            world_R_camera=rotation @ final.world_R_camera,
            world_t_camera=scale * final.world_t_camera @ rotation.T + shift,
            landmarks_m=scale * final.landmarks_m @ rotation.T + shift,
        ),
    )


def test_errors_do_not_see_a_similarity_but_for_scale_and_place() -> None:
    simulation = replace(TINY, stops=2, spacing_m=3.0).simulate(0.5, 1)
    solution = solve(simulation.traverse, KNOWN_RIG[2].options)
    before = errors_of(solution, simulation)
    after = errors_of(moved(solution, 1.1, some_rotation(4), np.array([3.0, -2.0, 1.0])), simulation)
    seen = {"scale_percent", "distance_percent", "localisation_percent"}
    assert {k for k in before if after[k] != pytest.approx(before[k], rel=1e-6)} == seen
    rigid = errors_of(moved(solution, 1.0, some_rotation(5), np.array([3.0, -2.0, 1.0])), simulation)
    assert rigid == pytest.approx(before, rel=1e-6)


def test_the_truth_has_no_error() -> None:
    simulation = replace(TINY, stops=2, spacing_m=3.0).simulate(0.5, 1)
    solution = solve(simulation.traverse, KNOWN_RIG[0].options)
    truth = simulation.truth
    rotations, centres = simulation.traverse.camera_poses(truth.world_T_mast, truth.pan_tilt_rad)
    final = replace(
        solution.final,
        world_R_camera=rotations,
        world_t_camera=centres,
        landmarks_m=truth.landmarks_m[solution.landmark_track],
    )
    errors = errors_of(replace(solution, final=final), simulation)
    del errors["reprojection_px"], errors["iterations"]
    assert errors == pytest.approx(dict.fromkeys(errors, 0.0), abs=1e-9)


# --- what a solution predicts ---


@pytest.mark.slow
def test_errors_of_the_mast_are_those_its_covariance_predicts() -> None:
    """Over seeds: their medians, which 12 of them tell to a third."""
    scenario = replace(TINY, stops=2, spacing_m=3.0)
    task = [ClusterTask(scenario=scenario, noise_px=0.5, seed=i, variants=KNOWN_RIG[:1]) for i in range(12)]
    found = [sample.metrics for one in task for sample in one.run()]
    for name, predicted in (
        ("centre_mm", "centre_predicted_mm"),
        ("distance_percent", "distance_predicted_percent"),
    ):
        measured, expected = (np.median([m[key] for m in found]) for key in (name, predicted))
        assert 0.5 < measured / expected < 2.0


# --- failures ---


def test_failed_runs_are_the_worst_and_stay() -> None:
    values = [1.0, 2.0, 3.0, 4.0, None, None]
    (row,) = summarise([sample(i, v) for i, v in enumerate(values)])
    assert (row.median, row.q05, row.q95) == (3.0, 1.0, math.inf)
    assert (row.seeds, row.failed) == (6, 2)
    assert row.to_json()["q95"] is None


def test_half_of_the_runs_failed_and_there_is_no_median() -> None:
    (row,) = summarise([sample(0, 1.0), sample(1, None), sample(2, None)])
    assert math.isinf(row.median)
    assert row.q05 == 1.0


def test_a_model_that_always_fails_has_rows() -> None:
    rows = summarise([sample(0, 1.0), sample(0, None, model="free"), sample(1, None, model="free")])
    assert [(r.model, r.metric, r.failed, r.median) for r in rows] == [
        ("mast", "centre_mm", 0, 1.0),
        ("free", "centre_mm", 2, math.inf),
    ]


def test_quantiles_are_by_rank() -> None:
    assert [quantile(range(1, 101), s) for s in (0.05, 0.5, 0.95)] == [5, 50, 95]
    assert quantile([1.0, math.nan], 0.5) == 1.0
    assert quantile([1.0, math.nan], 1.0) == math.inf


def test_what_counts_as_failed() -> None:
    def raises() -> dict[str, float]:
        raise SolveError("no way")

    assert attempt(raises) == ({}, "no way")
    assert attempt(lambda: {"a": 1.0, "b": math.nan})[1] == "no finite b"
    assert attempt(lambda: {"a": 1.0}) == ({"a": 1.0}, "")


def test_a_solve_that_does_not_converge_is_a_failed_run() -> None:
    hasty = replace(KNOWN_RIG[2], options=replace(KNOWN_RIG[2].options, max_iterations=1))
    (found,) = ClusterTask(scenario=TINY, noise_px=0.5, seed=0, variants=(hasty,)).run()
    assert found.failure.startswith("not converged")


# --- experiments ---


@pytest.mark.slow
def test_our_optimum_is_that_of_an_independent_solver() -> None:
    found = compare(0.5, 0)
    assert found["cost_relative"] < 1e-8
    assert found["angle_rad"] < 1e-7
    assert found["stop_m"] < 1e-6
    assert found["landmark_relative"] < 1e-5


def test_a_rig_that_is_off_is_found_where_it_is_free() -> None:
    task = ClusterTask(
        scenario=replace(TINY, images=10, points_per_image=40, rig_off=True),
        noise_px=0.1,
        seed=2,
        variants=RIG_OFF,
    )
    found = {(s.model, s.sharing): s for s in task.run()}
    assert not any(s.failure for s in found.values())
    for model in ("mast", "circle", "free"):
        fixed, shared = (found[model, name].metrics for name in ("fixed", "shared"))
        assert shared["focal_percent"] < fixed["focal_percent"] / 2
        assert shared["reprojection_px"] < fixed["reprojection_px"]


@pytest.mark.slow
def test_two_processes_give_what_one_does() -> None:
    tasks = [ClusterTask(scenario=TINY, noise_px=0.5, seed=seed, variants=KNOWN_RIG[:1]) for seed in range(3)]
    assert run_tasks(tasks, processes=2) == run_tasks(tasks, processes=1)


@pytest.mark.slow
def test_conditioning_makes_the_origin_indifferent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.conditioning.ORIGINS_M", (0.0, 1e5))
    found = {(s.experiment, s.model): s for s in ConditioningTask(scenario=TINY, noise_px=0.5, seed=0).run()}
    here, away = (found[name_of(m), "projective"].metrics for m in (0.0, 1e5))
    assert here["iterations"] == away["iterations"]
    assert here["cost"] == pytest.approx(away["cost"], rel=1e-6)
    as_it_is = found[name_of(1e5), "projective, as it is"]
    assert as_it_is.failure or as_it_is.metrics["cost"] > 1.0003 * here["cost"]


@pytest.mark.slow
def test_alternation_is_slower_than_the_joint_solver() -> None:
    found = {
        s.model: s for s in AlternationTask(scenario=replace(TINY, rig_off=True), noise_px=0.5, seed=0).run()
    }
    for model in ("mast", "circle", "free"):
        joint, alternating = (found[f"{model}, {method}"].metrics for method in ("joint", "alternation"))
        assert joint["excess_after_10_steps"] < 1e-6
        assert alternating["excess_after_10_steps"] > joint["excess_after_10_steps"]


def test_without_the_images_it_says_what_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.opportunity.opportunity_folder", lambda: None)
    chosen = plan(seeds=1, quick=True, families=["opportunity"])
    assert chosen.tasks == ()
    assert "were not found" in chosen.left_out[0]


def test_full_plan_has_all_noises_and_seeds() -> None:
    tasks = [
        t for t in plan(seeds=50, quick=False, families=["clusters"]).tasks if isinstance(t, ClusterTask)
    ]
    known = [(t.noise_px, t.seed) for t in tasks if t.scenario == CLUSTERS[0]]
    assert len(known) == len(set(known)) == 5 * 50


# --- verdicts and files ---


def rows_of(medians: dict[str, float]) -> list[Row]:
    return [
        Row(
            experiment=CLUSTERS[0].name,
            model=model,
            sharing="fixed",
            noise_px=0.5,
            seeds=5,
            metric=metric,
            median=value,
            q05=value,
            q95=value,
            failed=0,
        )
        for model, value in medians.items()
        for metric in ("centre_mm", "landmark_m")
    ]


def test_verdicts_follow_the_figures() -> None:
    def held(**medians: float) -> list[bool]:
        return [v.holds for v in verdicts(Results(rows_of(medians)))]

    assert held(mast=1.0, circle=2.0, free=3.0) == [True, True]
    assert held(mast=1.0, circle=0.5, free=2.9) == [False, False]
    assert held(mast=1.0, circle=2.0, free=math.inf) == [True, True]
    assert held(mast=math.inf, circle=2.0, free=math.inf) == [False, False]


@pytest.mark.slow
def test_results_are_complete(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    samples = run_tasks(
        [
            ClusterTask(scenario=TINY, noise_px=noise, seed=seed, variants=KNOWN_RIG)
            for noise in (0.1, 0.5)
            for seed in range(2)
        ]
        + [ValidationTask(noise_px=0.5, seed=0)],
        processes=1,
    )
    samples.append(replace(samples[0], metrics={}, failure="it did not want to", seed=9))
    found = write_results(samples, ["an experiment: not here"], tmp_path / "out")
    assert [v.expectation[:6] for v in found] == ["The jo", "Camera", "Errors"]
    entries = json.loads((tmp_path / "out/results.json").read_text(encoding="utf-8"))
    assert all(list(entry) == KEYS for entry in entries)
    assert {e["failed"] for e in entries} == {0, 1}
    text = (tmp_path / "out/results.md").read_text(encoding="utf-8")
    assert "it did not want to" in text
    assert "an experiment: not here" in text
    for name in re.findall(r"!\[(\w+)\]", text):
        for suffix in ("png", "svg"):
            assert (tmp_path / f"out/{name}.{suffix}").stat().st_size > 5000
    assert list(tmp_path.iterdir()) == [tmp_path / "out"]


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    require_new(tmp_path)
    require_new(tmp_path / "new")
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    for there in (tmp_path, tmp_path / "file"):
        with pytest.raises(InputError, match="expected a new or empty folder"):
            require_new(there)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--seeds", "0"], "--seeds: expected 1 or more, found 0"),
        (["--processes", "0"], "--processes: expected 1 or more, found 0"),
        (["--only", "nonsense"], "argument --only: invalid choice: 'nonsense'"),
        (["--only", "validation"], "expected a new or empty folder, found something there"),
    ],
)
def test_bad_input_is_one_sentence_and_status_2(
    scripts_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    complaint: str,
) -> None:
    (tmp_path / "mine").write_text("mine", encoding="utf-8")
    monkeypatch.setattr(sys, "argv", ["reproduce_thesis.py", "--out", str(tmp_path), *words])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(scripts_folder / "reproduce_thesis.py"), run_name="__main__")
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert said.count("\n") == 1
    assert [f.name for f in tmp_path.iterdir()] == ["mine"]


def test_without_matplotlib_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"expected matplotlib, found none; install it with pip install -e"):
        require_matplotlib()


@pytest.mark.slow
def test_the_whole_program(scripts_folder: Path, tmp_path: Path) -> None:
    program = [sys.executable, str(scripts_folder / "reproduce_thesis.py"), "--out", str(tmp_path / "out")]
    words = ["--quick", "--seeds", "1", "--only", *[f for f in FAMILIES if f != "localisation"]]
    ran = subprocess.run([*program, *words], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    entries = json.loads((tmp_path / "out/results.json").read_text(encoding="utf-8"))
    assert {e["experiment"] for e in entries} >= {c.name for c in CLUSTERS}
    again = subprocess.run([*program, *words], capture_output=True, text=True, check=False)
    assert again.returncode == 2
    assert "expected a new or empty folder" in again.stderr
