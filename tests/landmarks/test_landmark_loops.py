"""The compiled loops against plain NumPy, one landmark at a time, and whatever the number of threads."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks import (
    CameraViews,
    Landmarks,
    Loss,
    LossName,
    Measurements,
    kernel,
    loss_of,
    point_sigma_m,
    rays_of,
    refine,
    triangulate,
)
from pancam_graph.landmarks._landmarks import evaluate, free_derivatives, residual_cofactor
from pancam_graph.landmarks.kernel._symmetric import diagonalise, least_direction
from pancam_graph.solve import snoop
from pancam_graph.solve._rejection import Snooping
from support import landmark_reference as reference
from support.landmark_scenes import measure, random_points, random_views, unit, views_at
from support.parameters import slow_but_for

# --- eigenvalues ---


def eigen(a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues in ascending order, and eigenvectors."""
    a, turn = a.copy(), np.empty_like(a)
    diagonalise(a, turn)
    order = np.argsort(np.diag(a))
    return np.diag(a)[order], turn[:, order]


def with_values(rng: np.random.Generator, values: list[float]) -> FloatArray:
    turn, _ = np.linalg.qr(rng.normal(size=(len(values), len(values))))
    a = turn * values @ turn.T
    return np.asarray((a + a.T) / 2)


@pytest.mark.parametrize(
    "values",
    [
        [1.0, 2.0],
        [1e-14, 1.0],
        [1.0, 2.0, 3.0],
        [-1.0, 0.5, 2.0],
        [1e-14, 1e-7, 1.0],
        [0.0, 0.0, 1.0],
        [1e-9, 1.0, 1.0],
        [1.0, 1.0 + 1e-13, 1.0 + 2e-13],
        [3e100, 4e100, 5e100],
        [1e-100, 2e-100, 3e-100],
        [0.0, 1e-12, 1.0, 2.0],
        [1e-15, 1e-10, 1e-5, 1.0],
        [2.0, 2.0, 2.0, 2.0],
    ],
    ids=str,
)
def test_eigenvalues_are_lapacks_and_vectors_orthonormal(values: list[float]) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        a = with_values(rng, values)
        largest = np.abs(values).max()
        found, turn = eigen(a)
        assert found == pytest.approx(np.linalg.eigvalsh(a), abs=4e-15 * largest)
        assert turn.T @ turn == pytest.approx(np.eye(len(values)), abs=1e-14)
        assert turn * found @ turn.T == pytest.approx(a, abs=1e-14 * largest)


def least(a: FloatArray) -> FloatArray | None:
    """The eigenvector of the least eigenvalue by inverse iteration; None where that gives up."""
    n = len(a)
    x = np.array([0.48, -0.56, 0.62, 0.27])[:n]
    is_found = least_direction(a.copy(), np.empty(n, dtype=np.int64), np.empty(n), 1e-30, x)
    return x if is_found else None


@pytest.mark.parametrize(
    "values",
    [[0.0, 1.0, 1.0, 2.0], [1e-12, 1e-4, 1.0, 1.0], [1e-3, 0.5, 2.0, 3.0], [1e90, 1e95, 2e95]],
    ids=str,
)
def test_the_least_direction_is_lapacks(values: list[float]) -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        a = with_values(rng, values)
        found, wanted = least(a), np.linalg.eigh(a)[1][:, 0]
        assert found is not None
        assert abs(found @ wanted) == pytest.approx(1.0, abs=1e-14)
        # Both are off by rounding over the distance to the next eigenvalue.
        off = 1e-15 * values[-1] / (values[1] - values[0])
        assert found * np.sign(found @ wanted) == pytest.approx(wanted, abs=20 * off)


@pytest.mark.parametrize(
    "values", [[0.0, 1e-9, 1.0, 1.0], [0.9, 1.0, 1.0, 1.0], [np.nan, 1.0, 1.0, 1.0]], ids=str
)
def test_a_least_direction_that_is_not_by_far_the_least_is_left_to_all_eigenvectors(
    values: list[float],
) -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        assert least(with_values(rng, values)) is None


@pytest.mark.parametrize("m", [2, 3, 4])
def test_small_eigenvalues_of_graded_matrices_keep_their_digits(m: int) -> None:
    """D A D, D over ten decades: the least is one over the largest of the inverse, where LAPACK is exact."""
    rng = np.random.default_rng(1)
    for _ in range(50):
        a = with_values(rng, list(np.linspace(1, 3, m)))
        d = 10.0 ** rng.permutation(np.linspace(-10, 0, m))
        least = 1 / np.linalg.eigvalsh(np.linalg.inv(a) / np.outer(d, d))[-1]
        assert eigen(a * np.outer(d, d))[0][0] == pytest.approx(least, rel=1e-12)


@pytest.mark.parametrize("m", [2, 3, 4])
def test_eigenvalues_of_nothing_and_of_what_is_no_number(m: int) -> None:
    assert eigen(np.zeros((m, m)))[0].tolist() == [0.0] * m
    assert eigen(np.zeros((m, m)))[1] == pytest.approx(np.eye(m))
    eigen(np.full((m, m), np.nan))
    eigen(np.full((m, m), np.inf))


# --- against the reference ---


def scene(
    rng: np.random.Generator, points: FloatArray, *, n_views: int = 5, sigma_px: float = 0.3
) -> tuple[CameraViews, Measurements]:
    """Views with noise in the pixels and whitenings of any shape; each point seen by two to all of them."""
    views = random_views(rng, n_views)
    images = [rng.permutation(n_views)[: rng.integers(2, n_views + 1)] for _ in points]
    m = measure(views, points, [np.sort(i) for i in images], sigma_px=sigma_px, noise=rng)
    return views, replace(m, whitening=m.whitening @ (np.eye(2) + 0.2 * rng.normal(size=(len(m.row), 2, 2))))


def near_the_first_axis(rng: np.random.Generator) -> FloatArray:
    """The world's x axis far ahead: vectors within 1e-7 of that to which the tangents' reflection is tied."""
    points = np.zeros((20, 4))
    points[:, 0], points[:, 1:3], points[:, 3] = 1.0, 1e-7 * rng.normal(size=(20, 2)), 1e-7
    return points


PointsOf = Callable[[np.random.Generator], FloatArray]

STATES: dict[str, PointsOf] = {
    "random": lambda rng: random_points(rng, 16),
    "near identity": near_the_first_axis,
    "far": lambda rng: random_points(rng, 16, 1e4, 1e7),
    "near and far": lambda rng: random_points(rng, 16, 4, 1e5),
    "beyond infinity": lambda rng: random_points(rng, 10, 50, 500) * [1, 1, 1, -1],
}
states = pytest.mark.parametrize("points_of", STATES.values(), ids=STATES)


def each(m: Measurements, views: CameraViews) -> list[tuple[IntArray, reference.Track]]:
    return [(np.flatnonzero(m.landmark == k), t) for k, t in enumerate(reference.tracks(m, views))]


@states
def test_triangulation_is_the_references(points_of: PointsOf) -> None:
    rng = np.random.default_rng(2)
    views, m = scene(rng, points_of(rng), sigma_px=0.03)
    weight = rng.uniform(0.1, 2, len(m.row)) * (rng.random(len(m.row)) < 0.8)
    centre, direction = rays_of(m, views)
    found = triangulate(centre, direction, m.landmark, weight)
    for k, (rows, track) in enumerate(each(m, views)):
        c, d = reference.ray(track)
        assert centre[rows] == pytest.approx(c, abs=0)
        assert direction[rows] == pytest.approx(d, abs=1e-14)
        vector, origin = reference.triangulated(c, d, weight[rows])
        assert found.origin_m[k] == pytest.approx(origin, abs=1e-13)
        assert found.vector[k] == pytest.approx(vector, abs=1e-10)


@states
def test_values_derivatives_and_cofactors_are_the_references(points_of: PointsOf) -> None:
    rng = np.random.default_rng(3)
    points = points_of(rng)
    views, m = scene(rng, points)
    landmarks = unit(points, rng.normal(size=(len(points), 3)))
    held = rng.random(len(points)) < 0.3
    flat = landmarks.vector * np.where(held[:, None], [1, 1, 1, 0], 1)
    landmarks = replace(landmarks, vector=flat / np.linalg.norm(flat, axis=1, keepdims=True))
    weight = rng.uniform(0.5, 1, len(m.row)) * (rng.random(len(m.row)) < 0.8)
    residual, b, in_front = evaluate(landmarks, m, views)
    free = free_derivatives(b, landmarks, m)
    cofactor = residual_cofactor(free, m, weight)
    for k, (rows, track) in enumerate(each(m, views)):
        r, d, front = reference.seen(track, landmarks.vector[k], landmarks.origin_m[k])
        assert residual[rows] == pytest.approx(r, rel=1e-11, abs=1e-8)
        assert b[rows] == pytest.approx(d, rel=1e-11, abs=1e-11 * np.abs(d).max())
        assert in_front[rows].tolist() == front.tolist()
        if held[k]:
            along = reference.tangents(landmarks.vector[k])[3]
            d = d - (d @ along)[:, :, None] * along
        assert free[rows] == pytest.approx(d, abs=1e-10 * np.abs(d).max())
        expected = reference.cofactor(d, weight[rows])
        assert cofactor[rows] == pytest.approx(expected, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize(
    ("state", "name"),
    slow_but_for(
        [
            ("random", "cauchy"),
            ("near identity", "huber"),
            ("far", "none"),
            ("near and far", "huber"),
            ("beyond infinity", "none"),
        ],
        product(STATES, ["none", "huber", "cauchy"]),
    ),
)
def test_refinement_is_the_references(state: str, name: LossName) -> None:
    """The same steps to the same end, from triangulation and from far off it."""
    rng = np.random.default_rng(4)
    views, m = scene(rng, STATES[state](rng))
    weight = rng.uniform(0.5, 2, len(m.row)) * (rng.random(len(m.row)) < 0.9)
    loss = loss_of(name)
    placed = triangulate(*rays_of(m, views), m.landmark, weight)
    off = placed.vector + 0.02 * rng.normal(size=placed.vector.shape)
    off /= np.linalg.norm(off, axis=1, keepdims=True)
    for start in (placed, replace(placed, vector=off)):
        for beyond in (False, True):
            found = refine(start, m, views, weight, loss, beyond_infinity=beyond)
            for k, (rows, track) in enumerate(each(m, views)):
                vector = reference.refined(
                    track,
                    start.vector[k],
                    start.origin_m[k],
                    weight[rows],
                    name,
                    loss.width,
                    beyond_infinity=beyond,
                )
                assert found.vector[k] == pytest.approx(vector, abs=1e-7)
            assert np.all((found.vector[:, 3] >= 0) | beyond)


def test_point_sigmas_are_those_of_the_normal_matrix() -> None:
    rng = np.random.default_rng(5)
    points = random_points(rng, 40, 4, 1e3)
    views, m = scene(rng, points)
    accepted = rng.random(len(m.row)) < 0.8
    sigma = point_sigma_m(points[:, :3], m, views, accepted)
    for k, (rows, track) in enumerate(each(m, views)):
        if accepted[rows].sum() < 2:
            assert sigma[k] == np.inf
            continue
        # By a homogeneous vector of length one the tangents at w = 1 / |(X, 1)| say the same as a metre.
        kept = track.only(accepted[rows])
        length = np.sqrt(1 + points[k, :3] @ points[k, :3])
        _, b, _ = reference.seen(kept, np.append(points[k, :3], 1) / length, np.zeros(3))
        by_metre = b @ reference.tangents(np.append(points[k, :3], 1) / length).T[:, :3] / length
        information = np.einsum("nip,niq->pq", by_metre, by_metre)
        assert sigma[k] == pytest.approx(1 / np.sqrt(np.linalg.eigvalsh(information)[0]), rel=1e-6)


@pytest.mark.parametrize("seed", slow_but_for([7], [6, 7, 8]))
def test_screening_is_the_references_that_does_all_anew_in_every_sweep(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.concatenate([random_points(rng, 60), random_points(rng, 20, 1e3, 1e6)])
    views, m = scene(rng, points, n_views=6)
    uv = m.uv_px.copy()
    bad = rng.random(len(uv)) < 0.08
    uv[bad] += rng.normal(0, 30, (int(bad.sum()), 2))
    m = replace(m, uv_px=uv)
    before = rng.random(len(uv)) < 0.9
    start = triangulate(*rays_of(m, views), m.landmark, before.astype(float))
    found = snoop(start, m, views, before, cutoff_sigma=3.0, min_scale=0.5, scale=1.1)
    vector, accepted = reference.screened(start, m, views, before, 3.0, 1.1)
    assert found.accepted.tolist() == accepted.tolist()
    assert 0 < np.sum(~accepted) < len(accepted) / 2
    assert found.scale == 1.1
    # The reference refines once more in each sweep what already is in its place.
    assert found.landmarks.vector == pytest.approx(vector, abs=1e-5)


@pytest.mark.parametrize("name", ["none", "huber", "cauchy"])
def test_losses_of_many_are_those_of_the_definition(name: LossName) -> None:
    rng = np.random.default_rng(9)
    residual = rng.normal(0, 3, (200_000, 2))
    squared = (residual**2).sum(1)
    loss = loss_of(name, 1.3)
    assert np.allclose(
        loss.cost(residual), reference.loss_cost(name, loss.width, squared), rtol=1e-12, atol=0
    )
    assert np.allclose(
        loss.weight(residual), reference.loss_weight(name, loss.width, squared), rtol=1e-12, atol=0
    )
    assert loss.cost(np.zeros((0, 2))).shape == (0,)


# --- threads ---


def everything(views: CameraViews, m: Measurements, loss: Loss) -> list[FloatArray]:
    """All results as arrays."""
    ones = np.ones(len(m.row))
    centre, direction = rays_of(m, views)
    start = triangulate(centre, direction, m.landmark, ones)
    refined = refine(start, m, views, ones, loss)
    residual, b, in_front = evaluate(refined, m, views)
    free = free_derivatives(b, refined, m)
    points = refined.points_m(np.full(m.n_landmarks, 1e6))
    s: Snooping = snoop(start, m, views, ones > 0, cutoff_sigma=3.0, min_scale=1.0)
    return [
        *(centre, direction, start.vector, start.origin_m, refined.vector, residual, b, in_front, free),
        *(residual_cofactor(free, m, ones), point_sigma_m(points, m, views, ones > 0), loss.cost(residual)),
        *(s.landmarks.vector, s.landmarks.origin_m, s.accepted, s.behind, np.array(s.scale)),
    ]


def test_results_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the last bit, for as many landmarks as make several ranges."""
    rng = np.random.default_rng(10)
    points = random_points(rng, 5000, 4, 1e5)
    views, m = scene(rng, points)
    uv = m.uv_px.copy()
    uv[::17] += 20.0
    m = replace(m, uv_px=uv)
    results = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("PANCAM_GRAPH_THREADS", threads)
        results.append(everything(views, m, loss_of("huber")))
    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            assert np.array_equal(one, two)


# --- extremes ---


def at_parallax(parallax_rad: float, range_m: float = 30.0) -> CameraViews:
    """Two cameras whose rays to a point ahead meet at an angle."""
    half = range_m * parallax_rad / 2
    return views_at([[0, -half, 0], [0, half, 0]])


@pytest.mark.parametrize("noise_px", [0.0, 0.3])
def test_two_rays_a_tenth_of_a_milliradian_apart(noise_px: float) -> None:
    """A parallax of a tenth of a pixel: exact without noise; with it in front, within the noise."""
    rng = np.random.default_rng(11)
    views = at_parallax(1e-4)
    points = np.tile([30.0, 0.0, 0.0, 1.0], (200, 1)) + rng.normal(0, 0.1, (200, 4)) * [1, 1, 1, 0]
    m = measure(views, points, noise=rng if noise_px else None, sigma_px=0.3)
    ones = np.ones(len(m.row))
    found = refine(triangulate(*rays_of(m, views), m.landmark, ones), m, views, ones)
    residual, _, in_front = evaluate(found, m, views)
    assert in_front.all()
    assert np.all(found.vector[:, 3] >= 0)
    if not noise_px:
        assert found.points_m(np.full(200, 1e9)) == pytest.approx(points[:, :3], rel=1e-7)
    assert np.abs(residual).max() < (5 if noise_px else 1e-6)
    sigma = point_sigma_m(points[:, :3], m, views, ones > 0)
    # z^2 sigma sqrt(2) / (f b)
    assert sigma == pytest.approx(points[:, 0] ** 2 * 0.3 * np.sqrt(2) / (1000 * 30e-4), rel=0.02)


@pytest.mark.parametrize("parallax_rad", [1e-2, 1e-4, 1e-6])
def test_refinement_finds_the_range_at_any_parallax_that_pixels_hold(parallax_rad: float) -> None:
    """From a fifth too near: at a microradian one part in 1e10 of the normal matrix tells the range."""
    rng = np.random.default_rng(17)
    views = at_parallax(parallax_rad)
    points = np.tile([30.0, 0.0, 0.0, 1.0], (20, 1)) + rng.normal(0, 0.1, (20, 4)) * [1, 1, 1, 0]
    m = measure(views, points)
    found = refine(unit(points * [1, 1, 1, 1.2]), m, views, np.ones(len(m.row)))
    assert found.points_m(np.full(20, 1e9)) == pytest.approx(
        points[:, :3], rel=1e-10 / parallax_rad, abs=1e-6
    )


@pytest.mark.parametrize("w", [0.0, -1e-6, -0.01, -1.0])
def test_at_and_beyond_infinity_nothing_leaves_the_front(w: float) -> None:
    rng = np.random.default_rng(12)
    views = views_at([[0, -1, 0], [0, 1, 0], [0, 0, 0.7]])
    points = random_points(rng, 100, 20, 200) * [1, 1, 1, w]
    m = measure(views, points, noise=rng)
    ones = np.ones(len(m.row))
    start = triangulate(*rays_of(m, views), m.landmark, ones)
    for beyond in (False, True):
        found = refine(start, m, views, ones, beyond_infinity=beyond)
        residual, b, in_front = evaluate(found, m, views)
        assert in_front.all()
        assert np.linalg.norm(found.vector, axis=1) == pytest.approx(np.ones(100), abs=1e-14)
        cofactor = residual_cofactor(free_derivatives(b, found, m), m, ones)
        freedom = np.add.reduceat(np.trace(cofactor, axis1=1, axis2=2), m.starts)
        assert freedom == pytest.approx(np.where(found.vector[:, 3] == 0, 6 - 2, 6 - 3), abs=1e-6)
        if beyond:
            assert np.abs(residual).max() < 6


def test_rays_along_one_line_leave_the_range_alone() -> None:
    """Three cameras behind each other that look at the point: its direction is known, and no more."""
    turn = Rotation.from_euler("z", 0.2).as_rotvec()
    line = Rotation.from_rotvec(turn).as_matrix()[:, 0]
    views = views_at(np.outer([0.0, 1.0, 3.0], line), np.tile(turn, (3, 1)))
    points = np.append(20 * line, 1.0)[None]
    m = measure(views, points)
    ones = np.ones(3)
    start = triangulate(*rays_of(m, views), m.landmark, ones)
    assert start.vector[0] == pytest.approx(np.append(line, 0.0), abs=1e-9)
    found = refine(start, m, views, ones)
    assert found.vector[0] == pytest.approx(start.vector[0], abs=1e-9)
    residual, b, in_front = evaluate(found, m, views)
    assert in_front.all()
    assert np.abs(residual).max() < 1e-6
    assert np.isfinite(residual_cofactor(free_derivatives(b, found, m), m, ones)).all()
    # On the axis the range is not seen at all; nearly all of its sigma is rounding.
    assert point_sigma_m(points[:, :3], m, views, ones > 0)[0] > 1e5
    result = snoop(start, m, views, ones > 0, cutoff_sigma=4.0, min_scale=1.0)
    assert result.accepted.all()
    assert np.isfinite(result.landmarks.vector).all()


def test_one_that_is_no_number_harms_no_other() -> None:
    rng = np.random.default_rng(13)
    points = random_points(rng, 5)
    views, m = scene(rng, points)
    ones = np.ones(len(m.row))
    good = unit(points)
    vector = good.vector.copy()
    vector[2] = np.nan
    found = refine(replace(good, vector=vector), m, views, ones)
    others = np.arange(5) != 2
    assert np.array_equal(found.vector[others], refine(good, m, views, ones).vector[others])
    assert np.isnan(found.vector[2]).all()


# --- what is handed to compiled code ---


def test_loops_are_compiled_once_whatever_arrays_come() -> None:
    """Read-only, of other types, not contiguous: carried to one kind first, without touching the caller's."""
    rng = np.random.default_rng(14)
    points = random_points(rng, 10)
    views, m = scene(rng, points)
    first = everything(views, m, loss_of("none"))
    strange = replace(
        m, image=m.image.astype(np.int32), uv_px=np.asfortranarray(m.uv_px), whitening=m.whitening[::-1][::-1]
    )
    read_only = CameraViews(
        world_R_camera=np.asfortranarray(views.world_R_camera),
        world_t_camera=views.world_t_camera.copy(),
        calibration=np.broadcast_to(views.calibration[0], views.calibration.shape),
    )
    for array in (read_only.world_R_camera, read_only.world_t_camera, strange.uv_px):
        array.setflags(write=False)
    second = everything(read_only, strange, loss_of("huber", 1e9))
    for one, two in zip(first, second, strict=True):
        # NumPy before 2.3 rounds products of matrices of another layout otherwise.
        np.testing.assert_allclose(two, one, rtol=1e-12, atol=1e-9)
    compiled: list[Any] = [  # typed as what they were made from
        kernel.triangulate,
        kernel.evaluate,
        kernel.refine,
        kernel.cofactors,
        kernel.residual_tests,
        kernel.reject,
    ]
    assert [len(loop.signatures) for loop in compiled] == [1] * len(compiled)


def test_arguments_are_not_written_to() -> None:
    rng = np.random.default_rng(15)
    points = random_points(rng, 10)
    views, m = scene(rng, points)
    start, ones = unit(points * [1, 1, 1, 1.1]), np.ones(len(m.row))
    accepted = rng.random(len(m.row)) < 0.5
    b = evaluate(start, m, views)[1]
    given = [start.vector, start.origin_m, ones, accepted, b, m.uv_px]
    before = [a.copy() for a in given]
    refine(start, m, views, ones)
    snoop(start, m, views, accepted, cutoff_sigma=2.0, min_scale=1.0)
    free_derivatives(b, replace(start, vector=start.vector * [1, 1, 1, 0]), m)
    for a, old in zip(given, before, strict=True):
        assert np.array_equal(a, old)


@pytest.mark.parametrize("wrong", ["weight", "vector", "image"])
def test_what_would_be_read_out_of_bounds_is_refused(wrong: str) -> None:
    rng = np.random.default_rng(16)
    points = random_points(rng, 5)
    views, m = scene(rng, points)
    landmarks: Landmarks = unit(points)
    weight = np.ones(len(m.row))
    if wrong == "weight":
        weight = weight[:-1]
    elif wrong == "vector":
        landmarks = replace(landmarks, vector=landmarks.vector[:-1])
    else:
        m = replace(m, image=m.image + 3)
    expected = r"image: expected 0 to 4, found" if wrong == "image" else r"expected an array of shape \("
    with pytest.raises((ValueError, IndexError), match=expected):
        refine(landmarks, m, views, weight)
