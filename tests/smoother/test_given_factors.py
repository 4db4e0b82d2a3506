"""Factors of the caller's in a drive that is followed stop by stop."""

from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest

from pancam_graph import (
    SimulationOptions,
    SmootherOptions,
    SolveOptions,
    Traverse,
    TraverseSmoother,
    graph_keys,
    simulate,
    solve,
)
from pancam_graph.base.errors import InputError
from pancam_graph.rigs import mer_navcam
from pancam_graph.smoother._incremental import solve_incrementally, stops_of
from support.gtsam_factors import distance_factor

KEPT = SmootherOptions(outlier_sigma=None)
TO_THE_END = SolveOptions(loss="none", relative_decrease=1e-12)


@cache
def drive() -> Traverse:
    options = SimulationOptions(stops=4, pans=3, sweep_rad=1.5, points_per_image=15)
    return simulate(mer_navcam(), options, seed=3).traverse


def followed(n_stops: int | None = None) -> TraverseSmoother:
    smoother = TraverseSmoother(drive().rig, KEPT)
    for stop, frames, images, observations in list(stops_of(drive()))[:n_stops]:
        smoother.add_stop(stop, frames, images, observations)
    return smoother


def factors_of(traverse: Traverse) -> list[gtsam.NonlinearFactor]:
    """A distance between the first and the last stop, a place of the third, and the pan of a frame."""
    keys = graph_keys(traverse)
    masts = [keys.mast(stop.id) for stop in traverse.stops]
    first, third, last = (traverse.stops[i].world_T_mast for i in (0, 2, 3))
    length = float(np.linalg.norm(last.translation() - first.translation()))
    place = gtsam.Pose3(third.rotation(), third.translation() + np.array([0.05, 0.02, -0.1]))
    sigmas = np.array([10.0, 10.0, 10.0, 0.01, 0.01, 0.002])
    angles = traverse.pan_tilt_rad[4] + [1e-3, 0.0]
    return [
        distance_factor(masts[0], masts[3], length + 0.1, 5e-3),
        gtsam.PriorFactorPose3(masts[2], place, gtsam.noiseModel.Diagonal.Sigmas(sigmas)),
        gtsam.PriorFactorVector(
            keys.angles(traverse.frames[4].id), angles, gtsam.noiseModel.Isotropic.Sigma(2, 1e-4)
        ),
    ]


def apart(smoother: TraverseSmoother, poses: tuple[gtsam.Pose3, ...]) -> float:
    pairs = zip(smoother.estimate().world_T_mast, poses, strict=True)
    return max(float(np.abs(b.localCoordinates(a)).max()) for a, b in pairs)


def test_the_estimate_is_that_of_a_batch_with_the_factors() -> None:
    batch = solve(drive(), TO_THE_END, factors=factors_of(drive()))
    without = solve(drive(), TO_THE_END)
    smoother = followed()
    before = smoother.cost
    update = smoother.add_factors(factors_of(drive()))
    assert smoother.keys.mast(drive().stops[2].id) == graph_keys(drive()).mast(drive().stops[2].id)
    assert update.cost == smoother.cost > before
    assert smoother.cost == pytest.approx(batch.cost_final, rel=1e-4)
    moved = apart(smoother, without.final.world_T_mast)
    assert apart(smoother, batch.final.world_T_mast) < 0.02 * moved
    ids = [stop.id for stop in drive().stops]
    for i in (1, 2, 3):
        assert smoother.covariance(ids[i]) == pytest.approx(
            batch.stop_covariance[i], rel=0.02, abs=0.01 * np.abs(batch.stop_covariance[i]).max()
        )
    assert smoother.relative_covariance(ids[2], ids[3]) == pytest.approx(
        batch.relative_covariance(ids[2], ids[3]), rel=0.05, abs=1e-7
    )


@pytest.mark.slow
def test_stops_added_later_hang_on_the_factors() -> None:
    """Factors on the first three stops, then the fourth stop: the same as all at once."""
    some = factors_of(drive())[1:]
    batch = solve(drive(), TO_THE_END, factors=some)
    smoother = followed(3)
    smoother.add_factors(some)
    stop, frames, images, observations = list(stops_of(drive()))[3]
    smoother.add_stop(stop, frames, images, observations)
    assert smoother.cost == pytest.approx(batch.cost_final, rel=1e-3)
    assert apart(smoother, batch.final.world_T_mast) < 2e-3


def test_observations_that_were_removed_come_back_under_the_factors(tmp_path: Path) -> None:
    smoother = followed(3)
    some = factors_of(drive())[1:]
    smoother.add_factors(some[:1])
    observations = smoother.traverse.observations
    assert observations is not None
    cost, covariance = smoother.cost, smoother.covariance(drive().stops[2].id)
    back = observations.select(np.arange(len(observations)) % 7 == 3)
    smoother.remove(back)
    assert smoother.cost < cost
    smoother.add_observations(back)
    assert smoother.cost == pytest.approx(cost, rel=1e-4)
    assert smoother.covariance(drive().stops[2].id) == pytest.approx(covariance, rel=1e-3, abs=1e-10)
    again = smoother.traverse.observations
    assert again is not None
    assert np.array_equal(again.uv_px, observations.uv_px)
    smoother.add_factors(some[1:])
    smoother.save(tmp_path / "drive.npz")
    loaded = TraverseSmoother.load(tmp_path / "drive.npz", some)
    assert loaded.cost == pytest.approx(smoother.cost, rel=1e-6)


def test_a_kept_drive_goes_on_with_the_factors(tmp_path: Path) -> None:
    smoother = followed(3)
    some = factors_of(drive())[1:]
    smoother.add_factors(some)
    smoother.save(tmp_path / "drive.npz")
    again = TraverseSmoother.load(tmp_path / "drive.npz", some)
    assert again.cost == pytest.approx(smoother.cost, rel=1e-6)
    with pytest.raises(InputError, match=r"factors: expected the 2 that were added .*, found 0"):
        TraverseSmoother.load(tmp_path / "drive.npz")


@pytest.mark.slow
def test_the_incremental_solution_counts_them() -> None:
    batch = solve(drive(), TO_THE_END, factors=factors_of(drive()))
    solution = solve_incrementally(drive(), TO_THE_END, factors=factors_of(drive()))
    assert solution.cost_final == pytest.approx(batch.cost_final, rel=1e-3)
    assert solution.incremental is not None
    assert len(solution.incremental.cost_per_stop) == len(drive().stops)
    assert solution.stop_covariance[3] == pytest.approx(
        batch.stop_covariance[3], rel=0.05, abs=0.01 * np.abs(batch.stop_covariance[3]).max()
    )


def test_a_bad_factor_is_told_and_changes_nothing() -> None:
    smoother = followed(2)
    before = smoother.cost
    with pytest.raises(InputError, match=r"factor 0 .* found M3; is M1, the mast of stop0001, meant"):
        smoother.add_factors(factors_of(drive()))
    assert smoother.cost == before
    assert smoother.state().n_given == 0
    with pytest.raises(InputError, match="expected at least one stop"):
        _ = TraverseSmoother(drive().rig, KEPT).keys
