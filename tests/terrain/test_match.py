"""Disparities of rectified pictures whose truth is a formula."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.terrain._match import match, refined, roughness

ROWS, COLUMNS = 48, 120
SPANS_PX = (3.1, 4.3, 5.7, 7.9, 11.3)


def texture(x: FloatArray, y: FloatArray, seed: int) -> FloatArray:
    """Brightness at any places: waves of several lengths and directions, of more than two pixels."""
    rng, out = np.random.default_rng(seed), np.full(np.broadcast(x, y).shape, 120.0)
    for length in SPANS_PX:
        for _ in range(4):
            turn, phase = rng.uniform(0, 2 * np.pi, 2)
            along = np.cos(turn) * x + np.sin(turn) * y
            out += 5 * np.sin(2 * np.pi * along / length + phase)
    return out


def pictures(
    d0: float, a: float, b: float, *, seed: int = 0, noise: float = 0.0, gain: float = 1.0
) -> tuple[NDArray[np.float32], NDArray[np.float32], FloatArray]:
    """A pair whose disparity is d0 + a (x - x0) + b (y - y0), and that disparity (h, w) in the left one."""
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    rng = np.random.default_rng(seed + 100)
    disparity = d0 + a * (x - COLUMNS / 2) + b * (y - ROWS / 2)
    # The right pixel u shows what the left shows at x with u = x - d(x, y).
    from_left = (x + d0 - a * COLUMNS / 2 + b * (y - ROWS / 2)) / (1 - a)
    left, right = texture(x, y, seed), 10 + gain * texture(from_left, y, seed)
    noisy = [p + rng.normal(0, noise, p.shape) for p in (left, right)]
    return noisy[0].astype(np.float32), noisy[1].astype(np.float32), disparity


def inner(values: NDArray[np.float32]) -> FloatArray:
    return np.asarray(values[6:-6, 30:-8], dtype=float)


@pytest.mark.parametrize(("a", "b", "gain"), [(0.0, 0.0, 1.0), (0.0, 0.13, 1.3), (0.08, -0.1, 0.8)])
def test_slanted_surfaces_are_found_to_a_hundredth_of_a_pixel(a: float, b: float, gain: float) -> None:
    left, right, truth = pictures(12.37, a, b, gain=gain)
    found, spread = refined(left, right, np.rint(truth).astype(np.float32))
    off = inner(found) - inner(truth.astype(np.float32))
    assert np.isfinite(off).all()
    assert np.sqrt(np.mean(off**2)) < 0.01
    assert np.median(inner(spread)) < 0.02


def test_no_part_of_a_pixel_is_preferred() -> None:
    bias = []
    for phase in np.arange(8) / 8:
        off = []
        for seed in (1, 2):
            left, right, truth = pictures(12 + phase, 0.0, 0.1, seed=seed, noise=3.0)
            found, _ = refined(left, right, np.rint(truth).astype(np.float32))
            off.append(inner(found) - inner(truth.astype(np.float32)))
        bias.append(float(np.median(off)))
    assert np.abs(bias).max() < 0.015
    assert np.std(off) > 0.02  # of noise that would show


def test_what_one_eye_does_not_see_has_no_disparity() -> None:
    """A near strip before a far plane: beside it, the far plane is hidden from the right eye."""
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    near = (x > 60) & (x < 90)
    truth = np.where(near, 20.0, 8.0)
    left = np.where(near, texture(x, y, 4), texture(x, y, 5))
    right = texture(x + 8, y, 5)
    shifted = (x + 20 > 60) & (x + 20 < 90)
    right = np.where(shifted, texture(x + 20, y, 4), right)
    everywhere = np.ones(x.shape, dtype=bool)
    sky = y < 5
    found = match(left.astype(np.float32), right.astype(np.float32), (~sky, everywhere), (2.0, 30.0))
    hidden = (x > 49) & (x < 58)
    seen = ~sky & (((x > 25) & (x < 45)) | ((x > 94) & (x < 112)) | ((x > 64) & (x < 86)))
    off = np.abs(found.disparity_px - truth)
    assert np.isnan(found.disparity_px[sky]).all()
    assert np.isfinite(off[seen]).mean() > 0.98
    assert np.nanquantile(off[seen], 0.99) < 0.1
    assert np.isnan(found.disparity_px[hidden]).mean() > 0.8


def test_a_plane_is_smooth_and_what_bends_is_as_rough_as_it_bends() -> None:
    y, x = np.mgrid[:40, :60].astype(np.float32)
    plane = 200 + 0.13 * y - 0.05 * x
    np.testing.assert_allclose(roughness(plane)[4:-4, 4:-4], 0, atol=5e-4)
    bumps = (plane + np.random.default_rng(0).normal(0, 0.3, plane.shape)).astype(np.float32)
    assert np.sqrt(np.mean(roughness(bumps)[4:-4, 4:-4] ** 2)) == pytest.approx(
        0.3 * np.sqrt(1 - 3 / 81), rel=0.03
    )
    # Of a parabola x^2 / 2 of the rate c: the root mean square of c (x^2 - <x^2>) / 2 over -4 to 4.
    bend = 0.01
    square = np.arange(-4, 5.0) ** 2
    expected = bend / 2 * np.std(square)
    bent = (plane + 0.5 * bend * (x - 30) ** 2).astype(np.float32)
    np.testing.assert_allclose(roughness(bent)[4:-4, 4:-4], expected, rtol=1e-3)


def test_holes_and_edges_do_not_make_it_rough() -> None:
    y, x = np.mgrid[:40, :60].astype(np.float32)
    plane = 20 + 0.13 * y - 0.05 * x
    plane[10:15, 20:33] = np.nan
    plane[np.random.default_rng(1).random(plane.shape) < 0.2] = np.nan
    rough = roughness(plane)
    assert np.isfinite(rough).all()
    # With holes the two slopes are not independent: fitted each for itself, they leave some of each other.
    assert np.quantile(rough, 0.9) < 0.08
    assert (roughness(np.full((12, 12), np.nan, dtype=np.float32)) == 0).all()
