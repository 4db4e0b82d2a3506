"""Screening: what goes, what stays, what comes back, one observation at a time."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.landmarks import CameraViews, Measurements, rays_of, triangulate
from pancam_graph.landmarks._landmarks import evaluate
from pancam_graph.solve import snoop
from pancam_graph.solve._rejection import Snooping, pair_scale
from support.landmark_scenes import measure, random_points, random_views, unit, views_at


def screened(
    views: CameraViews,
    m: Measurements,
    accepted: BoolArray | None = None,
    *,
    cutoff_sigma: float = 4.0,
    min_scale: float = 1.0,
) -> Snooping:
    """Screening from linear triangulation of what is accepted, by default everything."""
    accepted = np.ones(len(m.row), dtype=bool) if accepted is None else accepted
    start = triangulate(*rays_of(m, views), m.landmark, accepted.astype(float))
    return snoop(start, m, views, accepted, cutoff_sigma=cutoff_sigma, min_scale=min_scale)


def shifted(m: Measurements, rows: IntArray | list[int], by_px: FloatArray | list[float]) -> Measurements:
    uv = m.uv_px.copy()
    uv[rows] += by_px
    return replace(m, uv_px=uv)


def test_rays_pass_through_what_their_pixels_see() -> None:
    rng = np.random.default_rng(0)
    views, points = random_views(rng, 3), random_points(rng, 10)
    m = measure(views, points)
    centre, direction = rays_of(m, views)
    towards = points[m.landmark, :3] - centre
    assert direction == pytest.approx(towards / np.linalg.norm(towards, axis=1, keepdims=True), abs=1e-12)


@pytest.mark.parametrize("cutoff", [2.0, 3.0])
def test_without_outliers_as_many_go_as_a_gaussian_puts_beyond_the_cutoff(cutoff: float) -> None:
    """A little fewer: of two that exceed it in one track the worse goes, and the other may then fit."""
    rng = np.random.default_rng(1)
    views = random_views(rng, 8)
    m = measure(views, random_points(rng, 1500), noise=rng)
    result = screened(views, m, cutoff_sigma=cutoff)
    expected = 2 * norm.sf(cutoff) * len(m.row)
    chance = 3 * np.sqrt(expected)
    assert 0.85 * expected - chance < np.sum(~result.accepted) < expected + chance
    assert result.scale == pytest.approx(1.0, abs=0.02)
    assert not result.behind.any()


@pytest.mark.parametrize(
    ("factor", "min_scale", "scale"), [(3.0, 1.0, 3.0), (0.2, 1.0, 1.0), (0.2, 0.05, 0.2)]
)
def test_the_scale_is_that_of_the_noise_or_the_least_allowed(
    factor: float, min_scale: float, scale: float
) -> None:
    """Sigmas that are wrong by a factor neither cost observations nor hide outliers beyond the least."""
    rng = np.random.default_rng(2)
    views = random_views(rng, 5)
    m = measure(views, random_points(rng, 400), noise=rng).scaled(1 / factor)
    result = screened(views, m, min_scale=min_scale)
    assert result.scale == pytest.approx(scale, rel=0.05)
    assert np.mean(result.accepted) > 0.999


@pytest.mark.parametrize("spread_m", [0.2, 2.0], ids=["one mast", "several stops"])
def test_one_gross_outlier_in_four_views_goes_alone(spread_m: float) -> None:
    """In every fifth track one observation is a random pixel, or beside the true one by ten sigmas."""
    rng = np.random.default_rng(3)
    views = random_views(rng, 4, spread_m)
    m = measure(views, random_points(rng, 500, 5, 100), noise=rng)
    bad = 4 * np.arange(0, 500, 5) + rng.integers(0, 4, 100)
    uv = m.uv_px.copy()
    uv[bad[:50]] = rng.uniform(0, 1000, (50, 2))
    uv[bad[50:], 1] += 10.0
    result = screened(views, replace(m, uv_px=uv))
    assert np.setdiff1d(bad, np.flatnonzero(~result.accepted)).size == 0, "outliers kept"
    lost = np.setdiff1d(np.flatnonzero(~result.accepted), bad)
    assert len(lost) <= 2, "of 1900 good observations noise alone takes 0.1 beyond four sigmas"


def test_the_landmark_is_placed_anew_by_what_is_kept() -> None:
    rng = np.random.default_rng(4)
    views, points = random_views(rng, 4), random_points(rng, 20)
    result = screened(views, shifted(measure(views, points), [2], [80.0, -60.0]))
    assert np.flatnonzero(~result.accepted).tolist() == [2]
    assert result.landmarks.points_m(np.full(20, 1e9)) == pytest.approx(points[:, :3], rel=1e-9)


def test_two_views_that_disagree_both_go() -> None:
    """Across the epipolar line nothing tells which is wrong; others are not touched."""
    rng = np.random.default_rng(5)
    views = views_at([[0, 0, 0], [0, 0.3, 0]])
    m = measure(views, random_points(rng, 50), noise=rng)
    result = screened(views, shifted(m, [20], [0.0, 15.0]))
    assert np.flatnonzero(~result.accepted).tolist() == [20, 21]


def test_an_error_along_the_epipolar_line_of_two_views_passes() -> None:
    """It moves the landmark and leaves no residual: what two views cannot show, screening must not guess."""
    rng = np.random.default_rng(6)
    views = views_at([[0, 0, 0], [0, 0.3, 0]])
    m = measure(views, random_points(rng, 50, 10, 20))
    result = screened(views, shifted(m, [21], [-5.0, 0.0]))
    assert result.accepted.all()


def test_a_good_observation_that_was_rejected_comes_back() -> None:
    rng = np.random.default_rng(7)
    views = random_views(rng, 4)
    m = measure(views, random_points(rng, 100), noise=rng)
    m = shifted(m, [0], [40.0, 30.0])
    before = np.ones(400, dtype=bool)
    before[[0, 5, 10]] = False
    result = screened(views, m, before)
    assert not result.accepted[0], "the one that was rejected for a reason stays out"
    assert result.accepted[[5, 10]].all()
    assert result.accepted.sum() >= 398


def test_a_track_that_had_lost_all_is_judged_anew() -> None:
    """Cameras may have been wrong when it went."""
    rng = np.random.default_rng(8)
    views = random_views(rng, 3)
    m = measure(views, random_points(rng, 20), noise=rng)
    before = np.ones(60, dtype=bool)
    before[:4] = False
    far_off = unit(np.tile([1.0, 5.0, -5.0, 1e-3], (20, 1)))
    start = triangulate(*rays_of(m, views), m.landmark, np.ones(60))
    lost = np.arange(20) < 1
    start = replace(
        start,
        vector=np.where(lost[:, None], far_off.vector, start.vector),
        origin_m=np.where(lost[:, None], 0.0, start.origin_m),
    )
    result = snoop(start, m, views, before, cutoff_sigma=4.0, min_scale=1.0)
    assert result.accepted.all()


@pytest.mark.parametrize(
    ("disparity_sigma", "kept"), [(-3.0, True), (0.0, True), (3.0, True), (-15.0, False), (15.0, True)]
)
def test_rays_may_diverge_by_noise_and_no_more(disparity_sigma: float, kept: bool) -> None:
    """Two level views of a horizon, and of twenty points that tell the noise; positive: a point in front."""
    rng = np.random.default_rng(9)
    views = views_at([[0, 0, 0], [0, 0.3, 0]])
    points = random_points(rng, 21)
    points[0, 3] = 0.0
    m = shifted(measure(views, points, sigma_px=0.3), [1], [0.3 * disparity_sigma, 0.0])
    result = screened(views, m)
    assert result.accepted[:2].tolist() == [kept, kept]
    assert result.accepted[2:].all()
    assert not result.behind.any()


@pytest.mark.parametrize(
    "centres",
    [
        [[0, 0, 0], [0, 0.3, 0], [0, 1.2, 0]],
        [[0, 0, 0], [0, 0.4, 0], [0, 0.8, 0], [0, 3, 0]],
        [[0, 0, 0], [0, 0.2, 0], [0, 4, 0], [0, 4.2, 0]],
    ],
    ids=["three", "one far", "two and two"],
)
def test_a_ridge_loses_nothing_to_half_of_it_starting_beyond_infinity(centres: list[list[float]]) -> None:
    """A landmark held at infinity does not follow its farthest view, whose residual is then all noise."""
    rng = np.random.default_rng(10)
    views = views_at(centres)
    ridge = random_points(rng, 500)
    ridge[:, 3] = 1e-7
    result = screened(views, measure(views, ridge, noise=rng))
    at_infinity = result.landmarks.vector[:, 3] == 0
    assert 0.4 < at_infinity.mean() < 0.6
    assert np.all(result.landmarks.vector[:, 3] >= 0)
    assert np.mean(result.accepted) > 0.999
    assert result.scale == pytest.approx(1.0, abs=0.06)


def test_what_is_behind_a_camera_goes_and_is_named() -> None:
    """One of four cameras looks the other way: its pixel is the mirrored point's, without any residual."""
    turn = np.zeros((4, 3))
    turn[3, 2] = np.pi
    views = views_at([[0, -1, 0], [0, 1, 0], [0, 0, 1], [0.5, 0, 0]], turn)
    m = measure(views, np.array([[10.0, 1.0, 0.5, 1.0]]))
    result = screened(views, m)
    assert result.accepted.tolist() == [True, True, True, False]
    assert result.behind.tolist() == [False, False, False, True]


def test_what_is_kept_has_residuals_within_the_noise() -> None:
    rng = np.random.default_rng(11)
    views = random_views(rng, 4)
    m = measure(views, random_points(rng, 300), noise=rng)
    uv = m.uv_px.copy()
    bad = rng.random(1200) < 0.05
    uv[bad] = rng.uniform(0, 1000, (int(bad.sum()), 2))
    m = replace(m, uv_px=uv)
    result = screened(views, m)
    residual, _, in_front = evaluate(result.landmarks, m, views)
    assert in_front[result.accepted].all()
    assert np.linalg.norm(residual[result.accepted], axis=1).max() < 5 * result.scale
    assert np.mean(result.accepted[~bad]) > 0.99
    assert np.mean(result.accepted[bad]) < 0.01


@pytest.mark.parametrize("share", [0.0, 0.4, 0.6])
def test_the_noise_scale_of_pairs_is_that_of_the_noise_whatever_share_is_wrong(share: float) -> None:
    rng = np.random.default_rng(11)
    views = random_views(rng, 5)
    m = measure(views, random_points(rng, 900), noise=rng)
    wrong = np.flatnonzero(rng.random(len(m.row)) < share)
    m = shifted(m, wrong, rng.uniform(-400, 400, (len(wrong), 2)))
    claimed = m.scaled(0.5)  # half of what the noise is
    assert pair_scale(claimed, views) == pytest.approx(2.0, rel=0.1)


def test_the_noise_scale_of_many_outliers_does_not_shrink_from_round_to_round() -> None:
    """What is kept lacks the tail that was cut off, so that a scale from this alone would be smaller."""
    rng = np.random.default_rng(18)
    views = random_views(rng, 4)
    m = measure(views, random_points(rng, 150), noise=rng)
    wrong = np.flatnonzero(rng.random(len(m.row)) < 0.6)
    m = shifted(m, wrong, rng.uniform(-400, 400, (len(wrong), 2))).scaled(3.0)
    accepted = np.ones(len(m.row), dtype=bool)
    scales = []
    for _ in range(3):
        again = screened(views, m, accepted=accepted, min_scale=0.05)
        accepted = again.accepted
        scales.append(again.scale)
    assert scales[0] == pytest.approx(1 / 3, rel=0.1)
    assert scales[1:] == pytest.approx(scales[:-1], rel=0.02)
