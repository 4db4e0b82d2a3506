"""Stop by stop where up to six tenths of the observations are wrong, and outliers judged again at the end."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pancam_graph import SimulationOptions, SmootherOptions, TraverseSmoother, simulate, solve
from pancam_graph.data import Traverse
from pancam_graph.rigs import TEMPLATES
from pancam_graph.simulate import Simulation
from pancam_graph.smoother import Update
from pancam_graph.smoother._incremental import solve_incrementally, stops_of
from pancam_graph.smoother._ledger import Fate
from support.truth import require_right


def simulated(
    share: float, *, seed: int, rig: str = "mer-navcam", stops: int = 2, min_views: int = 2
) -> Simulation:
    options = SimulationOptions(stops=stops, outliers=share, min_views=min_views)
    return simulate(TEMPLATES[rig](), options, seed=seed)


def with_guessed_sigmas(traverse: Traverse) -> Traverse:
    """The observations as if they were found in images: a sigma of one pixel is a guess."""
    observations = traverse.observations
    assert observations is not None
    guessed = replace(observations, origin="images", sigma_px=np.ones(len(observations)))
    return traverse.with_observations(guessed)


def driven(traverse: Traverse) -> tuple[TraverseSmoother, list[Update]]:
    smoother = TraverseSmoother(traverse.rig)
    return smoother, [smoother.add_stop(*part) for part in stops_of(traverse)]


def require_right_on_the_way(simulation: Simulation) -> None:
    """The smoother's own stops are within their sigmas, before the end judges the outliers again."""
    smoother, updates = driven(simulation.traverse)
    assert sum(u.rejected for u in updates) > 0.9 * simulation.truth.outlier.sum()
    require_stops(simulation, smoother)


def require_stops(simulation: Simulation, smoother: TraverseSmoother) -> None:
    """The stops so far are within three sigmas of the truth."""
    estimate = smoother.estimate()
    true_of = dict(zip((s.id for s in simulation.traverse.stops), simulation.truth.world_T_mast, strict=True))
    for stop, pose in zip(estimate.stops, estimate.world_T_mast, strict=True):
        covariance = smoother.covariance(stop)
        if covariance.any():
            error = true_of[stop].localCoordinates(pose)
            assert error @ np.linalg.solve(covariance, error) / 6 < 3**2


@pytest.mark.slow
def test_a_drive_with_given_sigmas_is_solved() -> None:
    simulation = simulated(0.6, seed=11, min_views=2)
    require_right(simulation, solve_incrementally(simulation.traverse))


@pytest.mark.slow
def test_a_drive_with_guessed_sigmas_is_solved() -> None:
    simulation = simulated(0.5, seed=12, min_views=3)
    require_right(simulation, solve_incrementally(with_guessed_sigmas(simulation.traverse)))


@pytest.mark.slow
def test_each_stop_is_right_before_the_next_comes() -> None:
    require_right_on_the_way(simulated(0.4, seed=13))


@pytest.mark.slow
def test_a_track_judged_by_some_of_its_stops_is_held_against_the_others() -> None:
    """A chain in which tracks lead to stops too far off to be judged with the new one."""
    options = SimulationOptions(
        stops=12, loop=True, odometry=True, spacing_m=8.0, pans=6, tilts_rad=(-0.2,), points_per_image=20,
        reach_m=16.0, link_stops=2, max_turn_rad=np.pi, max_zoom=6.0, heading_change_rad=0.05,
        sigma_stop_m=0.1, noise_px=0.4, outliers=0.4,
    )  # fmt: skip
    simulation = simulate(TEMPLATES["mer-navcam"](), options, seed=2)
    smoother = TraverseSmoother(simulation.traverse.rig, SmootherOptions(telemetry="odometry"))
    parts = list(stops_of(simulation.traverse))
    early = np.concatenate([observations.track for *_, observations in parts[:3]])
    for i, (stop, frames, images, observations) in enumerate(parts[:8]):
        stays = ~np.isin(observations.track, early) | (i < 6)  # what would close the loop is not seen
        smoother.add_stop(stop, frames, images, observations.select(stays))
    require_stops(simulation, smoother)


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["mer-navcam", "exomars-pancam"])
@pytest.mark.parametrize("stops", [1, 2, 4])
def test_drives_are_solved_over_seeds(rig: str, stops: int) -> None:
    for seed in (20, 21):
        for share in (0.33, 0.6):
            simulation = simulated(share, seed=seed, rig=rig, stops=stops)
            require_right_on_the_way(simulation)
            require_right(simulation, solve_incrementally(simulation.traverse))


@pytest.mark.slow
def test_the_end_keeps_what_the_batch_keeps() -> None:
    traverse = with_guessed_sigmas(simulated(0.1, seed=15).traverse)
    expected, solution = solve(traverse), solve_incrementally(traverse)
    assert np.array_equal(solution.used, expected.used)
    for one, other in zip(solution.stop_covariance, expected.stop_covariance, strict=True):
        assert np.sqrt(np.diag(one)) == pytest.approx(np.sqrt(np.diag(other)), rel=1e-3)


@pytest.mark.slow
def test_what_is_left_out_counts_once() -> None:
    smoother, updates = driven(simulated(0.4, seed=15).traverse)
    fate = smoother.state().fate
    out = np.isin(fate, [int(Fate.OUTLIER), int(Fate.CHANCE)])
    # What an update readmits stays counted by the update that rejected it.
    assert out.sum() <= sum(u.rejected for u in updates) < 1.05 * out.sum()


@pytest.mark.slow
def test_a_track_taken_back_whole_can_come_again() -> None:
    traverse = simulated(0.0, seed=16).traverse
    smoother, _ = driven(traverse)
    before, used = smoother.cost, smoother.used
    observations = smoother.traverse.observations
    assert observations is not None
    track = observations.track[used].max(keepdims=True)
    mine = observations.select(np.flatnonzero((observations.track == track) & used))
    smoother.remove(mine)
    assert smoother.cost < before
    assert smoother._drive.home(track) == -1  # it has no landmark
    smoother.add_observations(mine)
    assert smoother.cost == pytest.approx(before, rel=1e-6)


def test_guessed_sigmas_are_known_as_such_after_a_restart(tmp_path: Path) -> None:
    smoother, _ = driven(with_guessed_sigmas(simulated(0.05, seed=17, stops=1).traverse))
    smoother.save(tmp_path / "drive.npz")
    observations = TraverseSmoother.load(tmp_path / "drive.npz").traverse.observations
    assert observations is not None
    assert observations.origin == "images"
