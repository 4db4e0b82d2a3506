"""Constraints in a solve: exact without noise, as theory says with it, in every way to solve."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pancam_graph import Traverse, build_graph, graph_keys, solve
from pancam_graph.base.errors import InputError
from pancam_graph.data import Constraint, StopDistance, StopHeading, StopPose, StopPosition
from pancam_graph.factors import Key, stop_heading_factor
from pancam_graph.smoother import solve_incrementally
from support.gtsam_factors import distance_factor
from support.parameters import slow_but_for
from support.small_drives import HARD, SOFT, near_part, simulated

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
    tie = StopDistance(between=[stop.id for stop in plain.stops[:2]], distance_m=4.1, sigma_m=0.0)
    masts = solve(replace(plain, constraints=(tie,)), HARD).final.world_T_mast
    assert np.linalg.norm(masts[1].translation() - masts[0].translation()) == pytest.approx(4.1, abs=1e-6)


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


def test_a_stop_that_telemetry_holds_cannot_be_tied() -> None:
    traverse = near_part(simulated(2, 2))
    with pytest.raises(InputError, match="found stop0000 held by sigma 0"):
        replace(traverse, constraints=(StopHeading(stop="stop0000", heading_rad=0.0, sigma_rad=0.1),))


def test_a_distance_that_is_not_a_number_is_refused() -> None:
    with pytest.raises(InputError, match="distance_m: expected a finite number, found nan"):
        StopDistance(between=("a", "b"), distance_m=float("nan"), sigma_m=0.1)
