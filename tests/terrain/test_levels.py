"""Grids that get coarser outward, as one surface, and small holes that are filled."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.terrain import Fused, TerrainOptions
from pancam_graph.terrain._fill import filled
from pancam_graph.terrain._grid import Grid
from pancam_graph.terrain._levels import composed, levels_around
from pancam_graph.terrain._mesh import mesh_glb

MASTS = np.array([[0.3, -0.2, 1.5], [5.1, 0.4, 1.5]])
STANDS_M, FOCAL_PX = 1.5, 1200.0
SLOPE = np.array([0.2, -0.1])


def plane(grid: Grid, *, beyond_m: float = 0.0) -> Fused:
    """A slope, hidden near the origin."""
    x, y = np.meshgrid(*grid.middles())
    seen = np.hypot(x, y) >= beyond_m
    height = np.where(seen, SLOPE[0] * x + SLOPE[1] * y, np.nan).astype(np.float32)
    ones = np.where(seen, 1.0, np.nan).astype(np.float32)
    return Fused(
        grid=grid,
        height_m=height,
        sigma_m=0.01 * ones,
        count=np.nan_to_num(ones),
        disagreement_m=0 * ones,
        grey=100 * ones,
        telemetry_m=height + 1,
    )


def test_cells_double_outward_and_a_hundred_metres_fit() -> None:
    levels = levels_around(MASTS, 100.0, None, STANDS_M, FOCAL_PX)
    cells = [level.grid.cell_m for level in levels]
    assert cells == pytest.approx(0.02 * 2.0 ** np.arange(len(levels)))
    assert levels[0].nearest_m == 0.0
    assert levels[-1].farthest_m == 100.0
    for fine, coarse in pairwise(levels):
        assert coarse.nearest_m < fine.farthest_m - 2 * coarse.grid.cell_m  # no cell between them is empty
        for edge in ("left_m", "top_m"):
            cells_off = getattr(coarse.grid, edge) / coarse.grid.cell_m
            assert cells_off == pytest.approx(round(cells_off), abs=1e-6)
    assert sum(level.grid.rows * level.grid.columns for level in levels) < 4e6
    assert len(levels_around(MASTS, 10.0, 0.02, STANDS_M, FOCAL_PX)) == 1
    with pytest.raises(InputError, match="expected at most 60 million cells over"):
        levels_around(MASTS, 100.0, 0.0001, STANDS_M, FOCAL_PX)
    # A cell that nobody asked for gets wider where stops lie far apart.
    apart = levels_around(MASTS * 1000, 100.0, None, STANDS_M, FOCAL_PX)
    assert apart[0].grid.cell_m > 0.02


def test_levels_as_one_have_means_of_finer_and_values_of_coarser_cells() -> None:
    fine = plane(Grid(left_m=-1.1, top_m=1.3, cell_m=0.1, rows=24, columns=22))
    middle = plane(Grid(left_m=-4.0, top_m=4.0, cell_m=0.2, rows=40, columns=40), beyond_m=0.8)
    coarse = plane(Grid(left_m=-8.0, top_m=7.6, cell_m=0.4, rows=39, columns=41), beyond_m=3.0)
    whole = composed(replace(fine, coarser=(middle, coarse)), 0.15)
    assert whole.grid.cell_m == 0.2
    assert np.isfinite(whole.height_m).all()
    x, y = np.meshgrid(*whole.grid.middles())
    truth = SLOPE[0] * x + SLOPE[1] * y
    # Along an edge a cell has the mean of those around that have one.
    near = (np.abs(x) < 1) & (np.abs(y) < 1)
    np.testing.assert_allclose(whole.height_m[near], truth[near], atol=1e-6)
    np.testing.assert_allclose(whole.height_m, truth, atol=0.2 * np.abs(SLOPE).sum())
    far = (np.hypot(x, y) > 4.5) & (np.abs(x) < 7.5) & (np.abs(y) < 7.5)
    far &= (np.abs(x) > 4.2) | (np.abs(y) > 4.2)  # beyond what the middle one covers
    np.testing.assert_allclose(whole.height_m[far], truth[far], atol=1e-5)
    within = (np.abs(x) < 3.9) & (np.abs(y) < 3.9) & ~(np.hypot(x, y) < 2)
    np.testing.assert_allclose(whole.height_m[within], truth[within], atol=1e-6)
    np.testing.assert_allclose(whole.telemetry_m, whole.height_m + 1, atol=1e-5)
    np.testing.assert_allclose(whole.sigma_m, 0.01, rtol=1e-5)
    assert composed(fine, 1.0) is fine


def test_the_meshes_of_levels_do_not_lie_on_each_other() -> None:
    fine = plane(Grid(left_m=-2.0, top_m=2.0, cell_m=0.1, rows=40, columns=40))
    coarse = plane(Grid(left_m=-4.0, top_m=4.0, cell_m=0.2, rows=40, columns=40))
    greys = [np.full(f.height_m.shape, 90, np.uint8) for f in (fine, coarse)]
    _, alone = mesh_glb(fine, greys[:1], 10_000)
    _, both = mesh_glb(replace(fine, coarser=(coarse,)), greys, 10_000)
    assert alone == 2 * 39 * 39
    assert both - alone == 2 * (39**2 - 19**2)  # squares whose four corners the finer level has are left out


def holed(rows: slice, columns: slice, size: int = 40) -> Fused:
    whole = plane(Grid(left_m=-1.0, top_m=1.0, cell_m=0.05, rows=size, columns=size))
    bands = {name: getattr(whole, name).copy() for name in ("height_m", "sigma_m", "disagreement_m", "grey")}
    for band in bands.values():
        band[rows, columns] = np.nan
    count = whole.count.copy()
    count[rows, columns] = 0
    return replace(whole, count=count, **bands)


def test_a_small_hole_is_filled_and_marked_and_others_stay() -> None:
    hole = np.s_[10:14, 20:32]
    fused = filled(holed(*hole), 0.25)
    whole = plane(fused.grid)
    np.testing.assert_allclose(fused.height_m, whole.height_m, atol=1e-5)  # a membrane on a plane is a plane
    assert (fused.count[hole] == 0).all()
    assert np.isnan(fused.disagreement_m[hole]).all()
    np.testing.assert_allclose(fused.grey[hole], 100, rtol=1e-5)
    off = (
        fused.height_m[hole]
        - holed(*hole).height_m[9:15, 19:33][np.isfinite(holed(*hole).height_m[9:15, 19:33])].mean()
    )
    assert (fused.sigma_m[hole] > 0.01).all()
    assert np.abs(off).max() < 3 * fused.sigma_m[hole].max()  # the relief around is in the sigma
    np.testing.assert_array_equal(fused.sigma_m[20:], whole.sigma_m[20:])
    assert np.isnan(filled(holed(*hole), 0.15).height_m[hole]).all()  # 4 cells of 5 cm are wider
    edge = np.s_[10:14, 36:40]
    assert np.isnan(filled(holed(*edge), 1.0).height_m[edge]).all()  # what lies beyond is not known


def test_what_is_filled_errs_as_its_sigma_says() -> None:
    """On rough ground: heights with the spectrum of ground, holes of a few cells."""
    rng = np.random.default_rng(3)
    n = 160
    frequency = np.fft.fftfreq(n)[:, None] ** 2 + np.fft.rfftfreq(n)[None] ** 2
    ground = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(n, n))) / (frequency + 1e-4) ** 0.9, (n, n))
    ground = (0.05 * ground / ground.std()).astype(np.float32)
    hidden = np.zeros((n, n), dtype=bool)
    for row, column in rng.integers(5, n - 12, (60, 2)):
        hidden[row : row + 5, column : column + 4] = True
    base = plane(Grid(left_m=0.0, top_m=0.0, cell_m=0.02, rows=n, columns=n))
    known = replace(
        base,
        height_m=np.where(hidden, np.float32(np.nan), ground),
        sigma_m=np.where(hidden, np.float32(np.nan), np.float32(0.001)),
        count=np.where(hidden, np.float32(0), np.float32(1)),
    )
    fused = filled(known, 0.3)
    assert np.isfinite(fused.height_m[hidden]).all()
    squared = ((fused.height_m - ground)[hidden] / fused.sigma_m[hidden]) ** 2
    assert 0.2 < squared.mean() < 1.5


def test_widths_of_holes_are_checked() -> None:
    with pytest.raises(InputError, match=r"terrain: fill_m: expected a width of 0 or more, found -0\.1"):
        TerrainOptions(fill_m=-0.1)
    with pytest.raises(InputError, match="terrain: reach_m: expected a number above 0, found inf"):
        TerrainOptions(reach_m=np.inf)
