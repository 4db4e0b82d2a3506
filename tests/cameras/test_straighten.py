"""The pinhole that images are resampled to, and the way back to the image."""

from dataclasses import replace

import numpy as np
import pytest

from pancam_graph.base.errors import CameraError
from pancam_graph.cameras import (
    CAHVOR,
    CAHVORE,
    Brown,
    Camera,
    straight_pixels,
    straightened,
    straightening_map,
)
from support.lenses import ALL, BROWN, CAHVORE_CAMERA, PINHOLE, pixels

RANGE_M = 6.0
DISTORTED = {name: camera for name, camera in ALL.items() if name != "pinhole"}


@pytest.mark.parametrize("name", DISTORTED)
def test_the_image_is_within_and_the_frame_is_tight(name: str) -> None:
    camera = DISTORTED[name]
    straight = straightened(camera, RANGE_M)
    assert straight.skew_px == 0
    assert (straight.fx_px, straight.fy_px) == (camera.pinhole.fx_px, camera.pinhole.fy_px)
    uv = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), -1).reshape(-1, 2)
    at_the_edge = ((uv == 0) | (uv == [639, 479])).any(axis=1)
    uv = uv[at_the_edge | (uv % 8 == 0).all(axis=1)]
    seen, _, valid = straight_pixels(camera, straight, uv, np.full(len(uv), RANGE_M))
    assert valid.all()
    assert (seen > -1e-5).all()
    low, high = seen.min(axis=0), seen.max(axis=0)
    size = [straight.width_px - 1, straight.height_px - 1]
    assert (high < np.array(size) + 1e-5).all()
    assert (low < 1).all()
    assert (high > np.array(size) - 1).all()


@pytest.mark.parametrize("camera", DISTORTED.values(), ids=DISTORTED)
def test_the_map_leads_back_to_the_pixel(camera: Camera) -> None:
    """Cubic between every eighth pixel; the way forth is the carry, the way back the projection."""
    straight = straightened(camera, RANGE_M)
    lookup = straightening_map(camera, straight, RANGE_M)
    assert lookup is not None
    assert lookup.shape == (straight.height_px, straight.width_px, 2)
    column, row = np.random.default_rng(1).integers(0, [straight.width_px, straight.height_px], (200, 2)).T
    raw = lookup[row, column]
    inside = camera.contains(raw)
    forth, _, valid = straight_pixels(camera, straight, raw, np.full(200, RANGE_M))
    assert inside.mean() > 0.7
    assert valid[inside].all()
    assert forth[inside] == pytest.approx(np.column_stack([column, row])[inside].astype(float), abs=1e-5)


@pytest.mark.parametrize("camera", ALL.values(), ids=ALL)
def test_small_residuals_are_enlarged_as_the_image_is(camera: Camera) -> None:
    straight, uv, step = straightened(camera, RANGE_M), pixels(), 1e-4
    far = np.full(len(uv), 1e5)
    at, enlargement, _ = straight_pixels(camera, straight, uv, far)
    for axis in (0, 1):
        moved, _, _ = straight_pixels(camera, straight, uv + step * np.eye(2)[axis], far)
        assert (moved - at) / step == pytest.approx(enlargement[:, :, axis], abs=1e-4)


def test_a_pinhole_without_skew_stays_as_it_is() -> None:
    plain = replace(PINHOLE, skew_px=0.0)
    assert straightened(plain, RANGE_M) == plain
    assert straightening_map(plain, plain, RANGE_M) is None


def test_a_linear_camera_of_the_family_is_not_resampled_for_rounding() -> None:
    camera = CAHVOR(
        width_px=640,
        height_px=480,
        C=np.zeros(3),
        A=np.array([0.0, 0.0, 1.0]),
        H=np.array([500.0, 0.0, 321.0]),
        V=np.array([0.0, 510.0, 237.0]),
        O=np.array([0.0, 0.0, 1.0]),
        R=np.zeros(3),
    ).split()[0]
    straight = straightened(camera, RANGE_M)
    assert (straight.width_px, straight.height_px) == (640, 480)
    assert straightening_map(camera, straight, RANGE_M) is None


@pytest.mark.slow
def test_a_very_wide_lens_is_cropped_and_has_no_pixel_beyond_its_domain() -> None:
    """Pincushion of a fish-eye: the pinhole would have to be many times as large."""
    assert isinstance(CAHVORE_CAMERA, CAHVORE)
    wide: Camera = replace(CAHVORE_CAMERA, linearity=0.0, H=CAHVORE_CAMERA.H / 2.2, V=CAHVORE_CAMERA.V / 2.2)
    wide = wide.with_calibration(np.array([[200.0, 0, 320], [0, 200.0, 240], [0, 0, 1]]))
    straight = straightened(wide, RANGE_M)
    assert straight.width_px <= 2 * 640
    assert straight.height_px <= 2 * 480
    folding = Brown(
        width_px=640,
        height_px=480,
        fx_px=300.0,
        fy_px=300.0,
        cx_px=320.0,
        cy_px=240.0,
        distortion=(-0.5, 0.0, 0.0, 0.0, 0.0),
    )
    lookup = straightening_map(folding, straightened(folding, RANGE_M), RANGE_M)
    assert lookup is not None
    assert np.isnan(lookup).any()
    assert not np.isnan(lookup[lookup.shape[0] // 2]).all()


def test_a_camera_that_no_pinhole_can_show_is_refused() -> None:
    """All its pixels lie beyond where the distortion folds back."""
    off = replace(BROWN, cx_px=5000.0, distortion=(-0.5, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(CameraError, match="line of sight that a pinhole can show"):
        straightened(off, RANGE_M)
