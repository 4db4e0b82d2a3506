"""Spline coefficients of images: those of a blurred image that splines go through."""

import numpy as np
import pytest
import scipy

from pancam_graph.images._splines import Splines


@pytest.mark.parametrize("half_octaves", [0, 1, 3])
def test_splines_go_through_the_blurred_image(half_octaves: int) -> None:
    rng = np.random.default_rng(half_octaves)
    image = rng.integers(0, 4096, (61, 90)).astype(np.uint16)
    coefficients = Splines(lambda _: image)(0, half_octaves)
    assert coefficients.dtype == np.float32
    sigma = 0.7 * 2 ** (half_octaves / 2)
    blurred = scipy.ndimage.gaussian_filter(image.astype(float), sigma, mode="mirror")
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    through = scipy.ndimage.map_coordinates(
        coefficients.astype(float), [v, u], prefilter=False, mode="mirror"
    )
    assert through == pytest.approx(blurred, abs=4096 * 1e-6)


def test_an_even_image_has_even_coefficients() -> None:
    even = np.full((20, 30), 7, np.uint8)
    assert Splines(lambda _: even)(0) == pytest.approx(np.full((20, 30), 7.0), abs=1e-5)
