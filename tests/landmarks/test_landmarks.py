"""Landmarks on S^3: triangulation, derivatives, refinement, and what noise makes of residuals and points."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.optimize import least_squares

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks import (
    SQUARED,
    CameraViews,
    Landmarks,
    Loss,
    LossName,
    Measurements,
    loss_of,
    point_sigma_m,
    rays_of,
    refine,
    triangulate,
)
from pancam_graph.landmarks._landmarks import evaluate, free_derivatives, residual_cofactor
from support.landmark_scenes import (
    FOCAL_PX,
    homogeneous,
    measure,
    pixels_of,
    random_points,
    random_views,
    unit,
    views_at,
)
from support.parameters import slow_but_for


def triangulated(views: CameraViews, m: Measurements, weight: FloatArray | None = None) -> Landmarks:
    return triangulate(*rays_of(m, views), m.landmark, ones(m) if weight is None else weight)


def ones(m: Measurements) -> FloatArray:
    return np.ones(len(m.row))


# --- triangulation ---


@pytest.mark.parametrize("n_views", [2, 3, 6])
def test_triangulation_is_exact_without_noise(n_views: int) -> None:
    rng = np.random.default_rng(n_views)
    views, points = random_views(rng, n_views), random_points(rng, 50, 5, 1e4)
    found = triangulated(views, measure(views, points))
    assert np.linalg.norm(found.vector, axis=1) == pytest.approx(np.ones(50))
    assert homogeneous(found) == pytest.approx(homogeneous(unit(points)), abs=1e-12)
    xyz = found.points_m(np.full(50, 1e9))
    assert xyz == pytest.approx(points[:, :3], rel=1e-9, abs=1e-6)


def test_directions_at_infinity_are_ordinary_landmarks() -> None:
    rng = np.random.default_rng(1)
    views, points = random_views(rng, 3), random_points(rng, 20)
    points[:, 3] = 0.0
    found = triangulated(views, measure(views, points))
    assert found.vector[:, 3] == pytest.approx(np.zeros(20), abs=1e-14)
    assert homogeneous(found) == pytest.approx(homogeneous(unit(points)), abs=1e-13)
    reach = np.full(20, 1e5)
    assert np.linalg.norm(found.points_m(reach) - found.origin_m, axis=1) == pytest.approx(reach)


def test_rays_that_diverge_meet_beyond_infinity() -> None:
    """The lines meet behind both cameras: w is negative, and the landmark still counts as in front."""
    views = views_at([[0, -1, 0], [0, 1, 0]])
    behind = np.array([[50.0, 0.0, 0.0, -1.0]])
    m = measure(views, behind)
    assert m.uv_px[0, 0] > m.uv_px[1, 0], "the left camera looks further to the left than the right one"
    found = triangulated(views, m)
    assert homogeneous(found) == pytest.approx(homogeneous(unit(behind)), abs=1e-12)
    assert evaluate(found, m, views)[2].all()


def test_a_point_behind_is_not_in_front() -> None:
    """Turned by half a turn, one camera has behind it what the others see."""
    views = views_at([[0, -1, 0], [0, 1, 0], [0, 0, 1]], np.array([[0, 0, 0], [0, 0, 0], [0, 0, np.pi]]))
    point = np.array([[10.0, 1.0, 0.5, 1.0]])
    m = measure(views, point)
    found = triangulated(views, m)
    assert found.points_m(np.array([1e9]))[0] == pytest.approx(point[0, :3])
    assert evaluate(found, m, views)[2].tolist() == [True, True, False]


@pytest.mark.parametrize("baseline_m", [1.0, 1e-2, 1e-4, 1e-6])
def test_nearly_parallel_rays_triangulate_in_front_whatever_the_baseline(baseline_m: float) -> None:
    """At a parallax far below the noise the nearest point to all lines is between the cameras: not there."""
    rng = np.random.default_rng(2)
    views = views_at([[0, 0, 0], [0, baseline_m, 0]])
    m = measure(views, random_points(rng, 100, 1e4 * baseline_m, 1e5 * baseline_m), noise=rng)
    found = triangulated(views, m)
    residual, _, in_front = evaluate(found, m, views)
    assert in_front.all()
    assert np.abs(residual).max() < 4


def test_triangulation_is_the_same_in_any_unit_of_length() -> None:
    rng = np.random.default_rng(3)
    points = random_points(rng, 30)
    centres, turn = rng.uniform(-2, 2, (3, 3)), rng.normal(0, 0.1, (3, 3))
    noisy = measure(views_at(centres, turn), points, sigma_px=3.0, noise=rng)
    reach = np.full(30, 1e9)
    metres = triangulated(views_at(centres, turn), noisy).points_m(reach)
    millimetres = triangulated(views_at(1e3 * centres, turn), noisy).points_m(1e3 * reach)
    assert millimetres == pytest.approx(1e3 * metres, rel=1e-8)


def test_rays_without_parallax_place_the_landmark_at_infinity() -> None:
    """One ray, two rays of one camera, and two cameras behind each other that look at the point."""
    views = views_at([[0, 0, 0], [0, 0, 0], [1, 0, 0]])
    ahead = np.array([1.0, 0.0, 0.0, 0.0])
    aside = np.array([10.0, 2.0, -1.0, 0.0])
    m = measure(views, np.array([aside, aside, ahead]), [[0], [0, 1], [0, 2]])
    found = triangulated(views, m)
    assert found.vector[:, 3] == pytest.approx(np.zeros(3), abs=1e-12)
    assert homogeneous(found) == pytest.approx(
        np.array([aside, aside, ahead]) / np.linalg.norm([aside, aside, ahead], axis=1)[:, None], abs=1e-9
    )
    refined = refine(found, m, views, ones(m))
    assert homogeneous(refined) == pytest.approx(homogeneous(found), abs=1e-9)


def test_weights_leave_rays_out_and_none_at_all_count_alike() -> None:
    rng = np.random.default_rng(4)
    views, points = random_views(rng, 4), random_points(rng, 2)
    m = measure(views, points)
    uv = m.uv_px.copy()
    uv[1] += 200.0
    m = replace(m, uv_px=uv)
    weight = np.array([1.0, 0, 1, 1, 0, 0, 0, 0])
    found = triangulated(views, m, weight)
    assert found.points_m(np.full(2, 1e9)) == pytest.approx(points[:, :3], rel=1e-9)


# --- value and derivative ---


def test_residuals_are_whitened_differences_of_pixels() -> None:
    rng = np.random.default_rng(5)
    views, points = random_views(rng, 4), random_points(rng, 10)
    m = measure(views, points, noise=rng)
    m = replace(m, whitening=rng.normal(size=(40, 2, 2)))
    residual, _, in_front = evaluate(unit(points, rng.normal(size=(10, 3))), m, views)
    offset = pixels_of(views, m.image, points[m.landmark]) - m.uv_px
    assert in_front.all()
    assert residual == pytest.approx(np.einsum("nij,nj->ni", m.whitening, offset), abs=1e-8)


STATES = {
    "random": random_points(np.random.default_rng(0), 10),
    "at the origin's axis": np.array([[9.0, 0, 0, 1], [9.0, 1e-7, -1e-7, 1], [1.0, 0, 0, 1e-7]]),
    "far": np.array([[1e5, 2e4, -1e4, 1.0], [1e8, 2e7, -1e7, 1.0]]),
    "infinity": np.array([[1.0, 0.2, -0.1, 0.0], [1.0, 0.2, -0.1, -1e-7]]),
    "beyond infinity": np.array([[30.0, 2.0, -1.0, -1.0]]),
    "near": np.array([[3.0, 0.2, -0.1, 1.0]]),
}


@pytest.mark.parametrize("points", STATES.values(), ids=STATES)
def test_derivatives_against_differences_of_moving_on_the_sphere(points: FloatArray) -> None:
    """By all four numbers of the vector; the tangent basis is the module's own, and must be orthonormal."""
    rng = np.random.default_rng(6)
    views = random_views(rng, 3)
    m = replace(measure(views, points), whitening=rng.normal(size=(3 * len(points), 2, 2)))
    here = unit(points)
    _, b, _ = evaluate(here, m, views)
    h = 1e-6
    d_vector = np.empty((len(m.row), 2, 4))
    for i in range(4):
        ahead, behind = (replace(here, vector=here.vector + s * h * np.eye(4)[i]) for s in (1, -1))
        d_vector[:, :, i] = (evaluate(ahead, m, views)[0] - evaluate(behind, m, views)[0]) / (2 * h)
    scale = np.abs(d_vector).max()
    for k in range(len(points)):
        rows = m.landmark == k
        numeric, analytic = d_vector[rows].reshape(-1, 4), b[rows].reshape(-1, 3)
        # Scale does not change a projection, so all of the derivative lies in the tangent space, and its
        # Gram matrix does not depend on the basis.
        assert numeric @ here.vector[k] == pytest.approx(np.zeros(len(numeric)), abs=1e-6 * scale)
        assert analytic @ analytic.T == pytest.approx(numeric @ numeric.T, abs=1e-6 * scale**2)


@pytest.mark.parametrize("points", STATES.values(), ids=STATES)
def test_a_step_of_gauss_newton_along_the_tangents_returns(points: FloatArray) -> None:
    """Ties the derivative to the basis that `refine` moves along: a disturbed landmark is back at once."""
    rng = np.random.default_rng(7)
    views = random_views(rng, 4)
    m = measure(views, points)
    true = unit(points)
    moved = true.vector + 1e-4 * rng.normal(size=true.vector.shape)
    disturbed = replace(true, vector=moved / np.linalg.norm(moved, axis=1, keepdims=True))
    found = refine(disturbed, m, views, ones(m), beyond_infinity=True)
    assert found.vector == pytest.approx(true.vector, abs=1e-10)


# --- refinement ---


def reference_cost(
    views: CameraViews, m: Measurements, k: int, weight: FloatArray, loss: Loss, start: FloatArray
) -> tuple[float, FloatArray]:
    """Least cost of one landmark by SciPy over the four numbers, and its unit vector."""
    rows = np.flatnonzero((m.landmark == k) & (weight > 0))

    def terms(vector: FloatArray) -> FloatArray:
        offset = pixels_of(views, m.image[rows], vector) - m.uv_px[rows]
        whitened = np.einsum("nij,nj->ni", m.whitening[rows], offset)
        length = np.linalg.norm(whitened, axis=1)
        share = np.sqrt(2 * weight[rows] * loss.cost(whitened)) / np.maximum(length, 1e-300)
        return np.append((share[:, None] * whitened).ravel(), 10 * (vector @ vector - 1))

    found = least_squares(terms, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return float(found.cost), found.x / np.linalg.norm(found.x)


@pytest.mark.parametrize(
    ("name", "n_views"),
    slow_but_for([("none", 5), ("huber", 2), ("cauchy", 5)], product(["none", "huber", "cauchy"], [2, 5])),
)
def test_refinement_finds_scipys_optimum(name: LossName, n_views: int) -> None:
    """From linear triangulation of pixels with noise, and an outlier where the loss can bear one."""
    rng = np.random.default_rng(n_views)
    views, points = random_views(rng, n_views), random_points(rng, 12, 5, 200)
    m = measure(views, points, sigma_px=1.0, noise=rng)
    if name != "none" and n_views > 2:
        uv = m.uv_px.copy()
        uv[::15] += [8.0, -6.0]
        m = replace(m, uv_px=uv)
    loss = loss_of(name)
    weight = rng.uniform(0.5, 2, len(m.row))
    found = refine(triangulated(views, m), m, views, weight, loss, beyond_infinity=True)
    residual, _, in_front = evaluate(found, m, views)
    assert in_front.all()
    cost = np.bincount(m.landmark, weight * loss.cost(residual))
    vectors = homogeneous(found)
    for k in range(len(points)):
        best, vector = reference_cost(views, m, k, weight, loss, vectors[k])
        again, _ = reference_cost(views, m, k, weight, loss, homogeneous(unit(points[k : k + 1]))[0])
        assert cost[k] == pytest.approx(min(best, again), rel=1e-6, abs=1e-9)
        assert abs(vector @ vectors[k]) == pytest.approx(1, abs=1e-6)


def test_observations_of_weight_zero_do_not_pull() -> None:
    rng = np.random.default_rng(8)
    views, points = random_views(rng, 4), random_points(rng, 5)
    m = measure(views, points)
    uv = m.uv_px.copy()
    uv[::4] += 50.0
    weight = np.where(np.arange(20) % 4 == 0, 0.0, 1.0)
    found = refine(unit(points + np.array([0.5, 0.1, 0.0, 0.0])), replace(m, uv_px=uv), views, weight)
    assert homogeneous(found) == pytest.approx(homogeneous(unit(points)), abs=1e-10)


def test_no_landmark_gets_worse_or_behind_a_camera() -> None:
    """Starts far from the truth, some of them so that a full step would pass a camera."""
    rng = np.random.default_rng(9)
    views, points = random_views(rng, 3), random_points(rng, 100, 3, 50)
    m = measure(views, points, noise=rng)
    start = unit(points * [1, 1, 1, 1] + np.column_stack([rng.uniform(0, 60, 100), np.zeros((100, 3))]))
    found = refine(start, m, views, ones(m))
    before, _, front_before = evaluate(start, m, views)
    after, _, front_after = evaluate(found, m, views)
    assert front_before.all()
    assert front_after.all()
    cost = [np.bincount(m.landmark, SQUARED.cost(r)) for r in (before, after)]
    assert np.all(cost[1] <= cost[0])
    assert np.median(cost[1]) < 5


def test_diverging_rays_end_at_infinity_unless_beyond_is_allowed() -> None:
    rng = np.random.default_rng(10)
    views = views_at([[0, 0, 0], [0, 1, 0], [0, 2, 0.3]])
    diverging = np.column_stack([np.full(8, 300.0), rng.uniform(-60, 60, (8, 2)), np.full(8, -1.0)])
    m = measure(views, diverging, noise=rng)
    start = triangulated(views, m)
    beyond = refine(start, m, views, ones(m), beyond_infinity=True)
    bound = refine(start, m, views, ones(m))
    assert np.all(beyond.vector[:, 3] < 0)
    assert np.all(bound.vector[:, 3] == 0)
    for k in range(8):
        # Of all directions at infinity it is the best, found by SciPy over two angles.
        rows = np.flatnonzero(m.landmark == k)

        def residual(yz: FloatArray, rows: IntArray = rows) -> FloatArray:
            offset = pixels_of(views, m.image[rows], np.array([1, *yz, 0])) - m.uv_px[rows]
            return np.ravel(offset / 0.3)

        best = least_squares(residual, bound.vector[k, 1:3] / bound.vector[k, 0], xtol=1e-15, ftol=1e-15)
        found = evaluate(bound, m, views)[0][rows]
        assert 0.5 * np.sum(found**2) == pytest.approx(best.cost, rel=1e-9)
    sums = [np.sum(evaluate(x, m, views)[0] ** 2) for x in (beyond, bound)]
    assert sums[0] < sums[1]


def test_one_that_starts_beyond_infinity_comes_back() -> None:
    rng = np.random.default_rng(11)
    views, points = random_views(rng, 3), random_points(rng, 20, 100, 500)
    m = measure(views, points)
    start = unit(points * [1, 1, 1, -0.5])
    found = refine(start, m, views, ones(m))
    assert homogeneous(found) == pytest.approx(homogeneous(unit(points)), abs=1e-10)


def test_a_landmark_at_its_origin_and_beyond_infinity_breaks_nothing() -> None:
    """Two cameras that look away from each other: no direction is theirs, and others must not suffer."""
    views = views_at([[1, 0, 0], [-1, 0, 0], [0, 1, 0]], np.array([[0, 0, 0], [0, 0, np.pi], [0, 0, 0]]))
    points = np.array([[1.0, 0, 0, 0], [20.0, 1, 0, 1]])
    m = measure(views, points, [[0, 1], [0, 2]])
    start = replace(triangulated(views, m), vector=np.array([[0.0, 0, 0, -1], [1.0, 0, 0, 0]]))
    found = refine(start, m, views, ones(m))
    assert np.isfinite(found.vector).all()
    assert homogeneous(found)[1] == pytest.approx(homogeneous(unit(points))[1], abs=1e-9)
    assert np.isfinite(found.points_m(np.array([1e5, 1e5]))).all()


# --- statistics ---


def test_covariance_of_residuals_against_monte_carlo() -> None:
    """Of observations that take part, and of one that is only compared."""
    rng = np.random.default_rng(12)
    views = views_at([[0, 0, 0], [0, 0.5, 0], [0, 1.5, 0.2], [0.3, 2.0, -0.4]])
    point = np.array([[12.0, 1.0, -0.5, 1.0]])
    trials = 4000
    m = measure(views, np.tile(point, (trials, 1)), sigma_px=0.1, noise=rng)
    weight = np.tile([1.0, 1.0, 1.0, 0.0], trials)
    found = refine(unit(np.tile(point, (trials, 1))), m, views, weight)
    residual = evaluate(found, m, views)[0].reshape(trials, 4, 2)
    exact = measure(views, point, sigma_px=0.1)
    _, b, _ = evaluate(unit(point), exact, views)
    cofactor = residual_cofactor(b, exact, weight[:4])
    for i in range(4):
        sampled = residual[:, i].T @ residual[:, i] / trials
        assert sampled == pytest.approx(cofactor[i], abs=4 * np.sqrt(2 / trials) * max(1, cofactor[i].max()))
    assert np.trace(cofactor[:3], axis1=1, axis2=2).sum() == pytest.approx(6 - 3), "redundancy"
    assert np.linalg.eigvalsh(cofactor[3])[0] > 1


def test_a_landmark_held_at_infinity_leaves_one_redundancy_more() -> None:
    views = views_at([[0, 0, 0], [0, 0.4, 0], [0, 3, 0]])
    points = np.array([[1.0, 0.1, 0, 0], [50.0, 5, 0, 1]])
    m = measure(views, points)
    landmarks = unit(points)
    _, b, _ = evaluate(landmarks, m, views)
    cofactor = residual_cofactor(free_derivatives(b, landmarks, m), m, ones(m))
    redundancy = np.trace(cofactor, axis1=1, axis2=2)
    assert [redundancy[:3].sum(), redundancy[3:].sum()] == pytest.approx([6 - 2, 6 - 3])


def test_point_sigma_is_the_worst_direction_of_the_inverse_normal_matrix() -> None:
    rng = np.random.default_rng(13)
    views, points = random_views(rng, 4), random_points(rng, 6)
    m = replace(measure(views, points), whitening=rng.normal(size=(24, 2, 2)) + 3 * np.eye(2))
    accepted = np.arange(24) % 4 != 1
    sigma = point_sigma_m(points[:, :3], m, views, accepted)
    h = 1e-5
    for k in range(6):
        rows = np.flatnonzero((m.landmark == k) & accepted)
        jacobian = np.empty((len(rows), 2, 3))
        for i in range(3):
            d = np.append(h * np.eye(3)[i], 0)
            ahead = pixels_of(views, m.image[rows], points[k] + d)
            behind = pixels_of(views, m.image[rows], points[k] - d)
            jacobian[:, :, i] = np.einsum("nij,nj->ni", m.whitening[rows], (ahead - behind) / (2 * h))
        flat = jacobian.reshape(-1, 3)
        covariance = np.linalg.inv(flat.T @ flat)
        assert sigma[k] == pytest.approx(np.sqrt(np.linalg.eigvalsh(covariance)[-1]), rel=1e-5)


def test_range_sigma_of_a_stereo_pair_is_the_textbook_one() -> None:
    """sigma_z = z^2 sigma_d / (f b), for a disparity of two pixels' noise."""
    views = views_at([[0, -0.1, 0], [0, 0.1, 0]])
    m = measure(views, np.array([[20.0, 0.0, 0.0, 1.0]]), sigma_px=0.3)
    sigma = point_sigma_m(np.array([[20.0, 0.0, 0.0]]), m, views, np.ones(2, dtype=bool))
    assert sigma[0] == pytest.approx(20.0**2 * 0.3 * np.sqrt(2) / (FOCAL_PX * 0.2), rel=1e-3)


def test_points_that_fewer_than_two_accepted_observations_see_have_no_sigma() -> None:
    rng = np.random.default_rng(14)
    views, points = random_views(rng, 3), random_points(rng, 3)
    accepted = np.array([True, True, True, True, False, False, False, False, False])
    sigma = point_sigma_m(points[:, :3], measure(views, points), views, accepted)
    assert np.isfinite(sigma).tolist() == [True, False, False]


# --- bookkeeping ---


def test_parts_are_numbered_anew_and_scaling_widens_sigmas() -> None:
    rng = np.random.default_rng(15)
    views, points = random_views(rng, 2), random_points(rng, 4)
    m = measure(views, points, sigma_px=0.5)
    part = m.part(np.flatnonzero(np.isin(m.landmark, [1, 3])))
    assert part.landmark.tolist() == [0, 0, 1, 1]
    assert part.starts.tolist() == [0, 2]
    assert part.row.tolist() == [2, 3, 6, 7]
    assert m.scaled(2.0).whitening[0] == pytest.approx(np.eye(2))
    assert m.scaled(np.arange(1.0, 9.0)).whitening[3] == pytest.approx(np.eye(2) / 2)
    assert m.n_landmarks == 4


def test_points_come_back_from_vectors() -> None:
    rng = np.random.default_rng(16)
    start = unit(random_points(rng, 5), rng.normal(size=(5, 3)))
    points = rng.normal(0, 20, (5, 3))
    assert start.moved_to(points).points_m(np.full(5, 1e9)) == pytest.approx(points)
