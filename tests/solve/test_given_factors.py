"""Factors of the caller's: they move what theory says, in every way to solve, and count in covariances."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import count

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
    cross_validate,
    graph_keys,
    simulate,
    solve,
)
from pancam_graph.base.errors import InputError, SolveError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.rigs import mer_navcam
from support.gtsam_factors import custom, distance_factor
from support.parameters import slow_but_for, slow_for
from support.small_drives import HARD, SMALL, SOFT, near_part, simulated

SHARED = Sharing(calibration=Freedom(scope="all", free=("focal",)))
WAYS = {
    "hard": HARD,
    "hard, explicit": replace(HARD, landmarks="explicit"),
    "soft": SOFT,
    "soft, explicit": replace(SOFT, landmarks="explicit"),
    "circle": replace(HARD, model="circle"),
    "free": replace(HARD, model="free"),
    "projective": replace(HARD, model="projective"),
    "alternation": replace(
        HARD, method="alternation", sharing=SHARED, relative_decrease=1e-9, max_iterations=2000
    ),
}


def near(seed: int = 2, stops: int = 2) -> Traverse:
    """Without landmarks that are too far for explicit ones."""
    return near_part(simulated(seed, stops))


def distance_m(solution: Solution, a: int = 0, b: int = 1) -> float:
    masts = solution.final.world_T_mast
    return float(np.linalg.norm(masts[b].translation() - masts[a].translation()))


@cache
def plain(way: str) -> Solution:
    return solve(near(), WAYS[way])


@pytest.mark.parametrize(
    "way", slow_for(["hard, explicit", "soft, explicit", "projective", "alternation"], WAYS)
)
def test_a_measured_distance_moves_the_second_stop_as_theory_says(way: str) -> None:
    """Theory: the update of a Kalman filter, exact where all is linear."""
    t, before = near(), plain(way)
    keys = graph_keys(t, WAYS[way])
    sigma, wanted = 2e-3, distance_m(before) + 0.01
    factor = distance_factor(keys.mast(t.stops[0].id), keys.mast(t.stops[1].id), wanted, sigma)
    after = solve(t, WAYS[way], factors=[factor])
    assert after.converged
    arm = before.final.world_T_mast[1].translation() - before.final.world_T_mast[0].translation()
    rotation = before.final.world_T_mast[1].rotation().matrix()
    J = np.concatenate([np.zeros(3), arm / np.linalg.norm(arm) @ rotation])
    P = before.stop_covariance[1]
    gain = P @ J / (J @ P @ J + sigma**2)
    step = before.final.world_T_mast[1].localCoordinates(after.final.world_T_mast[1])
    size = np.sqrt(np.diag(P))
    assert np.abs((step - 0.01 * gain) / size).max() < 0.05 * np.abs(0.01 * gain / size).max()
    expected = P - np.outer(gain, J @ P)
    assert np.abs((after.stop_covariance[1] - expected) / np.outer(size, size)).max() < 0.05
    # The cost grows by what the distance and all else are apart.
    assert after.cost_final - before.cost_final == pytest.approx(
        0.5 * 0.01**2 / (J @ P @ J + sigma**2), rel=0.05
    )


@pytest.mark.parametrize("way", slow_but_for("soft", ["hard", "soft", "circle", "free"]))
def test_gtsams_own_optimiser_on_the_whole_graph_finds_the_same(way: str) -> None:
    t, options = near(), WAYS[way]
    keys = graph_keys(t, options)
    masts = [keys.mast(stop.id) for stop in t.stops]
    factors = [
        distance_factor(masts[0], masts[1], distance_m(plain(way)) + 0.01, 2e-3),
        gtsam.PriorFactorVector(
            keys.angles(t.frames[1].id), t.pan_tilt_rad[1], gtsam.noiseModel.Isotropic.Sigma(2, 1e-4)
        ),
    ]
    ours = solve(t, options, factors=factors)
    graph, values = build_graph(t, options)
    for factor in factors:
        graph.push_back(factor)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert ours.cost_final == pytest.approx(graph.error(found), rel=1e-6)
    assert np.abs(found.atPose3(masts[1]).localCoordinates(ours.final.world_T_mast[1])).max() < 1e-5
    expected = gtsam.Marginals(graph, found).marginalCovariance(masts[1])
    assert ours.stop_covariance[1] == pytest.approx(expected, rel=1e-4, abs=1e-5 * np.abs(expected).max())


def test_gps_with_other_sigmas_up_than_along_is_honoured() -> None:
    t = near()
    keys = graph_keys(t)
    world_T_mast = plain("hard").final.world_T_mast[1]
    shift = np.array([0.05, -0.03, 0.02])
    measured = gtsam.Pose3(gtsam.Rot3(), world_T_mast.translation() + shift)
    sigmas = np.array([10.0, 10.0, 10.0, 1e-4, 1e-4, 10.0])
    prior = gtsam.PriorFactorPose3(
        keys.mast(t.stops[1].id), measured, gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    )
    found = solve(t, HARD, factors=[prior]).final.world_T_mast[1]
    moved = found.translation() - world_T_mast.translation()
    assert moved[:2] == pytest.approx(shift[:2], abs=5e-4)
    assert abs(moved[2] - shift[2]) > 5e-3


def test_angles_of_two_frames_are_tied_where_they_share_a_vector() -> None:
    t = near()
    keys = graph_keys(t)
    a, b = keys.angles(t.frames[0].id), keys.angles(t.frames[1].id)
    before = plain("hard").final.pan_tilt_rad
    wanted = before[1] - before[0] + [2e-4, -1e-4]
    factor = custom(
        [a, b],
        2,
        lambda values: values.atVector(b) - values.atVector(a) - wanted,
        lambda place: (-1.0, 1.0)[place] * np.eye(2),
        1e-7,
    )
    after = solve(t, HARD, factors=factor).final.pan_tilt_rad
    assert after[1] - after[0] == pytest.approx(wanted, abs=1e-8)
    explicit = solve(t, WAYS["soft, explicit"], factors=[factor]).final.pan_tilt_rad
    assert explicit[1] - explicit[0] == pytest.approx(wanted, abs=1e-8)


@pytest.mark.parametrize("way", slow_for("soft", ["hard", "soft", "soft, explicit", "alternation"]))
def test_a_factor_on_the_rig_holds_it(way: str) -> None:
    t, options = near(), replace(WAYS[way], sharing=SHARED)
    key = graph_keys(t, options).calibration()
    factor = gtsam.PriorFactorVector(key, np.array([3e-3]), gtsam.noiseModel.Isotropic.Sigma(1, 1e-7))
    (focal,) = solve(t, options, factors=[factor]).refined
    assert focal.change == pytest.approx(3e-3, abs=1e-7)
    assert focal.sigma == pytest.approx(1e-7, rel=1e-2)


def test_stops_that_no_track_joins_may_be_joined_by_a_factor() -> None:
    t = near(4, stops=3)
    assert t.observations is not None
    of_stop = t.image_stop[t.observations.image]
    alone = np.zeros(int(t.observations.track.max()) + 1, dtype=bool)
    alone[t.observations.track[of_stop == 2]] = True
    elsewhere = np.zeros_like(alone)
    elsewhere[t.observations.track[of_stop != 2]] = True
    t = t.with_observations(
        t.observations.select(~((alone & elsewhere)[t.observations.track] & (of_stop == 2)))
    )
    keys = graph_keys(t)
    between = gtsam.Pose3(gtsam.Rot3(), np.array([8.0, 0.5, 0.0]))
    sigmas = np.repeat([1e-3, 1e-2], 3)
    factor = gtsam.BetweenFactorPose3(
        keys.mast(t.stops[1].id), keys.mast(t.stops[2].id), between, gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    )
    loose = replace(
        t, stops=tuple(replace(s, sigma_translation_m=10.0, sigma_rotation_rad=1.0) for s in t.stops)
    )
    found = solve(loose, HARD, factors=[factor])
    masts = found.final.world_T_mast
    assert np.abs(between.localCoordinates(masts[1].between(masts[2]))).max() < 0.1 * sigmas.max()
    relative = found.relative_covariance(t.stops[1].id, t.stops[2].id)
    assert np.sqrt(np.diag(relative)) == pytest.approx(sigmas, rel=1e-2)


def test_a_factor_between_a_held_stop_and_a_free_one_moves_the_free_one() -> None:
    """The first stop of a simulated drive is held: it is no variable, yet it has a key."""
    t = near()
    assert t.stops[0].sigma_translation_m == 0
    held, free = (graph_keys(t).mast(stop.id) for stop in t.stops)
    with pytest.raises(InputError, match="expected a variable that is free, found only such as telemetry"):
        solve(t, HARD, factors=[gtsam.PriorFactorPose3(held, gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6))])
    wanted = distance_m(plain("hard")) + 0.02
    found = solve(t, HARD, factors=[distance_factor(held, free, wanted, 1e-5)])
    assert distance_m(found) == pytest.approx(wanted, abs=1e-5)
    assert found.final.world_T_mast[0].equals(t.stops[0].world_T_mast, 0.0)


@pytest.mark.slow
def test_outliers_are_sought_with_the_factors() -> None:
    """A drive whose telemetry is far off is brought near by a factor, and costs are of both."""
    simulation = simulate(mer_navcam(), replace(SMALL, outliers=0.1), seed=6)
    t, truth = near_part(simulation), simulation.truth
    keys, options = graph_keys(t), SolveOptions(rig="held")
    masts = [keys.mast(stop.id) for stop in t.stops]
    true = float(np.linalg.norm(truth.world_T_mast[1].translation() - truth.world_T_mast[0].translation()))
    factor = distance_factor(masts[0], masts[1], true, 1e-3)
    solution = solve(t, options, factors=factor)
    assert solution.converged
    assert distance_m(solution) == pytest.approx(true, abs=4e-3)
    graph, values = build_graph(t, options, used=solution.used)
    graph.push_back(factor)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert solution.cost_final == pytest.approx(graph.error(found), rel=1e-3)


def test_a_robust_factor_that_is_wrong_gives_way() -> None:
    t = near()
    masts = [graph_keys(t).mast(stop.id) for stop in t.stops]
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-3)
    huber = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), noise)
    wrong = distance_m(plain("hard")) + 1.0
    given_way = solve(t, HARD, factors=[gtsam.RangeFactorPose3(masts[0], masts[1], wrong, huber)])
    assert given_way.converged
    assert distance_m(given_way) == pytest.approx(distance_m(plain("hard")), abs=1e-3)


def test_what_a_factor_holds_of_the_rig_is_not_held_by_priors() -> None:
    """A turn of all mounts about the tilt axis is to images a turn of all tilts."""
    t = near()
    options = replace(HARD, sharing=Sharing(mounts=Freedom(scope="eye", free=("rx_rad",))))
    unseen = [w for w in solve(t, options).warnings if "images say next to nothing" in w]
    assert unseen
    keys = graph_keys(t, options)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-5)
    factors = [gtsam.PriorFactorVector(keys.mount(eye.name), np.zeros(1), noise) for eye in t.rig.eyes]
    assert not [w for w in solve(t, options, factors=factors).warnings if "images say" in w]


def test_halves_of_a_cross_validation_have_the_factors() -> None:
    t = near()
    masts = [graph_keys(t).mast(stop.id) for stop in t.stops]
    wanted = distance_m(plain("hard")) + 0.01
    factor = distance_factor(masts[0], masts[1], wanted, 1e-6)
    without = cross_validate(t, HARD, halvings=1)
    found = cross_validate(t, HARD, halvings=1, factors=[factor])
    one, two = plain("hard").final.world_T_mast
    along = np.abs(two.rotation().unrotate(two.translation() - one.translation())).argmax()
    assert found.stops.formal.ravel()[9 + along] < 0.7 * without.stops.formal.ravel()[9 + along]


def normalised_square(seed: int, options: SolveOptions) -> float:
    """Squared error of the second stop over its covariance, with its distance measured to 1 mm."""
    simulation = simulated(seed, stops=2)
    t, true = near_part(simulation), simulation.truth.world_T_mast
    masts = [graph_keys(t, options).mast(stop.id) for stop in t.stops]
    sigma = 1e-3
    measured = float(np.linalg.norm(true[1].translation() - true[0].translation()))
    measured += sigma * np.random.default_rng(seed).normal()
    solution = solve(t, options, factors=[distance_factor(masts[0], masts[1], measured, sigma)])
    error = solution.final.world_T_mast[1].localCoordinates(true[1])
    return float(error @ np.linalg.solve(solution.stop_covariance[1], error))


@pytest.mark.slow
def test_errors_are_as_large_as_covariances_say() -> None:
    squares = [normalised_square(seed, HARD) for seed in range(30, 34)]
    assert 0.4 < np.sum(squares) / (6 * len(squares)) < 1.8  # 24 degrees of freedom: 1 +- 0.29


@pytest.mark.slow
@pytest.mark.parametrize("way", ["hard", "soft"])
def test_errors_are_as_large_as_covariances_say_over_many_seeds(way: str) -> None:
    squares = [normalised_square(seed, WAYS[way]) for seed in range(100, 130)]
    assert 0.7 < np.sum(squares) / (6 * len(squares)) < 1.35  # 180 degrees of freedom: 1 +- 0.105


# --- bad input ---


def robust(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.0), noise)


def identity(dim: int) -> Callable[[int], FloatArray]:
    return lambda _place: np.eye(dim)


def bad() -> dict[str, tuple[object, str]]:
    t = near()
    keys = graph_keys(t)
    mast, angles = keys.mast(t.stops[1].id), keys.angles(t.frames[0].id)
    noise = gtsam.noiseModel.Isotropic.Sigma

    def raises(_values: gtsam.Values) -> object:  # as a caller's function may
        raise ZeroDivisionError("a rod of length 0")

    return {
        "no factor": (["distance"], "factor 0: expected a GTSAM factor, found str"),
        "an unknown key": (
            [gtsam.PriorFactorPose3(int(gtsam.symbol("M", 5)), gtsam.Pose3(), noise(6, 1.0))],
            "found M5; is M1, the mast of stop0001, meant",
        ),
        "a landmark": (
            [gtsam.PriorFactorPoint3(int(gtsam.symbol("L", 0)), np.zeros(3), noise(3, 1.0))],
            "factors on terrain points are not supported yet",
        ),
        "a key that is no symbol": (
            [gtsam.PriorFactorPose3(2**64 - 1, gtsam.Pose3(), noise(6, 1.0))],
            "angles of 12 frames; found 18446744073709551615",
        ),
        "a variable twice": (
            [gtsam.BetweenFactorPose3(mast, mast, gtsam.Pose3(), noise(6, 1.0))],
            "on mast of stop0001, mast of stop0001): expected each variable once, found one twice",
        ),
        "a constraint in a robust loss": (
            [gtsam.PriorFactorPose3(mast, gtsam.Pose3(), robust(gtsam.noiseModel.Constrained.All(6)))],
            "expected sigmas above 0, found a constraint",
        ),
        "sigmas below rounding": (
            [gtsam.PriorFactorPose3(mast, t.stops[1].world_T_mast, noise(6, 1e-18))],
            "expected at most 1e+14 sigmas per radian or metre, as 64 bits resolve, found 1.0e+18",
        ),
        "another type": (
            [gtsam.PriorFactorPose3(angles, gtsam.Pose3(), noise(6, 1.0))],
            "on angles of frame00000): expected an error vector, found RuntimeError: Attempting to retrieve",
        ),
        "a noise model of another size": (
            [custom([mast], 3, lambda _: np.zeros(2), lambda _: np.zeros((2, 6)))],
            "expected a noise model of 2 rows as its error vector has, found 3",
        ),
        "no Jacobian": (
            [custom([mast], 1, lambda _: np.zeros(1))],
            "expected for M1 a Jacobian of 1 x 6, found 0 x 0",
        ),
        "a Jacobian of another size": (
            [custom([angles], 2, lambda _: np.zeros(2), identity(3))],
            "expected for A0 a Jacobian of 2 x 2, found 3 x 3",
        ),
        "one that raises": (
            [custom([mast], 1, raises)],
            "on mast of stop0001): expected an error vector, found ZeroDivisionError: a rod of length 0",
        ),
        "no vector": ([custom([mast], 1, lambda _: "far")], "expected an error vector, found RuntimeError"),
        "NaN": (
            [custom([mast], 1, lambda _: np.array([np.nan]), lambda _: np.zeros((1, 6)))],
            "expected a finite error at the start, found nan",
        ),
        "a NaN Jacobian": (
            [custom([mast], 1, lambda _: np.zeros(1), lambda _: np.full((1, 6), np.nan))],
            "expected finite residuals and Jacobians, found NaN or infinity",
        ),
        "a constraint": (
            [gtsam.NonlinearEqualityPose3(mast, gtsam.Pose3())],
            "expected sigmas above 0, found a constraint",
        ),
    }


@pytest.mark.parametrize("what", bad())
def test_a_bad_factor_is_told_in_one_sentence(what: str) -> None:
    factors, expected = bad()[what]
    with pytest.raises(InputError) as caught:
        solve(near(), HARD, factors=factors)  # type: ignore[arg-type]  # bad input
    text = str(caught.value)
    assert text.startswith("factors: factor 0")
    assert expected in text
    assert "\n" not in text


def test_no_factors_at_all_are_told_too() -> None:
    with pytest.raises(
        InputError, match="factors: expected GTSAM factors in a sequence or a graph, found int"
    ):
        solve(near(), HARD, factors=5)  # type: ignore[arg-type]  # bad input


def test_a_jacobian_that_changes_its_shape_on_the_way_is_no_crash() -> None:
    """GTSAM would read beyond its end."""
    t = near()
    mast = graph_keys(t).mast(t.stops[1].id)
    calls = count()
    factor = custom([mast], 2, lambda _: np.zeros(2), lambda _: np.zeros((2 if next(calls) < 3 else 1, 6)))
    with pytest.raises(
        SolveError, match=r"on mast of stop0001\): expected for M1 a Jacobian of 2 x 6, found 1"
    ):
        solve(t, WAYS["hard, explicit"], factors=[factor])


def test_a_factor_that_fails_on_the_way_is_named() -> None:
    t = near()
    mast = graph_keys(t).mast(t.stops[1].id)
    start = t.stops[1].world_T_mast

    def only_at_the_start(values: gtsam.Values) -> object:
        if not values.atPose3(mast).equals(start, 0.0):
            raise ValueError("not here")
        return np.zeros(1)

    factor = custom([mast], 1, only_at_the_start, lambda _: np.zeros((1, 6)))
    with pytest.raises(
        SolveError, match=r"factor 0 \(CustomFactor on mast of stop0001\): .*ValueError: not here"
    ):
        solve(t, HARD, factors=[factor])
