"""The whole graph for GTSAM's own optimisers, and covariances between stops from `solve`."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from pancam_graph import (
    Freedom,
    Sharing,
    Solution,
    SolveOptions,
    Traverse,
    build_graph,
    graph_keys,
    simulate,
    solve,
)
from pancam_graph.base.errors import InputError
from pancam_graph.data import RigTreatment
from pancam_graph.rigs import mer_navcam
from support.parameters import slow_for
from support.small_drives import HARD, SMALL, SOFT, near_part, simulated

POINTS = 6
"""Points per image of the drive that GTSAM solves: its time grows with them, what is compared does not."""
FOCAL = Freedom(scope="all", free=("focal",))
WAYS = {
    "hard": HARD,
    "hard, free rig": replace(
        HARD,
        sharing=Sharing(calibration=FOCAL, mounts=Freedom(scope="eye"), pan_T_tilt=Freedom(scope="all")),
    ),
    "soft": SOFT,
    "soft, free calibration": replace(HARD, tie="soft", sharing=Sharing(calibration=FOCAL)),
    "circle": replace(HARD, model="circle"),
    "free": replace(HARD, model="free"),
}


def near() -> Traverse:
    """Three stops, of which the last two are free, and the landmarks near by."""
    return near_part(simulated(2, stops=3, points_per_image=POINTS))


@cache
def solved(way: str) -> Solution:
    return solve(near(), WAYS[way])


@cache
def by_gtsam(way: str) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = build_graph(near(), WAYS[way])
    return graph, gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()


@pytest.mark.parametrize("way", slow_for(["hard", "hard, free rig", "soft, free calibration"], WAYS))
def test_gtsams_own_levenberg_marquardt_ends_at_our_optimum(way: str) -> None:
    graph, values = by_gtsam(way)
    ours, keys = solved(way), graph_keys(near(), WAYS[way])
    assert ours.cost_initial > 100 * ours.cost_final
    assert graph.error(values) == pytest.approx(ours.cost_final, rel=1e-6)
    for stop, pose in zip(near().stops, ours.final.world_T_mast, strict=True):
        assert np.abs(pose.localCoordinates(values.atPose3(keys.mast(stop.id)))).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["estimated", "considered"])
def test_the_cost_is_that_of_solve_where_heads_flex(rig: RigTreatment) -> None:
    """At the solution, whose values are put under the keys of the graph; and it has no gradient there."""
    t, options = near(), replace(HARD, rig=rig)
    ours, keys = solve(t, options), graph_keys(t, options)
    assert ours.final.rig is not None
    assert ours.final.rig.flex is not None
    graph, values = build_graph(t, options)
    for stop, pose in zip(t.stops, ours.final.world_T_mast, strict=True):
        values.update(keys.mast(stop.id), pose)
    for i, frame in enumerate(t.frames):
        values.update(keys.angles(frame.id), ours.final.pan_tilt_rad[i])
        assert keys.entries(keys.flex(frame.id)) == ("twist_rad",)
        values.update(keys.flex(frame.id), ours.final.rig.flex[i, :1])
    for quantity, corrections in (
        (keys.calibration, {r.camera for r in ours.refined if r.quantity == "calibration"}),
        (keys.mount, {r.camera for r in ours.refined if r.quantity == "mounts"}),
    ):
        for camera in corrections:
            key = quantity(camera)
            name = {keys.calibration: "calibration", keys.mount: "mounts"}[quantity]
            of_it = [r.change for r in ours.refined if (r.quantity, r.camera) == (name, camera)]
            values.update(key, np.array(of_it))
    if axis := [r.change for r in ours.refined if r.quantity == "pan_T_tilt"]:
        values.update(keys.tilt_axis(), np.array(axis))
    for i, point in enumerate(ours.final.landmarks_m):
        if values.exists(key := gtsam.symbol("L", i)):
            values.update(key, point)
    assert graph.error(values) == pytest.approx(ours.cost_final, rel=1e-6)


def test_heads_that_do_not_flex_have_no_key() -> None:
    with pytest.raises(InputError, match="flex: expected it to be free, found it fixed"):
        graph_keys(near(), HARD).flex("frame00000")
    with pytest.raises(InputError, match=r"frame: expected one of frame00000, .*; found 'f'"):
        graph_keys(near()).flex("f")


@pytest.mark.parametrize("way", slow_for("hard", ["hard", "soft", "circle"]))
def test_covariance_between_stops_is_gtsams(way: str) -> None:
    """Of stops that share tracks and of the last and the first, which is held."""
    graph, values = by_gtsam(way)
    keys, ids = graph_keys(near(), WAYS[way]), [stop.id for stop in near().stops]
    masts = [keys.mast(ids[1]), keys.mast(ids[2])]
    joint = gtsam.Marginals(graph, values).jointMarginalCovariance(masts)
    expected = np.block([[joint.at(a, b) for b in masts] for a in masts])
    found = solved(way).stop_covariance_between(ids[1], ids[2])
    size = np.sqrt(np.diag(expected))
    assert np.abs((found - expected) / np.outer(size, size)).max() < 1e-4
    assert found[:6, :6] == pytest.approx(solved(way).stop_covariance[1], rel=1e-6, abs=1e-12)
    with_held = solved(way).stop_covariance_between(ids[0], ids[2])
    assert not with_held[:6].any()
    assert with_held[6:, 6:] == pytest.approx(found[6:, 6:], rel=1e-9, abs=1e-15)
    assert not solved(way).relative_covariance(ids[1], ids[1]).any()


def test_two_stops_are_better_known_to_each_other_than_from_far_away() -> None:
    """Odometry adds up along a drive: each stop's own covariance grows, that of neighbours does not."""
    options = replace(SMALL, stops=5, odometry=True)
    t = simulate(mer_navcam(), options, seed=3).traverse
    solution = solve(t, HARD)
    ids = [stop.id for stop in t.stops]
    relative = np.sqrt(np.trace(solution.relative_covariance(ids[3], ids[4])[3:, 3:]))
    assert relative < 0.7 * np.sqrt(np.trace(solution.stop_covariance[4][3:, 3:]))


def relative_square(seed: int) -> float:
    """Squared error of the third stop as the second sees it, over its covariance."""
    simulation = simulated(seed, stops=3)
    t, true = near_part(simulation), simulation.truth.world_T_mast
    solution = solve(t, HARD)
    masts = solution.final.world_T_mast
    error = masts[1].between(masts[2]).localCoordinates(true[1].between(true[2]))
    return float(error @ np.linalg.solve(solution.relative_covariance(t.stops[1].id, t.stops[2].id), error))


@pytest.mark.slow
def test_errors_between_stops_are_as_large_as_their_covariance_says() -> None:
    squares = [relative_square(seed) for seed in range(40, 44)]
    assert 0.4 < np.sum(squares) / (6 * len(squares)) < 1.8  # 24 degrees of freedom: 1 +- 0.29


@pytest.mark.slow
def test_errors_between_stops_are_as_large_as_their_covariance_says_over_many_seeds() -> None:
    squares = [relative_square(seed) for seed in range(200, 230)]
    assert 0.7 < np.sum(squares) / (6 * len(squares)) < 1.35  # 180 degrees of freedom: 1 +- 0.105


@pytest.mark.slow
def test_all_stops_and_frames_are_in_the_graph_held_ones_with_a_constraint() -> None:
    t = near()
    held = replace(t, frames=(replace(t.frames[0], sigma_pan_rad=0.0, sigma_tilt_rad=0.0), *t.frames[1:]))
    graph, values = build_graph(held, HARD)
    keys = graph_keys(held, HARD)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    mast, angles = keys.mast(held.stops[0].id), keys.angles(held.frames[0].id)
    assert found.atPose3(mast).equals(held.stops[0].world_T_mast, 1e-12)
    assert found.atVector(angles) == pytest.approx(held.pan_tilt_rad[0], abs=1e-12)
    assert all(values.exists(keys.angles(frame.id)) for frame in held.frames)


@pytest.mark.slow
def test_what_a_solution_used_is_taken_by_least_squares() -> None:
    t = near()
    assert t.observations is not None
    used = np.ones(len(t.observations), dtype=bool)
    used[t.observations.track == t.observations.track[0]] = False
    whole, _ = build_graph(t, HARD)
    graph, values = build_graph(t, replace(HARD, loss="huber"), used=used)
    assert whole.size() - graph.size() == int((~used).sum())
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    part = solve(t.with_observations(t.observations.select(used)), HARD)
    assert graph.error(found) == pytest.approx(part.cost_final, rel=1e-6)


def test_bad_input_is_told() -> None:
    with pytest.raises(InputError, match="expected the model mast, circle or free, found projective"):
        build_graph(near(), SolveOptions(rig="held", model="projective"))
    with pytest.raises(InputError, match=r"used: expected one entry for each of .* observations, found 3"):
        build_graph(near(), used=np.ones(3, dtype=bool))
    with pytest.raises(InputError, match=r"stop: expected one of stop0000, .*; found 'stop9'"):
        solved("hard").relative_covariance("stop9", "stop0001")
