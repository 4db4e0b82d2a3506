"""Smooth distortion fields against SciPy's splines."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import (
    FIELD_PER_COEFFICIENT,
    FIELD_SHAPE,
    Fields,
    Pinhole,
    field_covariance,
    with_field,
    without_affine,
)
from pancam_graph.cameras._field import gram_along_side

SIZE = np.array([[1024.0, 768.0], [640.0, 640.0]])


def by_scipy(coefficients: FloatArray, size: FloatArray, uv: FloatArray) -> FloatArray:
    """(n, 2) for one image: uniform knots, four cells along each side."""
    knots = np.arange(-3.0, 8.0)
    u, v = ((uv + 0.5) / size * 4).T
    rows, columns = (BSpline.design_matrix(x, knots, 3, extrapolate=True).toarray() for x in (v, u))
    return np.asarray(np.einsum("na,kab,nb->nk", rows, coefficients, columns))


def random_fields(seed: int = 0) -> Fields:
    coefficients = np.random.default_rng(seed).normal(size=(2, *FIELD_SHAPE))
    return Fields(coefficients_px=coefficients, row=np.array([1, 0]), size_px=SIZE)


def test_a_field_is_the_spline_of_its_image() -> None:
    fields, rng = random_fields(), np.random.default_rng(1)
    image = rng.integers(0, 2, 200)
    uv = rng.uniform(-0.5, SIZE[image] - 0.5)
    found = fields.at(image, uv)
    for i in (0, 1):
        here = image == i
        expected = by_scipy(fields.coefficients_px[fields.row[i]], SIZE[i], uv[here])
        assert found[here] == pytest.approx(expected, abs=1e-12)


def test_beyond_the_edge_the_field_is_that_of_the_edge() -> None:
    fields, rng = random_fields(), np.random.default_rng(2)
    image = rng.integers(0, 2, 100)
    uv = rng.uniform(-1.5 * SIZE[image], 2.5 * SIZE[image])
    assert fields.at(image, uv) == pytest.approx(fields.at(image, np.clip(uv, -0.5, SIZE[image] - 0.5)))


def test_slope_of_a_field() -> None:
    fields, rng = random_fields(), np.random.default_rng(3)
    image = rng.integers(0, 2, 100)
    uv = rng.uniform(-0.3 * SIZE[image], 1.3 * SIZE[image])
    by_difference = [
        (fields.at(image, uv + step) - fields.at(image, uv - step)) / 2e-3 for step in 1e-3 * np.eye(2)
    ]
    assert fields.slope(image, uv) == pytest.approx(np.stack(by_difference, axis=2), abs=1e-9)


def test_a_camera_with_a_field_is_what_observations_of_it_are() -> None:
    """A pixel as measured less the field there is where the lens alone sees the point."""
    lens = Pinhole(width_px=1024, height_px=768, fx_px=900.0, fy_px=900.0, cx_px=500.0, cy_px=380.0)
    coefficients = np.random.default_rng(4).normal(size=FIELD_SHAPE)
    camera = with_field(lens, coefficients)
    points = np.random.default_rng(5).uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.0], (200, 3))
    uv, valid = camera.project(points)
    fields = Fields(coefficients_px=coefficients[None], row=np.zeros(1, dtype=int), size_px=SIZE[:1])
    assert valid.all()
    assert uv - fields.at(np.zeros(200, dtype=int), uv) == pytest.approx(lens.project(points)[0], abs=1e-9)
    assert with_field(camera, np.zeros(FIELD_SHAPE)) is lens


@pytest.mark.parametrize(
    ("field_px", "says"),
    [
        (np.zeros((2, 7, 6)), "expected 2 x 7 x 7 numbers, found 2 x 7 x 6"),
        (np.full(FIELD_SHAPE, np.nan), "expected finite numbers"),
    ],
)
def test_fields_that_are_none(field_px: FloatArray, says: str) -> None:
    lens = Pinhole(width_px=64, height_px=48, fx_px=90.0, fy_px=90.0, cx_px=30.0, cy_px=20.0)
    with pytest.raises(CameraError, match=says):
        with_field(lens, np.where(field_px == 0, 1.0, field_px))


def test_a_field_that_folds_is_outside_the_domain() -> None:
    lens = Pinhole(width_px=64, height_px=48, fx_px=90.0, fy_px=90.0, cx_px=30.0, cy_px=20.0)
    steep = np.broadcast_to(100.0 * np.arange(7.0), FIELD_SHAPE)
    assert not with_field(lens, steep).unproject(np.array([[30.0, 20.0]])).valid.any()


def test_equal_coefficients_are_a_shift() -> None:
    fields = Fields(coefficients_px=np.full((1, *FIELD_SHAPE), 0.3), row=np.zeros(2, dtype=int), size_px=SIZE)
    uv = np.random.default_rng(0).uniform(0, 640, (50, 2))
    assert fields.at(np.arange(50) % 2, uv) == pytest.approx(0.3, abs=1e-12)


def on_a_grid(coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) all over an image of 1024 x 768, and a field there (n, 2)."""
    grid = (np.arange(100) + 0.5) / 100 * 1024 - 0.5
    uv = np.stack(np.meshgrid(grid, grid * 0.75), axis=-1).reshape(-1, 2)
    field = Fields(coefficients_px=coefficients[None], row=np.zeros(1, dtype=int), size_px=SIZE[:1])
    return uv, field.at(np.zeros(len(uv), dtype=int), uv)


def test_how_large_a_field_without_an_affine_part_is() -> None:
    along = gram_along_side()
    assert along.sum() == pytest.approx(1.0)  # of a field of ones
    free = field_covariance(FIELD_PER_COEFFICIENT)[:49, :49]
    assert np.sqrt(np.sum(np.kron(along, along) * free)) == pytest.approx(FIELD_PER_COEFFICIENT, rel=1e-5)
    fields = without_affine(np.random.default_rng(3).normal(size=(300, *FIELD_SHAPE)))
    size_px = np.sqrt(np.mean([np.mean(on_a_grid(field)[1] ** 2) for field in fields]))
    assert size_px == pytest.approx(FIELD_PER_COEFFICIENT, rel=0.02)


def test_a_free_field_has_no_shift_no_stretch_and_no_shear() -> None:
    """In the least squares over the image, for what is drawn and for what a prior allows."""
    root = np.linalg.cholesky(field_covariance(0.7))
    for z in np.random.default_rng(4).normal(size=(3, len(root))):
        allowed = (root @ z).reshape(FIELD_SHAPE)
        for field, most in ((allowed, 5e-3), (without_affine(allowed), 2e-3)):
            uv, at = on_a_grid(field)
            assert np.sqrt(np.mean(at**2)) > 0.4
            affine = np.column_stack([np.ones(len(uv)), uv / 1024])
            assert np.abs(np.linalg.lstsq(affine, at, rcond=None)[0]).max() < most
