"""Ways into the smoother beside the usual: any order, empty stops, nothing held, eyes that come late."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pancam_graph import SimulationOptions, Solution, SolveOptions, Traverse, simulate, solve
from pancam_graph.base.geometry import IntArray
from pancam_graph.data import Freedom, RigTreatment, Sharing, Stop
from pancam_graph.rigs import mer_navcam
from pancam_graph.simulate import Simulation
from pancam_graph.smoother import solve_incrementally
from pancam_graph.smoother._order import order_of_stops
from support.parameters import slow_but_for, slow_for
from support.truth import errors_in_sigmas

DRIVE = SimulationOptions(
    stops=5,
    spacing_m=6.0,
    pans=4,
    sweep_rad=2.5,
    points_per_image=12,
    reach_m=15.0,
    link_stops=1,
    odometry=True,
)
SHORT = SimulationOptions(stops=3, pans=3, sweep_rad=1.5, points_per_image=15)


@cache
def simulated(options: SimulationOptions, seed: int = 0) -> Simulation:
    return simulate(mer_navcam(), options, seed=seed)


def shuffled(t: Traverse, seed: int) -> tuple[Traverse, IntArray, IntArray]:
    """The same traverse with all its entries in another order; rows of its stops and frames before."""
    rng = np.random.default_rng(seed)
    stops, frames, images = (rng.permutation(len(entries)) for entries in (t.stops, t.frames, t.images))
    assert t.observations is not None
    rows = rng.permutation(len(t.observations))
    observations = t.observations.select(rows)
    return (
        replace(
            t,
            stops=tuple(t.stops[i] for i in stops),
            frames=tuple(t.frames[i] for i in frames),
            images=tuple(t.images[i] for i in images),
            observations=replace(observations, image=np.argsort(images)[observations.image]),
        ),
        stops,
        frames,
    )


def without(t: Traverse, stop: int) -> Traverse:
    """The traverse without the observations of a stop."""
    assert t.observations is not None
    return replace(t, observations=t.observations.select(t.image_stop[t.observations.image] != stop))


def require_alike(a: Solution, b: Solution, sigmas: float) -> None:
    """Two solutions of one traverse differ by so many of their sigmas at most."""
    for pose, other, covariance in zip(
        a.final.world_T_mast, b.final.world_T_mast, b.stop_covariance, strict=True
    ):
        size = np.sqrt(np.diag(covariance))
        assert np.all(np.abs(other.localCoordinates(pose)) <= sigmas * size + 1e-9)
    off = np.abs(a.final.pan_tilt_rad - b.final.pan_tilt_rad)
    assert np.all(off <= sigmas * b.angle_sigma_rad + 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_shuffled_file_is_the_same_drive(seed: int) -> None:
    """Added in the order of the file, stops that see nothing of what is there lost their links."""
    simulation = simulated(DRIVE)
    t, stops, frames = shuffled(simulation.traverse, seed)
    ordered, solution = solve_incrementally(simulation.traverse), solve_incrementally(t)
    assert solution.converged
    for i, j in enumerate(stops):
        pose, other = solution.final.world_T_mast[i], ordered.final.world_T_mast[int(j)]
        size = np.sqrt(np.diag(ordered.stop_covariance[j]))
        assert np.all(np.abs(other.localCoordinates(pose)) <= 1e-3 * size + 1e-9)
    off = np.abs(solution.final.pan_tilt_rad - ordered.final.pan_tilt_rad[frames])
    assert np.all(off <= 1e-3 * ordered.angle_sigma_rad[frames])
    angles, poses = errors_in_sigmas(simulation, ordered)
    assert np.abs(angles).max() < 5
    assert poses.max() < 2.5


def test_images_with_mounts_of_their_own_keep_them_in_any_order() -> None:
    options = SolveOptions(sharing=Sharing(mounts=Freedom(scope="image", free=("rx_rad",))))
    t, _, _ = shuffled(simulated(SHORT).traverse, 2)
    require_alike(solve_incrementally(t, options), solve(t, options), 0.02)


def test_a_file_in_the_order_of_the_drive_keeps_it() -> None:
    t = simulated(DRIVE).traverse
    assert order_of_stops(t) == [(0, None), (1, 0), (2, 1), (3, 2), (4, 3)]
    backwards = replace(t, stops=t.stops[::-1])
    assert order_of_stops(backwards) == [(4, None), (3, 4), (2, 3), (1, 2), (0, 1)]  # the held one is last


@pytest.mark.parametrize("at", slow_but_for([1], [0, 1]))
def test_a_stop_without_frames_stays_where_telemetry_has_it(at: int) -> None:
    simulation = simulated(SHORT)
    t = simulation.traverse
    passed = Stop(
        id="passed", world_T_mast=t.stops[1].world_T_mast, sigma_rotation_rad=0.01, sigma_translation_m=0.1
    )
    solution = solve_incrementally(replace(t, stops=(*t.stops[:at], passed, *t.stops[at:])))
    assert solution.converged
    moved = passed.world_T_mast.localCoordinates(solution.final.world_T_mast[at])
    np.testing.assert_allclose(moved, 0, atol=1e-9)
    np.testing.assert_allclose(
        np.sqrt(np.diag(solution.stop_covariance[at])), np.repeat([0.01, 0.1], 3), rtol=1e-6
    )
    masts = (*solution.final.world_T_mast[:at], *solution.final.world_T_mast[at + 1 :])
    plain = replace(
        solution,
        final=replace(solution.final, world_T_mast=masts),
        stop_covariance=np.delete(solution.stop_covariance, at, axis=0),
    )
    angles, stops = errors_in_sigmas(simulation, plain)
    assert np.abs(angles).max() < 5
    assert stops.max() < 2.5


@pytest.mark.parametrize("stop", slow_but_for([0], [0, 1]))
def test_a_stop_without_observations_is_no_reason_to_refuse_a_drive(stop: int) -> None:
    simulation = simulated(SHORT)
    solution = solve_incrementally(without(simulation.traverse, stop))
    angles, stops = errors_in_sigmas(simulation, solution)
    assert solution.converged
    assert np.abs(angles).max() < 5
    assert stops.max() < 2.5


# With the rig free too, 1000 m are near what double precision resolves: sigmas are a fifth too small.
@pytest.mark.parametrize(
    ("way", "sigma_m", "rig"),
    slow_for(
        [(solve, 1.5, "estimated"), (solve, 1.5, "held"), (solve_incrementally, 1000.0, "held")],
        [
            (way, *case)
            for way in (solve, solve_incrementally)
            for case in [(1.5, "held"), (1.5, "estimated"), (1000.0, "held")]
        ],
    ),
)
def test_where_nothing_is_held_telemetry_holds_all_stops_in_common(
    way: Callable[[Traverse, SolveOptions], Solution], sigma_m: float, rig: RigTreatment
) -> None:
    """Images hold three stops to each other; the mean of their telemetry places them."""
    simulation = simulated(SHORT)
    t = simulation.traverse
    stops = tuple(replace(s, sigma_translation_m=sigma_m, sigma_rotation_rad=0.01) for s in t.stops)
    solution = way(replace(t, stops=stops), SolveOptions(rig=rig))
    assert solution.converged
    sigma = np.sqrt(np.diagonal(solution.stop_covariance[:, 3:, 3:], axis1=1, axis2=2))
    np.testing.assert_allclose(sigma, sigma_m / np.sqrt(3), rtol=1e-2)
    true, found = simulation.truth.world_T_mast, solution.final.world_T_mast
    for i in (1, 2):
        error = true[0].between(true[i]).localCoordinates(found[0].between(found[i]))
        assert np.abs(error[:3]).max() < 0.02
        assert np.abs(error[3:]).max() < 0.1


@pytest.mark.slow
def test_an_eye_that_the_first_stop_does_not_show_has_its_prior() -> None:
    """Its mount was free without one: the images hold it badly, and the stops with it."""
    options = replace(SHORT, mount_error_rad=1e-3, mount_error_m=1e-3)
    simulation = simulated(options)
    t = simulation.traverse
    assert t.observations is not None
    gone = (t.image_stop == 0) & (t.image_eye == 1)
    kept = ~gone[t.observations.image]
    observations = t.observations.select(kept)
    fewer = replace(
        t,
        images=tuple(image for image, is_gone in zip(t.images, gone, strict=True) if not is_gone),
        observations=replace(observations, image=(np.cumsum(~gone) - 1)[observations.image]),
    )
    options_ = SolveOptions(sharing=Sharing(mounts=Freedom(scope="eye")))
    require_alike(solve_incrementally(fewer, options_), solve(fewer, options_), 0.02)
