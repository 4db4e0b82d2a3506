"""The adjustment: exact without noise, honest with it, deaf to outliers, clear about what is wrong."""

import re
import runpy
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import gtsam
import numpy as np
import pytest

from pancam_graph import (
    Observations,
    SimulationOptions,
    SolveOptions,
    Traverse,
    read_traverse,
    simulate,
    solve,
)
from pancam_graph.base.errors import InputError, SolveError
from pancam_graph.cameras import CAHVORE
from pancam_graph.graph import ExplicitLandmarks, Flex, SoftTemplate
from pancam_graph.initialise import Start
from pancam_graph.rigs import TEMPLATES, Eye, Rig, mer_navcam
from pancam_graph.simulate import Simulation
from support.parameters import slow_but_for
from support.solving import fitted, solution_from

SMALL = SimulationOptions(stops=2, pans=3, sweep_rad=1.5, points_per_image=15)

QUICK = [
    *((name, "mast") for name in ("mer-pancam", "msl-mastcam", "exomars-pancam", "mars2020-mastcam-z-110mm")),
    *(("mer-navcam", model) for model in ("mast", "circle", "free")),
    *(("ladybug5", model) for model in ("mast", "free")),
    ("stereo-pan-tilt", "circle"),
]
"""A template of each build with a mast, and each model with cameras of few pixels."""

CERES_COST = {"mer-pancam": 925.735246, "mer-navcam": 10935.916532, "exomars-wac": 7402.282391}
"""Final costs of Ceres 2.1 (DENSE_SCHUR, function tolerance 1e-12) on make_traverse.py --stops 3, seed 0."""


def start_of(simulation: Simulation) -> Start:
    telemetry = simulation.telemetry_start
    return Start(world_T_mast=telemetry.world_T_mast, pan_tilt_rad=telemetry.pan_tilt_rad)


def assert_truth(simulation: Simulation, solution: object, *, angle: float, pose: float) -> None:
    final = solution.final  # type: ignore[attr-defined]  # kept out of the signature to stay short
    assert np.abs(final.pan_tilt_rad - simulation.truth.pan_tilt_rad).max() < angle
    for found, true in zip(final.world_T_mast, simulation.truth.world_T_mast, strict=True):
        assert np.abs(true.localCoordinates(found)).max() < pose


@pytest.mark.parametrize(
    ("name", "model"), slow_but_for(QUICK, product(TEMPLATES, ["mast", "circle", "free"]))
)
def test_exact_without_noise(name: str, model: str) -> None:
    """From telemetry-sized errors back to the truth, where the priors are centred."""
    simulation = simulate(TEMPLATES[name](), replace(SMALL, noise_px=0.0, prior="truth"), seed=3)
    start = start_of(simulation)
    if simulation.traverse.rig.turns:
        assert np.abs(start.pan_tilt_rad - simulation.truth.pan_tilt_rad).max() > 5e-4
    assert not simulation.truth.world_T_mast[1].equals(start.world_T_mast[1], 1e-2)
    solution = solve(simulation.traverse, SolveOptions(loss="none", model=model), start=start)  # type: ignore[arg-type]  # parametrised
    assert solution.converged
    assert solution.used.all()
    # Only what flexes is held by telemetry's sigma: that converges to the same optimum, if less far.
    assert_truth(simulation, solution, angle=1e-9, pose=1e-8)


def test_robust_solve_of_clean_data_is_the_plain_one() -> None:
    simulation = simulate(mer_navcam(), SMALL, seed=5)
    robust, plain = (solve(simulation.traverse, SolveOptions(loss=loss)) for loss in ("cauchy", "none"))
    assert robust.used.mean() > 0.998
    moved = np.abs(robust.final.pan_tilt_rad - plain.final.pan_tilt_rad) / plain.angle_sigma_rad
    assert moved.max() < 1.0  # one near point is missed in one observation


@pytest.mark.parametrize("rig", CERES_COST)
def test_optimum_of_an_independent_solver(
    rig: str, tmp_path: Path, bench_generator: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The traverses of the benchmark end at Ceres's cost: the soft tie is as good as rigid."""
    monkeypatch.setattr(sys, "argv", [str(bench_generator), str(tmp_path), "--rig", rig, "--stops", "3"])
    runpy.run_path(str(bench_generator), run_name="__main__")
    solution = solve(read_traverse(tmp_path), SolveOptions(rig="held", loss="none"))
    assert solution.converged
    assert solution.cost_final == pytest.approx(CERES_COST[rig], rel=1e-4)


# 15: diverging rays of a pair once passed for a far landmark
@pytest.mark.parametrize("seed", slow_but_for([15], [0, 1, 15]))
def test_outliers_go_and_inliers_stay(seed: int) -> None:
    """Of tracks seen three times or more: of a pair that disagrees nothing tells which one is wrong."""
    options = SimulationOptions(stops=2, pans=4, sweep_rad=2.0, outliers=0.05, min_views=3)
    simulation = simulate(mer_navcam(), options, seed=seed)
    solution = solve(simulation.traverse)
    outlier = simulation.truth.outlier
    assert outlier.sum() > 50
    assert (outlier & ~solution.used).sum() >= 0.99 * outlier.sum()
    assert (~outlier & solution.used).sum() >= 0.99 * (~outlier).sum()
    assert solution.rms_final_px == pytest.approx(0.3 * np.sqrt(2), rel=0.25)
    assert {solution.reason[i] for i in np.flatnonzero(~solution.used)} <= {"outlier", "single", "behind"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("mer-navcam", "mast"),
        ("exomars-pancam", "mast"),
        ("mer-pancam", "mast"),
        ("msl-navcam", "mast"),
        ("mars2020-mastcam-z-34mm", "mast"),
        ("stereo-pan-tilt", "mast"),
    ],
)
def test_errors_have_the_variance_that_the_covariance_says(name: str, model: str) -> None:
    """Fifty seeds; intervals of 95 %, for the frames' mean from the spread between seeds (they correlate).

    It does not show that the covariance is right in every direction, only in the mean over each kind.
    """
    seeds = 50
    angles, stops = [], []
    for seed in range(seeds):
        simulation = simulate(TEMPLATES[name](), SMALL, seed=seed)
        options = SolveOptions(rig="held", loss="none", model=model)  # type: ignore[arg-type]  # parametrised
        solution = solve(simulation.traverse, options)
        error = solution.final.pan_tilt_rad - simulation.truth.pan_tilt_rad
        angles.append(np.mean((error / solution.angle_sigma_rad) ** 2))
        shift = simulation.truth.world_T_mast[1].localCoordinates(solution.final.world_T_mast[1])
        stops.append(shift @ np.linalg.solve(solution.stop_covariance[1], shift))
    interval = 1.96 * np.std(angles) / np.sqrt(seeds)
    assert abs(np.mean(angles) - 1) < interval
    assert abs(np.sum(stops) - 6 * seeds) < 1.96 * np.sqrt(2 * 6 * seeds)


@pytest.mark.slow
def test_covariances_agree_with_gtsam_marginals() -> None:
    """Landmarks marginalised by blocks here, by GTSAM's Bayes tree there (which refuses far landmarks)."""
    simulation = simulate(mer_navcam(), SMALL, seed=2)
    t = simulation.traverse
    assert t.observations is not None
    distance = np.linalg.norm(simulation.truth.landmarks_m, axis=1)
    near = t.with_observations(t.observations.select((distance < 20.0)[t.observations.track]))
    flex = Flex(rotation_rad=1e-7, translation_m=1e-6)
    options = SolveOptions(rig="held", loss="none", landmarks="explicit", tie="soft", flex=flex)
    adjustment = fitted(near, options)
    solution = solution_from(adjustment)
    problem = adjustment.problem
    assert isinstance(problem.template, SoftTemplate)
    explicit = ExplicitLandmarks(problem.template, problem.measurements)
    graph = problem.template.factors(apart=True).graph
    graph.push_back(explicit.factors(problem.kept))
    values = explicit.with_landmarks(problem.values, problem.points_m(), problem.present)
    marginals = gtsam.Marginals(graph, values)
    assert solution.stop_covariance[0].tolist() == np.zeros((6, 6)).tolist()
    expected = marginals.marginalCovariance(gtsam.symbol("M", 1))
    assert solution.stop_covariance[1] == pytest.approx(expected, rel=1e-4, abs=1e-6 * np.abs(expected).max())
    for f in range(3):
        sigma = np.sqrt(np.diag(marginals.marginalCovariance(gtsam.symbol("A", f))))
        assert solution.angle_sigma_rad[f] == pytest.approx(sigma, rel=1e-5)


@pytest.mark.slow
def test_a_firm_tie_makes_all_models_agree() -> None:
    """Free cameras on a tie as firm as the mast's are the mast; looser, they fit better, never worse."""
    simulation = simulate(mer_navcam(), SMALL, seed=7)
    flex = Flex(rotation_rad=1e-7, translation_m=1e-6)
    mast = solve(simulation.traverse, SolveOptions(rig="held", loss="none"))
    firm = solve(simulation.traverse, SolveOptions(rig="held", loss="none", model="free", flex=flex))
    free = solve(simulation.traverse, SolveOptions(rig="held", loss="none", model="free"))
    circle = solve(simulation.traverse, SolveOptions(rig="held", loss="none", model="circle"))
    assert firm.final.pan_tilt_rad == pytest.approx(mast.final.pan_tilt_rad, abs=1e-6)
    assert firm.angle_sigma_rad == pytest.approx(mast.angle_sigma_rad, rel=0.02)
    assert free.rms_final_px < circle.rms_final_px < mast.rms_final_px


@pytest.mark.slow
def test_same_input_same_output() -> None:
    simulation = simulate(mer_navcam(), replace(SMALL, outliers=0.03), seed=1)
    first, second = solve(simulation.traverse), solve(simulation.traverse)
    assert first.cost_final == second.cost_final
    assert np.array_equal(first.final.landmarks_m, second.final.landmarks_m, equal_nan=True)


def test_held_stops_and_angles_stay_bit_for_bit() -> None:
    simulation = simulate(mer_navcam(), SMALL, seed=4)
    t = simulation.traverse
    frames = tuple(
        replace(f, sigma_pan_rad=0.0, sigma_tilt_rad=0.0 if i == 0 else f.sigma_tilt_rad) if i < 2 else f
        for i, f in enumerate(t.frames)
    )
    stops = (t.stops[0], replace(t.stops[1], sigma_rotation_rad=0.0))
    solution = solve(replace(t, frames=frames, stops=stops), SolveOptions(loss="none"))
    final = solution.final
    assert final.world_T_mast[0].matrix().tolist() == t.stops[0].world_T_mast.matrix().tolist()
    assert final.pan_tilt_rad[0].tolist() == t.pan_tilt_rad[0].tolist()
    assert final.pan_tilt_rad[1, 0] == pytest.approx(t.pan_tilt_rad[1, 0], abs=1e-12)
    assert final.pan_tilt_rad[1, 1] != t.pan_tilt_rad[1, 1]
    rotation = final.world_T_mast[1].rotation().matrix()
    assert rotation == pytest.approx(t.stops[1].world_T_mast.rotation().matrix(), abs=1e-12)
    assert solution.angle_sigma_rad[0].tolist() == [0, 0]
    assert solution.angle_sigma_rad[1, 0] == pytest.approx(0, abs=1e-9)
    assert np.abs(solution.stop_covariance[1][:3]).max() < 1e-12


def test_a_moving_entrance_pupil_is_taken_as_it_is() -> None:
    """CAHVORE: the ray's origin depends on the pixel, and the pixel on the range."""
    base = mer_navcam()
    eyes = []
    for eye in base.eyes:
        p = eye.camera.pinhole
        wide = CAHVORE(
            width_px=1024,
            height_px=1024,
            C=np.zeros(3),
            A=np.array([0, 0, 1.0]),
            H=np.array([500.0, 0, p.cx_px]),
            V=np.array([0, 500.0, p.cy_px]),
            O=np.array([0, 0, 1.0]),
            R=np.array([0.0, 0.02, -0.01]),
            E=np.array([-0.03, 0.1, 0.0]),  # ten times a real one, so that it matters
            linearity=0.5,
        )
        eyes.append(Eye(name=eye.name, camera=wide, head_T_camera=eye.head_T_camera))
    rig = Rig(name="wide", pan_T_tilt=base.pan_T_tilt, eyes=tuple(eyes))
    options = replace(SMALL, noise_px=0.0, prior="truth", stops=1)
    simulation = simulate(rig, options, seed=1)
    solution = solve(simulation.traverse, SolveOptions(loss="none"), start=start_of(simulation))
    assert_truth(simulation, solution, angle=1e-8, pose=1e-8)


def two_groups(t: Traverse) -> Traverse:
    """Every track cut where it leaves the first two frames."""
    assert t.observations is not None
    obs = t.observations
    late = t.image_frame[obs.image] >= 2
    return t.with_observations(replace(obs, track=obs.track * 2 + late))


def test_warnings_tell_what_hangs_on_telemetry_alone() -> None:
    simulation = simulate(mer_navcam(), replace(SMALL, stops=1, pans=4), seed=0)
    t = two_groups(simulation.traverse)
    assert t.observations is not None
    blind = len(t.images) - 1
    kept = t.observations.select(t.observations.image != blind)
    extra = Observations(
        image=np.append(kept.image, 0),
        track=np.append(kept.track, 10**6),
        uv_px=np.vstack([kept.uv_px, [[5.0, 5.0]]]),
        sigma_px=np.append(kept.sigma_px, 0.3),
    )
    solution = solve(t.with_observations(extra))
    text = "\n".join(solution.warnings)
    assert f"1 image without a used observation: {t.images[blind].id}" in text
    assert "2 groups of frames share no track" in text
    assert "seen once" in text
    assert solution.reason[-1] == "single"
    assert solution.converged


def test_iteration_limit_is_not_convergence() -> None:
    simulation = simulate(mer_navcam(), SMALL, seed=0)
    solution = solve(simulation.traverse, SolveOptions(loss="none", max_iterations=1, relative_decrease=0.0))
    assert not solution.converged
    assert "limit of 1" in solution.stop_reason


def test_refusals() -> None:
    simulation = simulate(mer_navcam(), replace(SMALL, stops=1), seed=0)
    t = simulation.traverse
    assert t.observations is not None
    with pytest.raises(InputError, match="find_observations"):
        solve(replace(t, observations=None))
    single = t.with_observations(t.observations.select(np.array([0])))
    with pytest.raises(SolveError, match="two or more images"):
        solve(single)
    with pytest.raises(InputError, match=r"model: .*found 'ring'"):
        SolveOptions(model="ring")  # type: ignore[arg-type]  # the mistake under test
    with pytest.raises(InputError, match=r"loss: .*found 'tukey'"):
        SolveOptions(loss="tukey")  # type: ignore[arg-type]  # the mistake under test


def test_a_solution_says_in_five_lines_what_it_is() -> None:
    simulation = simulate(mer_navcam(), replace(SMALL, outliers=0.02), seed=5)
    solution = solve(simulation.traverse)
    first, counts, residuals, moved, warned = repr(solution).splitlines()
    assert first == f"Solution of {solution.traverse.name!r}: converged; its tests passed"
    assert f"{len(solution.landmark_track)} landmarks; model mast" in counts
    assert f"over {solution.used.sum()} of {len(solution.used)} observations" in residuals
    found = [float(word) for word in re.findall(r"[\d.]+", moved)]
    expected = 1e3 * np.median(np.abs(solution.correction_rad), axis=0)
    np.testing.assert_allclose(found[:2], expected, rtol=5e-3)
    assert f"{len(solution.warnings)} warnings" in warned
    assert repr(solution.traverse).startswith(f"Traverse {solution.traverse.name!r}: 2 stops, ")
