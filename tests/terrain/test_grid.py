"""Grids: what one frame sees, fused with others, and how far frames differ."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.data import StereoNodes
from pancam_graph.terrain import Agreement, TerrainOptions
from pancam_graph.terrain._agreement import agreement_of
from pancam_graph.terrain._fused import fuse
from pancam_graph.terrain._grid import Grid, Layer, grid_around
from pancam_graph.terrain._surface import SharedErrors
from pancam_graph.terrain.kernel import raster_quads

GRID = Grid(left_m=0.0, top_m=2.0, cell_m=0.1, rows=20, columns=20)


def drawn(step: float, *, jump: bool = False) -> NDArray[np.float32]:
    """Bands (5, 20, 20) of points `step` cells apart on the plane z = 1 + 0.1 column - 0.05 row."""
    count = int(20 / step) + 1
    row, column = np.mgrid[:count, :count] * step - 0.3
    points = np.stack([column, row, 1 + 0.1 * column - 0.05 * row], axis=-1)
    disparity = np.full((count, count), 5, dtype=np.float32)
    if jump:
        disparity[:, count // 2 :] += 1
    flat = np.full((count, count), 0.01, dtype=np.float32)
    total = np.zeros((5, 20, 20), dtype=np.float32)
    raster_quads(points, flat, 100 * flat, disparity, 0.6, 1.5, total)
    return total


def test_sparse_points_of_one_surface_have_no_holes_between_them() -> None:
    total = drawn(2.7)
    row, column = np.mgrid[:18, :18]
    between = total[3, :18, :18] == 0
    assert between.sum() > 200
    assert (total[0, :18, :18] > 0).all()
    truth = 1 + 0.1 * column - 0.05 * row
    np.testing.assert_allclose(total[1, :18, :18][between], truth[between], atol=1e-5)
    np.testing.assert_allclose(total[2, :18, :18][between], 1.0, rtol=1e-5)


def test_what_an_edge_hides_stays_empty() -> None:
    hidden = (drawn(2.7)[0] > 0) & (drawn(2.7, jump=True)[0] == 0)
    assert 10 < hidden.sum() < 80
    assert np.ptp(np.nonzero(hidden)[1]) <= 3  # between the two columns of points beside the jump


def test_dense_points_are_averaged_as_if_few_were_independent() -> None:
    total = drawn(0.25)
    assert total[3, 5:15, 5:15].min() >= 9
    np.testing.assert_allclose(total[4, 5:15, 5:15], 0.01 * 1.5 / total[3, 5:15, 5:15], rtol=1e-4)


def layer(frame: int, height: float, sigma: float, first_row: int = 2, rows: int = 15) -> Layer:
    flat = np.ones((rows, 12), dtype=np.float32)
    return Layer(
        frame=frame,
        first_row=first_row,
        first_column=3,
        height_m=flat * np.float32(height),
        variance_m2=flat * np.float32(sigma**2),
        grey=flat * 50,
    )


def test_frames_are_fused_by_their_variances_and_one_that_is_far_off_counts_little() -> None:
    two = fuse(GRID, [layer(0, 1.0, 0.01), layer(1, 1.01, 0.02)])
    assert (two.grid.rows, two.grid.columns) == (15, 12)
    assert (two.grid.left_m, two.grid.top_m) == pytest.approx((0.3, 1.8))
    assert two.height_m[4, 4] == pytest.approx(1.002)
    assert two.sigma_m[4, 4] == pytest.approx(np.sqrt(1 / (1 / 1e-4 + 1 / 4e-4)), rel=1e-4)
    assert two.count[4, 4] == 2
    assert two.disagreement_m[4, 4] == pytest.approx(0.004, rel=1e-3)
    three = fuse(GRID, [layer(0, 1.0, 0.01), layer(1, 1.004, 0.01), layer(2, 3.0, 0.01)])
    assert abs(three.height_m[4, 4] - 1.002) < 0.005  # the mean is 0.67 off
    assert three.sigma_m[4, 4] > 0.01  # and the frames say that something is wrong


def test_telemetrys_surface_is_cut_to_where_the_refined_one_lies() -> None:
    moved = replace(layer(0, 1.3, 0.01, first_row=0), first_column=8)
    fused = fuse(GRID, [layer(0, 1.0, 0.01)], [moved])
    assert fused.telemetry_m.shape == fused.height_m.shape == (15, 12)
    np.testing.assert_allclose(fused.telemetry_m[:13, 5:], 1.3, rtol=1e-6)
    assert np.isnan(fused.telemetry_m[13:]).all()
    assert np.isnan(fused.telemetry_m[:, :5]).all()
    assert np.isnan(fuse(GRID, [layer(0, 1.0, 0.01)]).telemetry_m).all()


def test_cells_that_one_frame_sees_have_no_disagreement_and_others_are_empty() -> None:
    fused = fuse(GRID, [layer(0, 1.0, 0.01, rows=5), layer(1, 1.0, 0.01, first_row=12, rows=4)])
    assert fused.height_m.shape == (14, 12)
    assert np.isnan(fused.disagreement_m).all()
    assert np.isnan(fused.height_m[5:10]).all()
    assert (fused.count[5:10] == 0).all()


def test_agreement_is_the_median_difference_before_and_after() -> None:
    refined = [layer(0, 1.0, 0.01), layer(1, 1.02, 0.01), layer(2, 1.0, 0.01, first_row=17, rows=2)]
    telemetry = [layer(0, 1.0, 0.01), layer(1, 1.12, 0.01), layer(2, 9.0, 0.01, first_row=17, rows=2)]
    found = agreement_of(refined, telemetry, np.array([0, 1, 1]))
    assert [p.frames for p in found.pairs] == [(0, 1)]  # frame 2 shares too few cells
    assert found.pairs[0].cells == 180
    assert found.median_m("telemetry") == pytest.approx(0.12, rel=1e-4)
    assert found.median_m("refined") == pytest.approx(0.02, rel=1e-4)
    assert found.median_sigmas == pytest.approx(0.02 / np.hypot(0.01, 0.01), rel=1e-4)
    assert np.isnan(found.median_m("refined", same_stop=True))
    assert np.isnan(Agreement(pairs=()).median_m("refined"))


def test_a_cell_too_small_for_memory_is_refused_with_one_that_fits() -> None:
    centres = np.array([[0.0, 0.0, 1.5], [100.0, 0.0, 1.5]])
    with pytest.raises(InputError, match=r"150 m x 50 m, that is a cell of 0\.012 m or more, found 0\.001 m"):
        grid_around(centres, 25.0, 0.001)
    assert grid_around(centres, 25.0, 0.012).columns == 12501
    with pytest.raises(InputError, match="terrain: cell_m: expected a number above 0, found 0"):
        TerrainOptions(cell_m=0.0)


def test_errors_in_common_are_not_averaged_out() -> None:
    common = replace(layer(0, 1.0, 0.01), shared_m2=np.full((15, 12), 9e-4, dtype=np.float32))
    other = replace(layer(1, 1.0, 0.01), shared_m2=np.full((15, 12), 1e-4, dtype=np.float32))
    alone, both = fuse(GRID, [common]), fuse(GRID, [common, other])
    assert alone.sigma_m[4, 4] == pytest.approx(np.sqrt(1e-4 + 9e-4), rel=1e-4)
    assert both.sigma_m[4, 4] == pytest.approx(np.sqrt(0.5e-4 + 5e-4), rel=1e-4)


def test_an_error_in_common_lifts_cells_by_their_distance_and_their_slope() -> None:
    """Nodes say that depths err by 1 % in common; the camera looks along x from 2 m above the ground."""
    R = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    depth = 0.8 * 1.6 ** np.arange(12.0)
    nodes = np.zeros((12, 7, 7, 6))
    nodes[..., 5] = 0.01**2
    errors = SharedErrors(
        world_R_camera=R,
        world_t_camera=np.array([0.0, 0.0, 2.0]),
        depth_m=depth,
        nodes=StereoNodes(np.array([-1.0, 1.0, -1.0, 1.0]), nodes),
    )
    x, y = np.linspace(3.0, 6.0, 31), np.linspace(1.0, -1.0, 21)
    level = np.zeros((21, 31), dtype=np.float32)
    # A ray that ends 1 % too far ends 1 % of the camera's height too low.
    np.testing.assert_allclose(np.sqrt(errors.of_heights(x, y, level)), 0.02, rtol=1e-5)
    slope = (0.2 * (x - 3.0) * np.ones((21, 1))).astype(np.float32)
    lifted = np.sqrt(errors.of_heights(x, y, slope)[5:-5, 5:-5])
    expected = np.abs(0.01 * (2.0 - 0.2 * (x - 3.0)) + 0.2 * 0.01 * x)[5:-5]
    np.testing.assert_allclose(lifted, np.broadcast_to(expected, lifted.shape), rtol=1e-4)
    level[3, 4] = np.nan
    assert np.flatnonzero(np.isnan(errors.of_heights(x, y, level))).tolist() == [3 * 31 + 4]
