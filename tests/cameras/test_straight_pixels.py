"""Measured pixels as the pinhole of the same camera has them, and its residuals turned back."""

from dataclasses import replace

import numpy as np
import pytest

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras import Camera, straight_pixels
from support.lenses import ALL, BROWN, CAHVORE_CAMERA, CENTRAL, FAR, PINHOLE, pixels


def carried_to_pinhole(
    camera: Camera, uv_px: FloatArray, range_m: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Pixels of the camera's own pinhole, matrices that turn its residuals back, and validity."""
    carried, forward, valid = straight_pixels(camera, camera.pinhole, uv_px, range_m)
    return carried, np.asarray(np.linalg.inv(forward)), valid


@pytest.mark.parametrize("camera", ALL.values(), ids=ALL)
@pytest.mark.parametrize("range_m", [2.0, 30.0, FAR])
def test_a_carried_pixel_is_where_the_pinhole_sees_the_same_point(camera: Camera, range_m: float) -> None:
    """The range counts from the camera's centre, also where the ray starts at a pupil beside it."""
    uv = pixels()
    rays = camera.unproject(uv)
    points = rays.origin_m + range_m * rays.direction
    carried, _, valid = carried_to_pinhole(camera, uv, np.linalg.norm(points, axis=1))
    assert valid.all()
    again = camera.pinhole.project(points)[0]
    assert carried == pytest.approx(again, abs=1e-9)
    assert camera.project(points)[0] == pytest.approx(uv, abs=1e-8)


@pytest.mark.parametrize("camera", CENTRAL.values(), ids=CENTRAL)
def test_a_carried_pixel_lies_on_the_same_line_of_sight(camera: Camera) -> None:
    """At any range: a central camera's carried pixels do not depend on it."""
    uv = pixels()
    near, _, _ = carried_to_pinhole(camera, uv, np.full(len(uv), 1.0))
    far, _, _ = carried_to_pinhole(camera, uv, np.full(len(uv), FAR))
    assert near == pytest.approx(far, abs=1e-8)
    direction = camera.pinhole.unproject(near).direction
    assert direction == pytest.approx(camera.unproject(uv).direction, abs=1e-12)


def displaced(camera: Camera, range_m: float, step_m: float) -> tuple[FloatArray, FloatArray]:
    """Residuals (n, 2) of points moved off their lines of sight: the pinhole's turned back, the image's."""
    rng = np.random.default_rng(1)
    uv = pixels()
    rays = camera.unproject(uv)
    points = rays.origin_m + range_m * rays.direction
    moved = points + step_m * rng.normal(size=points.shape)
    carried, back, valid = carried_to_pinhole(camera, uv, np.linalg.norm(points, axis=1))
    assert valid.all()
    of_pinhole = camera.pinhole.project(moved)[0] - carried
    return np.einsum("nij,nj->ni", back, of_pinhole), camera.project(moved)[0] - uv


@pytest.mark.parametrize("camera", CENTRAL.values(), ids=CENTRAL)
def test_residuals_turn_back_to_raw_pixels_to_first_order(camera: Camera) -> None:
    """Halving the displacement quarters what is left, which is small against the residual."""
    left = []
    for step_m in (0.02, 0.01):
        turned, raw = displaced(camera, 10.0, step_m)
        assert np.abs(raw).max() > 0.5
        left.append(np.linalg.norm(turned - raw) / np.linalg.norm(raw))
    assert left[0] < 5e-3
    assert left[1] < 0.6 * left[0] or left[0] < 1e-9


def test_distortion_makes_turning_back_matter() -> None:
    """Without the matrices the residuals would be wrong by a tenth."""
    _, back, _ = carried_to_pinhole(BROWN, pixels(), np.full(40, 10.0))
    assert np.abs(np.linalg.det(back) - 1).max() > 0.1


@pytest.mark.parametrize(("range_m", "share"), [(2.0, 1e-2), (10.0, 2e-3), (100.0, 2e-4)])
def test_residuals_of_a_moving_pupil_turn_back_but_for_its_shift_by_the_range(
    range_m: float, share: float
) -> None:
    """The lines of sight of CAHVORE and its pinhole differ by the pupil's shift over the range."""
    turned, raw = displaced(CAHVORE_CAMERA, range_m, 1e-6 * range_m)
    assert np.linalg.norm(turned - raw) < share * np.linalg.norm(raw)


def test_cahvore_depends_on_the_range_and_settles_far_off() -> None:
    uv = pixels()
    carried = [
        carried_to_pinhole(CAHVORE_CAMERA, uv, np.full(len(uv), range_m))[0]
        for range_m in (1.0, 10.0, 1000.0, FAR)
    ]
    shift = [np.linalg.norm(c - carried[-1], axis=1).max() for c in carried[:-1]]
    assert shift[0] > 0.05
    assert shift[0] > 5 * shift[1] > 250 * shift[2] > 0


def test_ranges_belong_to_their_own_pixels() -> None:
    uv = np.repeat(pixels(1), 2, axis=0)
    mixed, back, _ = carried_to_pinhole(CAHVORE_CAMERA, uv, np.array([1.0, FAR]))
    for i, range_m in enumerate((1.0, FAR)):
        alone = carried_to_pinhole(CAHVORE_CAMERA, uv[:1], np.array([range_m]))
        assert mixed[i] == pytest.approx(alone[0][0], abs=1e-12)
        assert back[i] == pytest.approx(alone[1][0], abs=1e-12)


def test_a_pinhole_is_carried_nowhere() -> None:
    uv = pixels()
    carried, back, valid = carried_to_pinhole(PINHOLE, uv, np.full(len(uv), 10.0))
    assert carried.tolist() == uv.tolist()
    assert back.tolist() == [np.eye(2).tolist()] * len(uv)
    assert valid.all()


@pytest.mark.filterwarnings("error")
def test_pixels_outside_the_model_are_invalid_and_stay_finite() -> None:
    """A barrel distortion that folds back has no line of sight for pixels past the fold."""
    folding = replace(BROWN, distortion=(-0.5, 0.0, 0.0, 0.0, 0.0))
    uv = np.array([[321.0, 237.0], [321.0 + 500, 237.0], [-2000.0, 237.0]])
    carried, back, valid = carried_to_pinhole(folding, uv, np.full(3, 10.0))
    assert valid.tolist() == [True, False, False]
    assert np.isfinite(carried).all()
    assert np.isfinite(back).all()
