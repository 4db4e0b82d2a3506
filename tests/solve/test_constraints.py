"""Constraints in a solve: exact without noise, as theory says with it, in every way to solve."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pancam_graph import SolveOptions, Stop, Traverse, build_graph, graph_keys, solve
from pancam_graph.base.errors import InputError
from pancam_graph.data import (
    Constraint,
    LandmarkAzimuth,
    LandmarkDistance,
    LandmarkHeight,
    LandmarkInfinity,
    LandmarkPlane,
    LandmarkPosition,
    LandmarkSurface,
    StopDistance,
    StopHeading,
    StopPlacement,
    StopPose,
    StopPosition,
)
from pancam_graph.factors import Key, stop_heading_factor
from pancam_graph.simulate import Simulation
from pancam_graph.smoother import SmootherOptions, TraverseSmoother, solve_incrementally, stops_of
from pancam_graph.solve import Problem, constrained, prepare
from pancam_graph.solve._reduced import panels_of
from support.gtsam_factors import distance_factor
from support.parameters import slow_but_for, slow_for
from support.small_drives import HARD, SOFT, near_part, simulated
from support.tied_drives import landmark_ties, noise_free, seen_often

WAYS = {
    "hard": HARD,
    "explicit": replace(HARD, landmarks="explicit"),
    "soft": SOFT,
    "free": replace(HARD, model="free"),
}


def stop_ties(traverse: Traverse, true: tuple[gtsam.Pose3, ...]) -> tuple[Constraint, ...]:
    """One of each kind, of the true masts."""
    a, b = (stop.id for stop in traverse.stops[:2])
    position, forward = true[1].translation(), true[1].rotation().matrix()[:, 0]
    return (
        StopPosition(stop=b, position_m=(position[0], None, position[2]), sigma_m=(2e-3, None, 3e-3)),
        StopHeading(stop=b, heading_rad=float(np.arctan2(forward[1], forward[0])), sigma_rad=1e-4),
        StopDistance(
            between=(a, b), distance_m=float(np.linalg.norm(position - true[0].translation())), sigma_m=1e-3
        ),
        StopPose(between=(a, b), a_T_b=true[0].between(true[1]), covariance=1e-6 * np.eye(6)),
    )


@pytest.mark.parametrize("way", slow_but_for("hard", WAYS))
def test_constraints_are_the_same_as_factors_of_the_caller(way: str) -> None:
    simulation = simulated(2, 2)
    plain = near_part(simulation)
    _, two, three, four = stop_ties(plain, simulation.truth.world_T_mast)
    tied = solve(replace(plain, constraints=(two, three, four)), WAYS[way])
    keys = graph_keys(plain, WAYS[way])
    a, b = (keys.mast(stop.id) for stop in plain.stops[:2])
    assert isinstance(two, StopHeading)
    assert isinstance(three, StopDistance)
    assert isinstance(four, StopPose)
    factors = [
        stop_heading_factor(
            gtsam.noiseModel.Isotropic.Sigma(1, two.sigma), Key(b), heading_rad=two.heading_rad
        ),
        distance_factor(a, b, three.distance_m, three.sigma_m),
        gtsam.BetweenFactorPose3(a, b, four.a_T_b, gtsam.noiseModel.Gaussian.Covariance(four.covariance)),
    ]
    given = solve(plain, WAYS[way], factors=factors)
    assert tied.converged
    apart = given.final.world_T_mast[1].localCoordinates(tied.final.world_T_mast[1])
    sigma = np.sqrt(np.diag(given.stop_covariance[1]))
    assert np.abs(apart / sigma).max() < 1e-3
    assert tied.stop_covariance == pytest.approx(given.stop_covariance, rel=1e-3, abs=1e-12)


def test_a_position_by_axis_moves_the_stop_as_theory_says() -> None:
    """Theory: the update of a Kalman filter."""
    plain = near_part(simulated(2, 2))
    before = solve(plain, HARD)
    pose, P = before.final.world_T_mast[1], before.stop_covariance[1]
    wanted = pose.translation() + np.array([0.004, 0.0, -0.003])
    tie = StopPosition(
        stop=plain.stops[1].id, position_m=(wanted[0], None, wanted[2]), sigma_m=(2e-3, None, 3e-3)
    )
    after = solve(replace(plain, constraints=(tie,)), HARD)
    J = np.hstack([np.zeros((2, 3)), pose.rotation().matrix()[[0, 2]]])
    gain = P @ J.T @ np.linalg.inv(J @ P @ J.T + np.diag([4e-6, 9e-6]))
    step = gain @ [0.004, -0.003]
    size = np.sqrt(np.diag(P))
    moved = pose.localCoordinates(after.final.world_T_mast[1])
    assert np.abs((moved - step) / size).max() < 0.05 * np.abs(step / size).max()
    expected = P - gain @ J @ P
    assert np.abs((after.stop_covariance[1] - expected) / np.outer(size, size)).max() < 0.05


def test_an_exact_distance_is_kept() -> None:
    plain = near_part(simulated(2, 2))
    tie = StopDistance(between=[stop.id for stop in plain.stops[:2]], distance_m=4.012, sigma_m=0.0)
    masts = solve(replace(plain, constraints=(tie,)), HARD).final.world_T_mast
    assert np.linalg.norm(masts[1].translation() - masts[0].translation()) == pytest.approx(4.012, abs=1e-5)


def test_stop_by_stop_ends_where_batch_does_and_the_graph_has_the_cost() -> None:
    simulation = simulated(2, 2)
    traverse = near_part(simulation)
    traverse = replace(traverse, constraints=stop_ties(traverse, simulation.truth.world_T_mast))
    batch, incremental = solve(traverse, HARD), solve_incrementally(traverse, HARD)
    apart = batch.final.world_T_mast[1].localCoordinates(incremental.final.world_T_mast[1])
    assert np.abs(apart / np.sqrt(np.diag(batch.stop_covariance[1]))).max() < 1e-3
    graph, _ = build_graph(traverse, HARD)
    without, _ = build_graph(replace(traverse, constraints=()), HARD)
    assert graph.size() == without.size() + 4


def test_a_smoother_with_ties_on_stops_is_where_batch_is() -> None:
    simulation = simulated(2, 2)
    traverse = near_part(simulation)
    ties = stop_ties(traverse, simulation.truth.world_T_mast)
    smoother = TraverseSmoother(traverse.rig, SmootherOptions(rig="held", outlier_sigma=None))
    for part in stops_of(traverse):
        smoother.add_stop(*part)
    before = smoother.estimate().world_T_mast[1]
    smoother.add_constraints(ties)
    batch = solve(replace(traverse, constraints=ties), HARD)
    sigma = np.sqrt(np.diag(batch.stop_covariance[1]))
    apart = batch.final.world_T_mast[1].localCoordinates(smoother.estimate().world_T_mast[1])
    assert np.abs(apart / sigma).max() < 1e-2
    assert np.abs(batch.final.world_T_mast[1].localCoordinates(before) / sigma).max() > 0.3
    off = smoother.covariance(traverse.stops[1].id) - batch.stop_covariance[1]
    assert np.abs(off / np.outer(sigma, sigma)).max() < 1e-2
    with pytest.raises(
        InputError, match=r"constraints\[0\] .*: expected a tie on stops or frames, found one on terrain"
    ):
        smoother.add_constraints(landmark_ties(simulated(2, 3))[:1])
    with pytest.raises(InputError, match="found stop0000 held by sigma 0"):
        smoother.add_constraints([StopHeading(stop="stop0000", heading_rad=0.0, sigma_rad=0.1)])


def test_stop_by_stop_ends_where_batch_does_with_ties_of_points() -> None:
    simulation = simulated(2, 3)
    traverse = replace(simulation.traverse, constraints=landmark_ties(simulation, sigma=5e-3))
    batch, incremental = solve(traverse, HARD), solve_incrementally(traverse, HARD)
    for stop in (1, 2):
        apart = batch.final.world_T_mast[stop].localCoordinates(incremental.final.world_T_mast[stop])
        assert np.abs(apart / np.sqrt(np.diag(batch.stop_covariance[stop]))).max() < 1e-2
    assert incremental.verdict is not None
    assert {t.name for t in incremental.verdict.tests} >= {"constraints"}


def test_a_stop_that_telemetry_holds_cannot_be_tied() -> None:
    traverse = near_part(simulated(2, 2))
    with pytest.raises(InputError, match="found stop0000 held by sigma 0"):
        replace(traverse, constraints=(StopHeading(stop="stop0000", heading_rad=0.0, sigma_rad=0.1),))


def test_a_distance_that_is_not_a_number_is_refused() -> None:
    with pytest.raises(InputError, match="distance_m: expected a finite number, found nan"):
        StopDistance(between=("a", "b"), distance_m=float("nan"), sigma_m=0.1)


def system_cost(problem: Problem) -> float:
    """Cost with landmarks where they fit best, up to the last digits."""
    for _ in range(3):
        problem = problem.placed()
    return problem.cost()


@pytest.mark.parametrize("state", slow_for("random", ["random", "near the optimum", "far"]))
def test_the_gradient_of_tied_landmarks_is_that_of_the_cost(state: str) -> None:
    """Of the cost with landmarks eliminated, by the masts: analytic in the kernel against differences."""
    simulation = simulated(2, 3)
    traverse = replace(simulation.traverse, constraints=landmark_ties(simulation, sigma=0.02))
    prepared = prepare(traverse, HARD)
    assert prepared.problem.ties is None
    problem = constrained(prepared.problem)
    assert problem.ties is not None
    link, rng = problem.template.linkage, np.random.default_rng(3)
    size = {"random": 1e-2, "near the optimum": 1e-7, "far": 0.1}[state]
    start = gtsam.VectorValues()
    for key, dim in zip(link.key, link.dim.tolist(), strict=True):
        start.insert(key, size * rng.normal(size=dim))
    problem = replace(problem, values=problem.values.retract(start)).placed().placed()
    panels = panels_of(problem)
    for key in [graph_keys(traverse, HARD).mast(stop.id) for stop in traverse.stops[1:]]:
        group, columns = int(link.group[link.row[key]]), link.columns_of(key)
        gradient = panels.panel[group][columns, -1]
        for k in range(6):
            ends = []
            for h in (1e-5, -1e-5):
                step = gtsam.VectorValues()
                step.insert(key, h * np.eye(6)[k])
                ends.append(system_cost(replace(problem, values=problem.values.retract(step))))
            numeric = (ends[0] - ends[1]) / 2e-5
            assert gradient[k] == pytest.approx(numeric, rel=1e-3, abs=1e-4 * np.abs(gradient).max())


def distance_of(simulation: Simulation, sigma: float) -> LandmarkDistance:
    a, b = seen_often(simulation, 2)
    true = simulation.truth.landmarks_m
    return LandmarkDistance(
        between=(a, b), distance_m=float(np.linalg.norm(true[a] - true[b])), sigma_m=sigma
    )


def test_points_that_are_variables_change_nothing_and_an_exact_distance_of_them_is_kept() -> None:
    simulation = simulated(2, 3)
    options = replace(HARD, landmark_covariances=True)
    loose = distance_of(simulation, 10.0)
    plain = solve(simulation.traverse, options)
    tied = solve(replace(simulation.traverse, constraints=(loose,)), options)
    for stop in (1, 2):
        apart = plain.final.world_T_mast[stop].localCoordinates(tied.final.world_T_mast[stop])
        assert np.abs(apart / np.sqrt(np.diag(plain.stop_covariance[stop]))).max() < 1e-3
        assert tied.stop_covariance[stop] == pytest.approx(plain.stop_covariance[stop], rel=1e-3, abs=1e-12)
    rows = [int(np.flatnonzero(plain.landmark_track == track)[0]) for track in loose.between]
    assert tied.landmark_covariance_m2 is not None
    assert plain.landmark_covariance_m2 is not None
    for row in rows:
        ratio = np.diag(tied.landmark_covariance_m2[row]) / np.diag(plain.landmark_covariance_m2[row])
        assert ratio == pytest.approx(1.0, abs=2e-3)
    found = float(np.linalg.norm(np.subtract(*plain.final.landmarks_m[rows])))
    exact = replace(loose, distance_m=found + 0.002, sigma_m=0.0)
    after = solve(replace(simulation.traverse, constraints=(exact,)), options)
    assert after.converged
    between = np.linalg.norm(np.subtract(*after.final.landmarks_m[rows]))
    assert between == pytest.approx(found + 0.002, abs=5e-5)


def test_a_stops_pose_with_its_covariance_is_as_theory_says() -> None:
    plain = near_part(simulated(2, 2))
    before = solve(plain, HARD)
    pose, P = before.final.world_T_mast[1], before.stop_covariance[1]
    told = pose.retract(np.array([2e-4, -1e-4, 3e-4, 0.001, 0.002, -0.001]))
    root = np.diag([1e-3] * 3 + [2e-3] * 3) @ (np.eye(6) + 0.3 * np.tri(6))
    tie = StopPlacement(stop=plain.stops[1].id, world_T_mast=told, covariance=root @ root.T)
    after = solve(replace(plain, constraints=(tie,)), HARD)
    gain = P @ np.linalg.inv(P + root @ root.T)
    size, step = np.sqrt(np.diag(P)), gain @ pose.localCoordinates(told)
    moved = pose.localCoordinates(after.final.world_T_mast[1])
    assert np.abs((moved - step) / size).max() < 0.05 * np.abs(step / size).max()
    assert np.abs((after.stop_covariance[1] - (P - gain @ P)) / np.outer(size, size)).max() < 0.05


def test_a_surface_that_does_not_cover_its_point_is_refused_in_one_sentence() -> None:
    simulation = simulated(2, 3)
    tie = next(one for one in landmark_ties(simulation) if isinstance(one, LandmarkSurface))
    holed = np.where(np.eye(33, dtype=bool), np.nan, tie.surface.height_m)
    assert not tie.surface.covers(np.zeros((1, 2)))[0]  # it is not where the world's origin is
    for changed in ({"first_m": tie.surface.first_m + 100.0}, {"height_m": holed}):
        tied = replace(tie, surface=replace(tie.surface, **changed))
        with pytest.raises(
            InputError, match=r"constraints\[0\] .*: expected a surface with heights .* at x "
        ):
            solve(replace(simulation.traverse, constraints=(tied,)), HARD)


def loosened(stop: Stop) -> Stop:
    return replace(stop, sigma_translation_m=1e3, sigma_rotation_rad=10.0)


def test_true_ties_and_pixels_without_noise_give_the_truth_whatever_telemetry_says() -> None:
    simulation = simulated(2, 3)
    traverse = replace(noise_free(simulation), constraints=landmark_ties(simulation, sigma=1e-5))
    stops = [traverse.stops[0], *(loosened(stop) for stop in traverse.stops[1:])]
    frames = [replace(f, sigma_pan_rad=1.0, sigma_tilt_rad=1.0) for f in traverse.frames]
    solution = solve(replace(traverse, stops=tuple(stops), frames=tuple(frames)), HARD)
    assert solution.converged
    rotations, centres = traverse.camera_poses(simulation.truth.world_T_mast, simulation.truth.pan_tilt_rad)
    assert np.abs(solution.final.world_t_camera - centres).max() < 1e-5
    assert np.abs(solution.final.world_R_camera - rotations).max() < 1e-5


def test_a_tied_point_and_its_sigma_are_as_theory_says() -> None:
    """Theory: the update of a Kalman filter on the point's own covariance."""
    simulation = simulated(2, 3)
    landmark = seen_often(simulation, 1)[0]
    options = replace(HARD, landmark_covariances=True)
    before = solve(simulation.traverse, options)
    i = int(np.flatnonzero(before.landmark_track == landmark)[0])
    assert before.landmark_covariance_m2 is not None
    P, point = before.landmark_covariance_m2[i], before.final.landmarks_m[i]
    off, R = np.array([2e-4, -1e-4, 1e-4]), np.diag([1e-6, 2e-6, 3e-6])
    tie = LandmarkPosition(landmark=landmark, position_m=tuple(point + off), covariance_m2=R)
    after = solve(replace(simulation.traverse, constraints=(tie,)), options)
    gain = P @ np.linalg.inv(P + R)
    assert after.landmark_covariance_m2 is not None
    size = np.sqrt(np.diag(P))
    expected = P - gain @ P
    assert np.abs((after.landmark_covariance_m2[i] - expected) / np.outer(size, size)).max() < 0.02
    moved = after.final.landmarks_m[i] - point
    assert np.abs(moved - gain @ off).max() < 0.05 * np.abs(gain @ off).max()


def test_a_point_at_infinity_stays_there() -> None:
    simulation = simulated(2, 3)
    tie = LandmarkInfinity(landmark=seen_often(simulation, 1)[0])
    solution = solve(replace(simulation.traverse, constraints=(tie,)), HARD)
    assert solution.verdict is not None  # that it is a near point, the verdict says
    assert any("landmark-infinity" in test.says for test in solution.verdict.failures)


def with_gross(ties: tuple[Constraint, ...], which: int, *, robust: bool) -> tuple[Constraint, ...]:
    """The ties with one wrong by far more than its sigma."""
    tie = ties[which]
    if isinstance(tie, LandmarkPosition):
        known = [None if x is None else x + 0.3 for x in tie.position_m]
        wrong: Constraint = replace(tie, position_m=known)
    elif isinstance(tie, LandmarkHeight):
        wrong = replace(tie, height_m=tie.height_m + 0.3)
    elif isinstance(tie, LandmarkPlane):
        wrong = replace(tie, offset_m=tie.offset_m + 0.3)
    elif isinstance(tie, LandmarkSurface):
        wrong = replace(tie, surface=replace(tie.surface, height_m=tie.surface.height_m + 0.3))
    elif isinstance(tie, LandmarkDistance):
        wrong = replace(tie, distance_m=tie.distance_m + 0.3)
    else:
        assert isinstance(tie, LandmarkAzimuth)
        wrong = replace(tie, azimuth_rad=tie.azimuth_rad + 0.1)
    return tuple(replace(wrong if i == which else one, robust=robust) for i, one in enumerate(ties))


@pytest.mark.parametrize(
    "which", [0, *(pytest.param(i, marks=pytest.mark.slow) for i in (1, 2, 3, 4, 5, 7, 8))]
)
def test_a_gross_tie_is_found_named_and_let_go(which: int) -> None:
    simulation = simulated(2, 3)
    ties = landmark_ties(simulation)
    robust = solve(
        replace(simulation.traverse, constraints=with_gross(ties, which, robust=True)),
        SolveOptions(rig="held"),
    )
    assert robust.verdict is not None
    note = next(test for test in robust.verdict.tests if test.name == "constraints let go")
    assert robust.verdict.passed
    assert f"constraints[{which}] ({ties[which].about})" in note.says
    assert any(f"constraints[{which}]" in warning for warning in robust.warnings)
    others = tuple(one for i, one in enumerate(ties) if i != which)
    without = solve(replace(simulation.traverse, constraints=others), SolveOptions(rig="held"))
    apart = without.final.world_T_mast[2].localCoordinates(robust.final.world_T_mast[2])
    assert np.abs(apart / np.sqrt(np.diag(without.stop_covariance[2]))).max() < 0.05


def test_a_gross_tie_that_is_not_said_to_be_doubtful_fails_the_verdict() -> None:
    simulation = simulated(2, 3)
    ties = with_gross(landmark_ties(simulation), 3, robust=False)
    verdict = solve(replace(simulation.traverse, constraints=ties), SolveOptions(rig="held")).verdict
    assert verdict is not None
    (failure,) = verdict.failures
    assert failure.name == "constraints let go"
    assert "constraints[3] (landmark-height" in failure.says


def test_ties_need_landmarks_that_are_eliminated_and_points_that_two_images_see() -> None:
    simulation = simulated(2, 3)
    ties = landmark_ties(simulation)[:1]
    with pytest.raises(InputError, match=r"constraints\[0\] .*: expected the model mast, a hard tie"):
        solve(replace(simulation.traverse, constraints=ties), replace(HARD, landmarks="explicit"))
    t = simulation.traverse
    assert t.observations is not None
    of_point = np.flatnonzero(t.observations.track == ties[0].landmarks[0])
    rows = np.setdiff1d(np.arange(len(t.observations)), of_point[1:])
    once = replace(t, observations=t.observations.select(rows), constraints=ties)
    with pytest.raises(InputError, match="expected a point that two or more images see, found it in fewer"):
        solve(once, HARD)
