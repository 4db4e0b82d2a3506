"""Least-squares matching of patches: its own linear algebra."""

import numpy as np
import pytest

from pancam_graph.images._patches import _invert


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
