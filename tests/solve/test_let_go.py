"""Telemetry that is wrong: it is let go and named, all else ends within its sigmas; or the verdict fails."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, Traverse, simulate, solve
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Solution, State, VerdictTest
from pancam_graph.graph import RIGID, HardTemplate, LetGo, SoftTemplate
from pancam_graph.rigs import TEMPLATES
from pancam_graph.simulate import Simulation
from pancam_graph.smoother._incremental import solve_incrementally
from pancam_graph.solve import judge, prepare, reconsidered, screen
from pancam_graph.solve._let_go import letting_go
from pancam_graph.solve._telemetry_tests import Suspected
from support.parameters import slow_but_for
from support.solving import fitted
from support.truth import errors_in_sigmas

DRIVE = SimulationOptions(stops=2, pans=9, points_per_image=20)
LONELY = replace(DRIVE, stops=1, pans=7, points_per_image=15)
"""Frames whose neighbours are one above or below."""
Solve = Callable[[Traverse, SolveOptions], Solution]


@cache
def drive(seed: int = 3, options: SimulationOptions = DRIVE, rig: str = "mer-navcam") -> Simulation:
    return simulate(TEMPLATES[rig](), options, seed=seed)


def off(traverse: Traverse, rows: Sequence[int], *, pan: float = 0.0, tilt: float = 0.0) -> Traverse:
    """The traverse with the pans and tilts of some frames off, degrees."""
    frames = list(traverse.frames)
    for i in rows:
        pan_rad, tilt_rad = frames[i].pan_rad + np.deg2rad(pan), frames[i].tilt_rad + np.deg2rad(tilt)
        frames[i] = replace(frames[i], pan_rad=float(pan_rad), tilt_rad=float(tilt_rad))
    return replace(traverse, frames=tuple(frames))


def shifted(traverse: Traverse, first: int, shift_m: Sequence[float]) -> Traverse:
    """The traverse with all stops from one on shifted."""
    stops = list(traverse.stops)
    for i in range(first, len(stops)):
        pose = stops[i].world_T_mast
        moved = gtsam.Pose3(pose.rotation(), pose.translation() + np.array(shift_m))
        stops[i] = replace(stops[i], world_T_mast=moved)
    return replace(traverse, stops=tuple(stops))


def verdict_test(solution: Solution, name: str) -> VerdictTest | None:
    assert solution.verdict is not None
    return next((test for test in solution.verdict.tests if test.name == name), None)


def let_go(solution: Solution) -> str:
    """What the verdict says was let go; "" for nothing."""
    test = verdict_test(solution, "let go")
    assert test is not None
    return test.says if test.value else ""


def require_within_sigmas(simulation: Simulation, solution: Solution) -> None:
    angles, stops = errors_in_sigmas(simulation, solution)
    assert solution.passed
    assert np.abs(angles).max() < 5
    assert np.mean(angles**2) < 1.6
    assert stops.max(initial=0.0) < 3


def test_right_telemetry_is_all_believed() -> None:
    simulation = drive()
    fit = fitted(simulation.traverse, SolveOptions())
    judged = judge(fit)
    assert reconsidered(judged) is judged
    assert not fit.problem.template.let_go


@pytest.mark.parametrize(
    ("how", "pan", "tilt"),
    slow_but_for(
        [(solve, 10.0, 0.0), (solve_incrementally, 0.0, 0.6)],
        [
            (how, *error)
            for how in (solve, solve_incrementally)
            for error in [(1.0, 0.0), (0.0, 0.6), (10.0, 0.0), (-3.0, 3.0)]
        ],
    ),
)
def test_a_frame_that_points_elsewhere_is_let_go_and_named(how: Solve, pan: float, tilt: float) -> None:
    simulation = drive()
    wrong = off(simulation.traverse, [4], pan=pan, tilt=tilt)
    solution = how(wrong, SolveOptions())
    require_within_sigmas(simulation, solution)
    assert ("the pan of frame00004" in let_go(solution)) == (pan != 0)
    assert ("the tilt of frame00004" in let_go(solution)) == (tilt != 0)
    assert any("frame00004" in w and w.endswith("let go") for w in solution.warnings)
    assert solution.traverse is wrong


@pytest.mark.slow
@pytest.mark.parametrize(("model", "named"), [("circle", True), ("free", False)])
def test_in_other_models_it_does_no_harm(model: str, named: bool) -> None:
    """Independent cameras hardly follow telemetry, and take it for no more than the sigma of their tie."""
    simulation = drive(options=replace(DRIVE, stops=1))
    options = SolveOptions(model=model)  # type: ignore[arg-type]  # by name
    solution = solve(off(simulation.traverse, [4], pan=3.0), options)
    assert ("the pan of frame00004" in let_go(solution)) == named
    error = solution.final.pan_tilt_rad - simulation.truth.pan_tilt_rad
    assert np.abs(error / solution.angle_sigma_rad).max() < 6


def test_of_two_frames_that_only_see_each_other_both_are_let_go() -> None:
    """Nothing tells which is wrong: the sum of both corrections is known, each alone is not."""
    simulation = drive(52, LONELY, "exomars-pancam")
    solution = solve(off(simulation.traverse, [10], pan=3.0))
    require_within_sigmas(simulation, solution)
    assert "the pan of frame00003" in let_go(solution)
    assert "the pan of frame00010" in let_go(solution)
    assert solution.angle_sigma_rad[[3, 10], 0].min() > np.deg2rad(1.0)


@pytest.mark.slow
def test_pans_of_a_stop_in_common_and_all_that_looks_alike_are_let_go() -> None:
    simulation = drive(options=replace(DRIVE, sigma_stop_rad=1e-3))
    of_second = np.flatnonzero(simulation.traverse.frame_stop == 1).tolist()
    solution = solve(off(simulation.traverse, of_second, pan=1.0))
    require_within_sigmas(simulation, solution)
    assert "every pan at stop0001, in common" in let_go(solution)
    assert "the heading of stop0001" in let_go(solution)


@pytest.mark.slow
def test_a_leg_is_let_go() -> None:
    simulation = drive(options=replace(DRIVE, stops=4, pans=6))
    solution = solve(shifted(simulation.traverse, 2, (0.0, 0.7, 0.0)))
    require_within_sigmas(simulation, solution)
    assert "the position of stop0002 and of all stops up to stop0003" in let_go(solution)


@pytest.mark.parametrize("rig", slow_but_for("mer-navcam", ["mer-navcam", "exomars-pancam"]))
def test_pixels_of_a_frame_that_are_shifted_are_not_taken_for_its_pointing(rig: str) -> None:
    traverse = drive(rig=rig).traverse
    observations = traverse.observations
    assert observations is not None
    uv_px = observations.uv_px.copy()
    uv_px[traverse.image_frame[observations.image] == 4] += [20.0, 0.0]
    assert not solve(traverse.with_observations(replace(observations, uv_px=uv_px))).passed


@pytest.mark.slow
def test_where_too_much_is_wrong_nothing_is_let_go() -> None:
    traverse, rng = drive().traverse, np.random.default_rng(1)
    for i in range(len(traverse.frames)):
        traverse = off(traverse, [i], pan=float(rng.choice([-1.0, 1.0])))
    solution = solve(traverse)
    assert not solution.passed
    assert not let_go(solution)


def test_a_wrong_rig_is_not_taken_for_wrong_telemetry() -> None:
    solution = solve(drive(54, replace(DRIVE, focal_error=2e-3)).traverse, SolveOptions(rig="held"))
    assert not solution.passed
    assert not let_go(solution)


def test_a_frame_is_turned_to_where_its_links_agree() -> None:
    """Screening alone: from 10 degrees off, with the prior still as stated at the end."""
    simulation = drive()
    screened = screen(prepare(off(simulation.traverse, [4], pan=10.0), SolveOptions()))
    problem = screened.problem
    pan = problem.template.state(problem.values, np.zeros((0, 3))).pan_tilt_rad[4, 0]
    assert pan == pytest.approx(simulation.truth.pan_tilt_rad[4, 0], abs=2e-3)
    assert problem.accepted.mean() > 0.98
    assert not problem.template.let_go


def test_an_error_of_telemetry_is_estimated() -> None:
    simulation = drive()
    fit = fitted(off(simulation.traverse, [4], pan=2.0), SolveOptions())
    judged = judge(fit)
    worst = Suspected.of(judged.regular, judged.uncertainty, is_far=False).angles.largest
    wrong = fit.screened.prepared.traverse.frames[4].pan_rad
    assert (worst.entry, worst.frame) == ("pan", 4)
    assert worst.error == pytest.approx(simulation.truth.pan_tilt_rad[4, 0] - wrong, abs=2e-3)
    assert letting_go(fit.screened.prepared.traverse, [worst]).angles_rad[4, 0] > abs(worst.error)


def test_hard_and_soft_ties_have_the_same_priors() -> None:
    """Single and common errors let go: the same cost at the same state, and as the covariance says."""
    traverse, rng = drive().traverse, np.random.default_rng(2)
    nothing = LetGo.nothing(traverse)
    angles, common = nothing.angles_rad.copy(), nothing.common_rad.copy()
    angles[3], common[1, 0] = (0.02, 0.0), 0.03
    some = replace(nothing, angles_rad=angles, common_rad=common)
    pans = traverse.pan_tilt_rad + 1e-3 * rng.standard_normal(angles.shape)
    state = _state(traverse, pans)
    costs = []
    for template in (HardTemplate(traverse), SoftTemplate(traverse, "mast", RIGID)):
        factors = template.letting_go(some).factors()
        values = template.values(state)
        costs.append(sum(factor.error(values) for factor in factors.telemetry))
    error, sigma = pans - traverse.pan_tilt_rad, np.array([f.sigmas_rad for f in traverse.frames])
    covariance = np.diag((sigma**2 + angles**2).ravel())
    of_second = 2 * np.flatnonzero(traverse.frame_stop == 1)
    covariance[np.ix_(of_second, of_second)] += 0.03**2
    expected = 0.5 * error.ravel() @ np.linalg.solve(covariance, error.ravel())
    assert costs == pytest.approx([expected, expected], rel=1e-9)


def _state(traverse: Traverse, pan_tilt_rad: FloatArray) -> State:
    rotations, centres = traverse.camera_poses(pan_tilt_rad=pan_tilt_rad)
    return State(
        world_T_mast=tuple(stop.world_T_mast for stop in traverse.stops),
        pan_tilt_rad=pan_tilt_rad,
        world_R_camera=rotations,
        world_t_camera=centres,
        landmarks_m=np.zeros((0, 3)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("how", [solve, solve_incrementally])
@pytest.mark.parametrize("rig", ["mer-navcam", "exomars-pancam"])
@pytest.mark.parametrize("options", [DRIVE, LONELY])
def test_no_wrong_pointing_passes_with_a_large_error(
    how: Solve, rig: str, options: SimulationOptions
) -> None:
    """Over 20 seeds of each size: never an error above 6 sigma with a verdict that passes.

    Squared errors over variances are as those of the same drives with right telemetry. Where two frames see
    only each other, half a degree (6.5 sigma) is no more than chance explains.
    """
    smallest = 0.5 if options is DRIVE else 1.0
    squares, right = [], []
    for seed in range(700, 720):
        simulation = drive(seed, options, rig)
        right.append(np.mean(errors_in_sigmas(simulation, how(simulation.traverse, SolveOptions()))[0] ** 2))
        rng = np.random.default_rng(seed)
        frame = int(rng.integers(len(simulation.traverse.frames)))
        for pan, tilt in ((smallest, 0.0), (3.0, 0.0), (10.0, 0.0), (0.0, smallest), (0.0, 3.0)):
            solution = how(off(simulation.traverse, [frame], pan=pan, tilt=tilt), SolveOptions())
            if solution.passed:
                angles, stops = errors_in_sigmas(simulation, solution)
                assert np.abs(angles).max() < 6, (seed, pan, tilt)
                assert stops.max(initial=0.0) < 4, (seed, pan, tilt)
                squares.append(np.mean(angles**2))
    assert len(squares) > 70
    assert np.mean(squares) == pytest.approx(np.mean(right), abs=0.15)
