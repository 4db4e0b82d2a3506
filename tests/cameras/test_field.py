"""Smooth distortion fields against SciPy's splines."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import FIELD_PER_COEFFICIENT, FIELD_SHAPE, Fields

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


def test_beyond_the_edge_the_outermost_cells_go_on() -> None:
    fields = random_fields()
    step = np.linspace(-3.0, 3.0, 13)
    along = fields.at(np.zeros(13, dtype=int), np.column_stack([-0.5 + step, np.full(13, 300.0)]))
    assert np.diff(along, 4, axis=0) == pytest.approx(0.0, abs=1e-9)  # one cubic on both sides


def test_equal_coefficients_are_a_shift() -> None:
    fields = Fields(coefficients_px=np.full((1, *FIELD_SHAPE), 0.3), row=np.zeros(2, dtype=int), size_px=SIZE)
    uv = np.random.default_rng(0).uniform(0, 640, (50, 2))
    assert fields.at(np.arange(50) % 2, uv) == pytest.approx(0.3, abs=1e-12)


def test_how_large_a_field_of_independent_coefficients_is() -> None:
    grid = (np.arange(400) + 0.5) / 400 * 1024 - 0.5
    uv = np.stack(np.meshgrid(grid, grid * 0.75), axis=-1).reshape(-1, 2)
    _, weight = random_fields().basis(np.zeros(len(uv), dtype=int), uv)
    assert np.sqrt(np.mean(np.sum(weight**2, axis=(1, 2)))) == pytest.approx(FIELD_PER_COEFFICIENT, rel=1e-4)
