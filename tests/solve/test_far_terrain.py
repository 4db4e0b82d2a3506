"""Stops that share only far terrain: neither biased nor surer than they may be."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pancam_graph import Solution, SolveOptions, solve
from pancam_graph.base.geometry import FloatArray
from pancam_graph.landmarks import at_inverse_ranges, inverse_ranges
from pancam_graph.smoother import solve_incrementally
from pancam_graph.solve import reduced_of, regular_problem
from pancam_graph.solve._far_terrain import far_terrain
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._range_prior import RangePrior
from support.far_scenes import FarScene, far_scene
from support.parameters import slow_but_for
from support.solving import fitted

PLAIN = SolveOptions(rig="held", loss="none")
Ranges = Callable[[np.random.Generator], FloatArray]


def at_about(range_m: float, n: int, spread: float = 0.1) -> Ranges:
    """Ranges of n points that scatter about one."""
    return lambda rng: range_m * np.exp(spread * rng.standard_normal(n))


def near_and_skyline(rng: np.random.Generator) -> FloatArray:
    """Ground from 10 to 80 m, a slope at 300 m and a skyline at 5 km."""
    return np.concatenate(
        [np.exp(rng.uniform(np.log(10), np.log(80), 60)), at_about(300, 340)(rng), at_about(5000, 400)(rng)]
    )


def scene(ranges: Ranges, seed: int, sigma_m: float = 0.3) -> FarScene:
    return far_scene(ranges(np.random.default_rng(1000 + seed)), seed=seed, sigma_m=sigma_m)


@cache
def kilometre() -> FarScene:
    return scene(at_about(1000, 300), seed=3)


@cache
def kilometre_fit() -> Problem:
    return fitted(kilometre().traverse, PLAIN).problem


def error(solution: Solution, truth: FarScene) -> FloatArray:
    """Error (6,) of the second stop, in its tangent."""
    return np.asarray(truth.world_T_mast[1].localCoordinates(solution.final.world_T_mast[1]))


def chi2(solution: Solution, truth: FarScene) -> float:
    e = error(solution, truth)
    return float(e @ np.linalg.solve(solution.stop_covariance[1], e))


@pytest.mark.parametrize("incremental", slow_but_for([False], [False, True]))
def test_second_stop_is_within_its_sigmas(incremental: bool) -> None:
    by = solve_incrementally if incremental else solve
    solution = by(kilometre().traverse, PLAIN)
    assert solution.converged
    # One in a thousand right solutions exceeds it; least squares at fitted ranges has several hundred.
    assert chi2(solution, kilometre()) < 22.5
    assert solution.verdict is not None
    assert solution.verdict.passed, [t.says for t in solution.verdict.tests if not t.passed]


def test_sigma_of_height_is_not_that_of_fitted_ranges() -> None:
    solution = solve(kilometre().traverse, PLAIN)
    height = np.sqrt(solution.stop_covariance[1, 5, 5])
    # Known ranges would give 0.09 m and fitted ones feign 0.04 m; telemetry alone has 0.3 m.
    assert 0.08 < height < 0.25


def test_near_points_decide_where_there_are_any() -> None:
    truth = scene(near_and_skyline, seed=1)
    solution = solve(truth.traverse, PLAIN)
    assert chi2(solution, truth) < 22.5
    assert np.sqrt(np.diag(solution.stop_covariance[1])[3:]).max() < 0.02


def test_near_terrain_is_left_to_least_squares() -> None:
    problem = fitted(scene(at_about(15, 200, spread=0.4), seed=2).traverse, PLAIN).problem
    assert far_terrain(problem) is None


def test_variance_of_an_inverse_range_is_the_curvature_of_the_cost() -> None:
    problem = kilometre_fit().placed()
    ranges = inverse_ranges(problem.landmarks, problem.measurements, problem.views, problem.accepted)
    off = np.sqrt(ranges.variance)
    cost = [
        np.bincount(
            problem.measurements.landmark,
            (
                problem.at(
                    problem.values, at_inverse_ranges(problem.landmarks, ranges, ranges.per_m + step * off)
                ).residuals[0]
                ** 2
            ).sum(axis=1),
        )
        for step in (-1.0, 0.0, 1.0)
    ]
    # One sigma away along the best directions the sum of squares is larger by one.
    np.testing.assert_allclose(0.5 * (cost[0] + cost[2]) - cost[1], 1.0, rtol=5e-3)


def test_landmarks_keep_their_ranges_where_told_to() -> None:
    problem = kilometre_fit()
    ranges = inverse_ranges(problem.landmarks, problem.measurements, problem.views, problem.accepted)
    moved = at_inverse_ranges(problem.landmarks, ranges, np.full(len(ranges.per_m), 2e-4))
    np.testing.assert_allclose(moved.vector[:, 3] / moved.length, 2e-4, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(moved.vector, axis=1), 1.0, rtol=1e-12)


def test_information_that_ranges_do_not_bear_out_is_taken_off() -> None:
    fit_ = fitted(kilometre().traverse, PLAIN)
    regular = reduced_of(fit_, regular_problem(fit_)).root.covariance().block(1, 1)
    less: FloatArray = np.asarray(0.5 * np.linalg.inv(regular))
    halved = reduced_of(replace(fit_, doubt={1: less}), regular_problem(fit_)).root.covariance().block(1, 1)
    np.testing.assert_allclose(halved, 2 * regular, rtol=1e-5, atol=1e-9 * np.abs(regular).max())


class TestRangePrior:
    def drawn(self, true: FloatArray, sigma: float, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """Noisy inverse ranges, and what is expected of each."""
        rng = np.random.default_rng(seed)
        noisy = true + sigma * rng.standard_normal(len(true))
        direction = rng.standard_normal((len(true), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return noisy, RangePrior().expected(noisy, np.full(len(true), sigma**2), direction)[0]

    def test_one_range_for_all_is_found(self) -> None:
        _, expected = self.drawn(np.full(1000, 1e-3), sigma=1e-3)
        # The mean of all is known to 3e-5; noise in each is 1e-3.
        np.testing.assert_allclose(expected, 1e-3, atol=1.2e-4)

    def test_two_ranges_are_told_apart(self) -> None:
        true = np.where(np.arange(1000) % 2, 1e-3, 8e-3)
        _, expected = self.drawn(true, sigma=1e-3)
        assert np.sqrt(np.mean((expected - true) ** 2)) < 3e-4

    def test_nothing_is_expected_beyond_infinity(self) -> None:
        noisy, expected = self.drawn(np.zeros(500), sigma=1e-3)
        assert noisy.min() < -2e-3
        assert expected.min() >= 0.0
        assert expected.max() < 3e-4

    def test_expected_ranges_feign_no_information(self) -> None:
        true = 1e-3 * np.exp(0.3 * np.random.default_rng(5).standard_normal(3000))
        _, expected = self.drawn(true, sigma=5e-4)
        centred = expected - expected.mean()
        # What is feigned is the square beyond the product with the truth.
        assert np.sum(centred**2) < 1.1 * np.sum(centred * true)

    def test_a_range_far_from_all_others_is_borne(self) -> None:
        noisy = np.append(np.full(20, 1e-3), 50.0)
        variance = np.append(np.full(20, 1e-8), 1e-8)
        expected = RangePrior().expected(noisy, variance, np.tile([1.0, 0.0, 0.0], (21, 1)))[0]
        assert np.isfinite(expected).all()

    def test_ranges_may_depend_on_direction(self) -> None:
        rng = np.random.default_rng(1)
        azimuth = rng.uniform(-np.pi, np.pi, 1000)
        true = np.where(azimuth < 0, 1e-3, 3e-3)
        noisy = true + 1e-3 * rng.standard_normal(1000)
        direction = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(1000)])
        prior = RangePrior(is_divided=True)
        expected, _ = prior.expected(noisy, np.full(1000, 1e-6), direction)
        assert np.sqrt(np.mean((expected - true) ** 2)) < 2.5e-4


_SEEDS = 25


@pytest.mark.slow
@pytest.mark.parametrize("range_m", [300.0, 1000.0, 3000.0, 10_000.0])
@pytest.mark.parametrize("sigma_m", [0.05, 1.0])
def test_squared_errors_are_their_variances(range_m: float, sigma_m: float) -> None:
    squares, whole = [], []
    for seed in range(_SEEDS):
        truth = scene(at_about(range_m, 800), seed=100 + seed, sigma_m=sigma_m)
        solution = solve(truth.traverse, PLAIN)
        if not solution.converged:  # it says so
            continue
        squares.append(error(solution, truth) ** 2 / np.diag(solution.stop_covariance[1]))
        whole.append(chi2(solution, truth) / 6)
    assert len(whole) >= 0.9 * _SEEDS
    # Three standard deviations of the mean of as many squares, and of sixes of them.
    single, six = 3 * np.sqrt(2 / len(whole)), 3 * np.sqrt(2 / (6 * len(whole)))
    assert np.all(np.mean(squares, axis=0) < 1 + single)
    assert 1 - six < np.mean(whole) < 1 + six
