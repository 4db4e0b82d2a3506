"""The noise scale of residuals, however many of them are outliers."""

from collections.abc import Callable

import numpy as np
import pytest

from pancam_graph.base.geometry import FloatArray
from pancam_graph.solve._noise_scale import noise_scale
from support.parameters import slow_for

NOISE = 0.7
Outliers = Callable[[np.random.Generator, tuple[int, int]], FloatArray]
ANYWHERE: Outliers = lambda rng, shape: rng.uniform(-500, 500, shape)  # noqa: E731  one of a table of draws
NEAR: Outliers = lambda rng, shape: rng.uniform(-15, 15, shape)  # noqa: E731  one of a table of draws


def squares(seed: int, n: int, freedom: int, share: float, outliers: Outliers) -> FloatArray:
    rng = np.random.default_rng(seed)
    residual = NOISE * rng.normal(size=(n, freedom))
    wrong = rng.random(n) < share
    residual[wrong] = outliers(rng, (int(wrong.sum()), freedom))
    return np.asarray((residual**2).sum(axis=1))


@pytest.mark.parametrize("freedom", [1, 2])
@pytest.mark.parametrize("share", slow_for([0.05, 0.3, 0.7], [0.0, 0.05, 0.3, 0.5, 0.7, 0.85]))
@pytest.mark.parametrize("outliers", [ANYWHERE, NEAR], ids=["anywhere", "near"])
def test_outliers_up_to_six_sevenths_do_not_move_it(freedom: int, share: float, outliers: Outliers) -> None:
    """Where outliers crowd within twenty sigmas of the noise, a part of them passes for its tail."""
    tolerance = 0.3 if outliers is NEAR and share > 0.5 else 0.1
    for seed in range(3):
        test = squares(seed, 4000, freedom, share, outliers)
        assert noise_scale(test, np.full(4000, freedom)) == pytest.approx(NOISE, rel=tolerance)


def test_it_scales_with_the_residuals() -> None:
    test = squares(0, 500, 2, 0.3, ANYWHERE)
    freedom = np.full(500, 2)
    assert noise_scale(1e-6 * test, freedom) == pytest.approx(1e-3 * noise_scale(test, freedom), rel=1e-9)
    assert noise_scale(1e6 * test, freedom) == pytest.approx(1e3 * noise_scale(test, freedom), rel=1e-9)


def test_residuals_without_freedom_say_nothing() -> None:
    test, freedom = squares(0, 500, 2, 0.3, ANYWHERE), np.full(500, 2)
    more = np.concatenate([test, np.full(2000, 1e-9)])
    assert noise_scale(more, np.concatenate([freedom, np.zeros(2000, dtype=int)])) == noise_scale(
        test, freedom
    )
    assert noise_scale(np.zeros(0), np.zeros(0, dtype=int)) == 0.0
    assert noise_scale(np.zeros(7), np.full(7, 2)) == 0.0
