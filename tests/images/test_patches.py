"""Least-squares matching of patches: places that are known, and its own linear algebra."""

import numpy as np
import pytest
from scipy import ndimage

from pancam_graph.base.geometry import FloatArray
from pancam_graph.images._local_map import local_map
from pancam_graph.images._patches import QUALITIES, _invert, align_patches


@pytest.mark.parametrize("condition", [1.0, 1e4, 1e9])
def test_the_inverse_of_normal_matrices(condition: float) -> None:
    """Against NumPy's, up to the largest condition that the matching's own ridge allows."""
    rng = np.random.default_rng(round(condition))
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    normal = axes * np.geomspace(1, condition, 6) @ axes.T
    inverse = np.empty((6, 6))
    _invert(np.tril(normal), inverse)
    np.testing.assert_array_equal(inverse, inverse.T)
    np.testing.assert_allclose(inverse, np.linalg.inv(normal), rtol=0, atol=1e-14 * condition)


def coefficients(image: FloatArray) -> np.ndarray:
    blurred = ndimage.gaussian_filter(image, 0.7)
    return ndimage.spline_filter(blurred, 3, mode="mirror").astype(np.float32)


def test_patches_are_found_from_afar_and_through_an_unknown_affine_map() -> None:
    rng = np.random.default_rng(0)
    image_a = 100 * ndimage.gaussian_filter(rng.standard_normal((220, 240)), 1.5)
    affine, middle, shift = (
        np.array([[1.1, 0.05], [-0.03, 0.95]]),
        np.array([120.0, 110.0]),
        np.array([4.3, -2.7]),
    )
    v, u = np.mgrid[:220, :240]
    source = (np.stack([u, v], -1).reshape(-1, 2) - middle - shift) @ np.linalg.inv(affine).T + middle
    image_b = ndimage.map_coordinates(image_a, source.T[::-1], order=3, mode="mirror").reshape(220, 240)
    uv_a = rng.uniform(70, 150, (300, 2))
    truth = (uv_a - middle) @ affine.T + middle + shift
    start = truth + rng.uniform(-4, 4, truth.shape)
    found, fit = start.copy(), np.empty((300, QUALITIES))
    unknown = np.tile(np.eye(2), (300, 1, 1))
    reach = np.full((300, 2), 6, dtype=np.int64)
    pictures = coefficients(image_a), coefficients(image_b)
    align_patches(0, 300, *pictures, uv_a, unknown, np.zeros((300, 2, 3)), reach, 10, found, fit)
    error = np.linalg.norm(found - truth, axis=1)
    assert np.quantile(error, 0.99) < 0.03
    assert fit[:, 1].min() > 0.99
    assert np.all(fit[:, 1] >= fit[:, 0])
    # Of a patch that has a likeness nowhere else, the second best is far behind.
    assert np.median(fit[:, 2]) < 0.8


def test_a_bend_that_is_known_moves_no_patch() -> None:
    """Images that differ by a quadratic map: patches that know it are placed right, others to one side."""
    rng = np.random.default_rng(1)
    image_b = 100 * ndimage.gaussian_filter(rng.standard_normal((220, 240)), 1.5)
    middle, curve = np.array([120.0, 110.0]), 2e-3

    def to_b(uv: FloatArray) -> FloatArray:
        return uv + 0.5 * curve * np.column_stack([(uv[:, 0] - middle[0]) ** 2, np.zeros(len(uv))])

    v, u = np.mgrid[:220, :240]
    source = to_b(np.stack([u, v], -1).reshape(-1, 2).astype(float))
    image_a = ndimage.map_coordinates(image_b, source.T[::-1], order=3, mode="mirror").reshape(220, 240)
    uv_a = rng.uniform(80, 150, (400, 2))
    affine, bend = local_map(lambda du, dv: to_b(uv_a + np.array([du, dv])))
    assert np.allclose(bend, np.array([[curve, 0.0, 0.0], [0.0, 0.0, 0.0]]), atol=1e-9)
    off = {}
    for name, known in (("known", bend), ("unknown", np.zeros_like(bend))):
        found, fit = to_b(uv_a), np.empty((400, QUALITIES))
        pictures = coefficients(image_a), coefficients(image_b)
        reach = np.zeros((400, 2), dtype=np.int64)
        align_patches(0, 400, *pictures, uv_a, affine, known, reach, 10, found, fit)
        off[name] = float(np.median((found - to_b(uv_a))[:, 0]))
    assert abs(off["known"]) < 1e-3
    assert off["unknown"] > 0.008
