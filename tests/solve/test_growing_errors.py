"""Errors of telemetry that grow along a drive: found where single legs are within their sigmas."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, Traverse, simulate, solve
from pancam_graph.data import Solution, StopPose
from pancam_graph.rigs import TEMPLATES
from pancam_graph.simulate import Simulation
from pancam_graph.solve import judge
from pancam_graph.solve._growing_errors import GrowingErrors, growing_errors
from support.solving import fitted
from support.truth import errors_in_sigmas

SMALL = SimulationOptions(stops=4, pans=4, sweep_rad=2.0, points_per_image=15, sigma_stop_m=0.04)


def drive(seed: int, **options: object) -> Simulation:
    return simulate(TEMPLATES["mer-navcam"](), replace(SMALL, **options), seed=seed)  # type: ignore[arg-type]  # by name


def of(traverse: Traverse, options: SolveOptions | None = None) -> GrowingErrors:
    fit = fitted(traverse, options or SolveOptions())
    masts = judge(fit).uncertainty.masts
    assert masts is not None
    found = growing_errors(fit.problem, masts.root, 1e-6)
    assert found is not None
    return found


def failed(solution: Solution) -> set[str]:
    assert solution.verdict is not None
    return {test.name for test in solution.verdict.failures}


def with_baseline(traverse: Traverse, factor: float) -> Traverse:
    """The claimed eyes are so much farther apart, about their middle."""
    eyes = traverse.rig.eyes
    middle = np.mean([eye.head_T_camera.translation() for eye in eyes], axis=0)
    moved = []
    for eye in eyes:
        place = middle + factor * (eye.head_T_camera.translation() - middle)
        moved.append(replace(eye, head_T_camera=gtsam.Pose3(eye.head_T_camera.rotation(), place)))
    return replace(traverse, rig=replace(traverse.rig, eyes=tuple(moved)))


def moved(traverse: Traverse, shift_m: np.ndarray) -> Traverse:
    """Telemetry of each stop is so much farther (stops, 3), in the world's axes."""
    stops = [
        replace(
            stop,
            world_T_mast=gtsam.Pose3(stop.world_T_mast.rotation(), stop.world_T_mast.translation() + shift),
        )
        for stop, shift in zip(traverse.stops, shift_m, strict=True)
    ]
    return replace(traverse, stops=tuple(stops))


def places(traverse: Traverse) -> np.ndarray:
    return np.array([stop.world_T_mast.translation() for stop in traverse.stops])


@pytest.mark.slow
def test_the_score_of_a_scale_is_what_scaled_telemetry_gains() -> None:
    right = drive(3).traverse
    t = moved(right, 0.02 * places(right))
    found = of(t).scale
    assert found is not None
    share, sigmas = found
    here = places(t)
    costs = [
        fitted(one, SolveOptions(loss="none")).problem.cost()
        for one in (t, moved(t, share * (here - here[0])))
    ]
    assert share == pytest.approx(-0.02, abs=0.015)
    assert costs[0] - costs[1] == pytest.approx(0.5 * sigmas**2, rel=0.05)


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_a_baseline_that_is_wrong_fails_and_no_leg_is_let_go(seed: int) -> None:
    """Legs were let go one after the other until the rest agreed, 36 sigma off, and the verdict passed."""
    solution = solve(with_baseline(drive(seed).traverse, 1.05))
    assert "scale" in failed(solution)
    assert solution.verdict is not None
    (test,) = (test for test in solution.verdict.tests if test.name == "scale")
    assert "longer" in test.says
    assert "baseline" in test.says
    assert not [one for one in solution.verdict.tests if one.name == "let go" and one.value]


def adding_up(made: Simulation, axis: int) -> Traverse:
    """A drive whose legs are off along an axis, each by a sigma and a half: no single one shows it."""
    return moved(made.traverse, 1.5 * np.arange(6)[:, None] * 0.04 * np.eye(3)[axis])


def test_odometry_whose_errors_add_up_fails() -> None:
    assert "drift" in failed(solve(adding_up(drive(3, stops=6), 0)))


@pytest.mark.slow
def test_odometry_that_adds_up_aside_fails_or_places_are_where_sigmas_say() -> None:
    made = drive(3, stops=6)
    solution = solve(adding_up(made, 1))
    if solution.passed:  # then a leg was let go, and what lies behind it has the sigma of that
        assert errors_in_sigmas(made, solution)[1].max() < 3
    else:
        assert "drift" in failed(solution)


@pytest.mark.slow
def test_legs_that_are_constraints_are_tested_too() -> None:
    made = drive(3, sigma_stop_m=5.0)
    masts = made.truth.world_T_mast
    ids = [stop.id for stop in made.traverse.stops]
    sigma = np.diag(np.repeat([0.01, 0.08], 3) ** 2)

    def legs(factor: float) -> Traverse:
        pairs = ((a, b, masts[a].between(masts[b])) for a, b in zip(range(3), range(1, 4), strict=True))
        return replace(
            made.traverse,
            constraints=tuple(
                StopPose(
                    between=(ids[a], ids[b]),
                    a_T_b=gtsam.Pose3(leg.rotation(), factor * leg.translation()),
                    covariance=sigma,
                )
                for a, b, leg in pairs
            ),
        )

    assert solve(legs(1.0)).passed
    wrong = failed(solve(legs(1.06)))
    assert "scale" in wrong
    assert "constraints" not in wrong


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_no_wrong_baseline_passes_with_a_large_error(seed: int) -> None:
    made = drive(500 + seed, stops=3)
    solution = solve(with_baseline(made.traverse, 1.05))
    assert not solution.passed or max(np.abs(e).max() for e in errors_in_sigmas(made, solution)) < 6
