"""Views of a finished panorama: from the pole, and for two eyes."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.mosaic import Cylinder, Mosaic
from pancam_graph.mosaic._anaglyph import with_parallax
from pancam_graph.mosaic._polar import directions_deg, goes_half_round, polar_view
from pancam_graph.mosaic._resampled import Resampled
from pancam_graph.mosaic._surface import Surface

PX_PER_DEGREE = 4.0
ORIGIN_M = np.array([1.0, 2.0, 3.0])


def cylinder(left_deg: float = 180.0, top_deg: float = 10.0, width_deg: float = 360.0) -> Cylinder:
    return Cylinder(
        origin_m=ORIGIN_M,
        width_px=round(width_deg * PX_PER_DEGREE),
        height_px=round(60 * PX_PER_DEGREE),
        px_per_degree=PX_PER_DEGREE,
        left_deg=left_deg,
        top_deg=top_deg,
    )


def spotted(around: Cylinder, azimuth_deg: float, elevation_deg: float) -> Mosaic:
    """A grey panorama with a bright spot in a direction."""
    column, row = np.meshgrid(np.arange(around.width_px), np.arange(around.height_px))
    at = (
        (around.left_deg - azimuth_deg) % 360 * PX_PER_DEGREE,
        (around.top_deg - elevation_deg) * PX_PER_DEGREE,
    )
    across = np.abs(column - at[0])
    if around.closed:
        across = np.minimum(across, around.width_px - across)
    spot = np.exp(-(across**2 + (row - at[1]) ** 2) / 18.0)
    picture = np.rint(50 + 180 * spot).astype(np.uint8)
    return Mosaic(
        projection=around,
        pictures={"telemetry": picture, "refined": picture},
        samples=None,
        dark=0.0,
        bright=1.0,
    )


def centre(grey: NDArray[np.float64]) -> FloatArray:
    """Column and row of the brightest spot."""
    weight = np.maximum(grey - 120.0, 0.0)
    rows, columns = np.indices(grey.shape)
    return np.asarray(np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum())


@pytest.mark.parametrize("azimuth", [0.0, 37.0, 180.0, -179.9, 250.0])
@pytest.mark.parametrize("px_per_degree", [4.0, 2.5])
def test_a_panorama_is_asked_in_any_direction(azimuth: float, px_per_degree: float) -> None:
    mosaic = spotted(cylinder(), azimuth, -12.0)
    asked = Resampled(cylinder(), mosaic.pictures["refined"], px_per_degree)
    offset = np.linspace(-6, 6, 121)
    grey, there = asked.at(*np.meshgrid(azimuth - offset, -12.0 - offset))
    assert there.all()
    assert centre(grey) == pytest.approx([60, 60], abs=0.5)
    _, beyond = asked.at(np.array([[azimuth]]), np.array([[25.0]]))
    assert not beyond.any()


@pytest.mark.parametrize("north_deg", [None, 0.0, 72.0, -130.0])
def test_north_is_up_and_azimuths_grow_clockwise(north_deg: float | None) -> None:
    """A spot 30 degrees clockwise from up, 18 below the horizon."""
    up_deg = 90.0 if north_deg is None else north_deg
    mosaic = spotted(cylinder(), up_deg - 30.0, -18.0)
    view = polar_view(mosaic, "refined", "a title", 600, north_deg=north_deg)
    scale = (300 - 30) / 100.0
    inside = view[46:646, 108:708, 1].astype(float)
    inside[np.ptp(view[46:646, 108:708], axis=-1) > 0] = 0  # lines and labels
    inside[inside > 226] = 0  # the paper
    expected = 299.5 + scale * 72.0 * np.array([np.sin(np.pi / 6), -np.cos(np.pi / 6)])
    rows, columns = np.indices(inside.shape)
    inside[np.hypot(columns - expected[0], rows - expected[1]) > 15] = 0
    assert centre(inside) == pytest.approx(expected, abs=1.0)


def test_directions_of_a_disc_reach_the_nadir_and_the_horizon() -> None:
    azimuth, elevation = directions_deg(181, 1.0, 90.0)
    assert elevation[90, 90] == pytest.approx(-90)
    assert elevation[90, [0, 180]] == pytest.approx(0)
    assert [azimuth[0, 90], azimuth[90, 180] % 360, azimuth[90, 0] % 360] == pytest.approx([90, 0, 180])


def test_a_narrow_panorama_has_no_view_from_the_pole() -> None:
    assert goes_half_round(cylinder())
    assert goes_half_round(cylinder(width_deg=180.0))
    assert not goes_half_round(cylinder(width_deg=170.0))


@pytest.mark.parametrize("azimuth", [60.0, -60.0])
def test_what_is_near_is_to_the_right_for_the_left_eye(azimuth: float) -> None:
    """Ground 2 m away on one half, 10 m on the other; the right panorama is of another size."""
    relief = np.full((181, 360), 0.1)
    relief[:, :180] = 0.5
    surface = Surface(origin_m=ORIGIN_M, plane=np.zeros(3), relief=relief)
    left, right = cylinder(), cylinder(top_deg=8.0, left_deg=180.0)
    seen, there = with_parallax(
        spotted(left, azimuth, -20.0), spotted(right, azimuth, -20.0), surface, 0.2, "refined", 1.0
    )
    apart_px = (centre(seen[0]) - centre(seen[1]))[0] / PX_PER_DEGREE
    # The median of the two halves is one of them, or between them.
    nearer = np.rad2deg(0.2 * 0.4)
    other, _ = with_parallax(
        spotted(left, -azimuth, -20.0), spotted(right, -azimuth, -20.0), surface, 0.2, "refined", 1.0
    )
    other_px = (centre(other[0]) - centre(other[1]))[0] / PX_PER_DEGREE
    assert apart_px - other_px == pytest.approx(nearer if azimuth > 0 else -nearer, abs=0.05)
    assert (centre(seen[0]) - centre(seen[1]))[1] == pytest.approx(0, abs=0.05)
    assert there[20:-20].all()
