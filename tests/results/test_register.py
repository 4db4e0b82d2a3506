"""From results and a picture from orbit to ties, and to a drive that lies where the picture has it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pancam_graph import SimulationOptions, Solution, read_traverse, simulate
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cli import main
from pancam_graph.data import Site, StopPlacement
from pancam_graph.io import read_map_image, read_ties, write_ties, write_traverse
from pancam_graph.results import read_solution_json, register, write_results
from pancam_graph.rigs import mer_navcam, stereo_pan_tilt
from support.mosaic_scenes import PLACE_M, Scene, brightness, solved

rasterio = pytest.importorskip("rasterio")

RIG = stereo_pan_tilt(field_rad=np.deg2rad(55.0), width_px=224, height_px=224)
SCENE = Scene(cameras=tuple(eye.name for eye in RIG.eyes), rig=RIG)
SHIFT_M = np.array([0.43, -0.31])
PIXEL_M = 0.1
MOON = (
    'PROJCS["Moon",GEOGCS["Moon",DATUM["Moon",SPHEROID["Moon",1737400,0]],PRIMEM["0",0],'
    'UNIT["degree",0.0174532925199433]],PROJECTION["Equirectangular"],UNIT["metre",1]]'
)


def write_map(
    path: Path,
    *,
    cells: int = 544,
    crs: str | None = None,
    height_m: float | None = None,
    middle_m: FloatArray = PLACE_M[:2],
) -> None:
    """The scene's ground from above, shifted; or, with a height, a level surface."""
    first = middle_m + PIXEL_M * (cells / 2 - 0.5) * np.array([-1, 1])
    at_x, at_y = np.meshgrid(first[0] + PIXEL_M * np.arange(cells), first[1] - PIXEL_M * np.arange(cells))
    places = np.stack([at_x, at_y], axis=-1).reshape(-1, 2) - SHIFT_M
    parts = PIXEL_M * ((np.arange(3) + 0.5) / 3 - 0.5)
    values = np.mean([brightness(places + np.array([a, b])) for a in parts for b in parts], axis=0)
    values = values if height_m is None else np.full(len(places), height_m)
    corner = first + PIXEL_M / 2 * np.array([-1, 1])
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=cells,
        width=cells,
        count=1,
        dtype="float32",
        transform=rasterio.transform.from_origin(*corner, PIXEL_M, PIXEL_M),
        crs=crs,
    ) as file:
        file.write(values.reshape(cells, cells).astype(np.float32), 1)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a stop that is held where telemetry has it, beside the drive that was refined."""
    folder = tmp_path_factory.mktemp("plane")
    solution: Solution = solved(SCENE, folder)
    write_traverse(solution.traverse, folder)
    write_results(solution, folder / "out", report=False)
    return folder / "out"


@pytest.mark.slow
def test_a_stop_goes_where_the_map_has_it(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chart, dem, ties = tmp_path / "map.tif", tmp_path / "dem.tif", tmp_path / "ties.json"
    write_map(chart)
    write_map(dem, height_m=0.25)
    words = ["--map", str(chart), "--ties", str(ties), "--search", "1"]
    assert main(["register", str(results), *words, "--dem", str(dem)]) == 0
    assert "stop A/1: moves by +0.4" in capsys.readouterr().out
    entry = json.loads(ties.read_text())["constraints"][0]
    assert (entry["kind"], entry["stop"], "robust" in entry) == ("stop-position", "A/1", False)  # it is held
    traverse = read_ties(ties, read_traverse(results.parent))
    (tie,) = traverse.constraints
    assert isinstance(tie, StopPlacement)
    off = tie.world_T_mast.translation() - PLACE_M - [*SHIFT_M, 0.25]
    turn = np.kron(np.eye(2), tie.world_T_mast.rotation().matrix())
    covariance = (turn @ tie.covariance @ turn.T)[3:, 3:]
    assert np.abs(off[:2]).max() < 0.25 * PIXEL_M
    assert abs(off[2]) < 0.01
    assert off[:2] @ np.linalg.solve(covariance[:2, :2], off[:2]) < 13.8  # 2 numbers: 0.1 % exceed it
    assert main(["register", str(results), *words]) == 2
    assert f"{ties}: expected a new file, found one that is there" in capsys.readouterr().err
    out = tmp_path / "tied"
    assert main(["refine", str(results.parent), "--ties", str(ties), "--out", str(out), "--no-report"]) == 0
    (stop,) = read_solution_json(out / "solution.json").stops
    assert stop.world_T_mast is not None
    moved = stop.world_T_mast.pose("stop").translation()
    np.testing.assert_allclose(moved, tie.world_T_mast.translation(), atol=0.01)


@pytest.mark.slow
def test_maps_that_do_not_cover_a_stop_or_have_no_place_are_refused(results: Path, tmp_path: Path) -> None:
    small, moon = tmp_path / "small.tif", tmp_path / "moon.tif"
    write_map(small, cells=64)
    with pytest.raises(InputError, match=r"small\.tif: stop A/1: map: expected it to cover the search about"):
        register(results, small, search_m=1.0)
    write_map(moon, cells=64, crs=MOON)
    with pytest.raises(InputError, match=r"moon\.tif: expected it in the world frame .* and no site"):
        register(results, moon)
    write_map(tmp_path / "map.tif")
    with pytest.raises(InputError, match=r"map\.tif: stop A/1: map: expected a surface that covers the view"):
        dem = tmp_path / "dem.tif"
        write_map(dem, cells=64, height_m=0.0, middle_m=PLACE_M[:2] + 60)
        register(results, tmp_path / "map.tif", dem, search_m=1.0)


def test_a_map_of_another_body_is_refused(tmp_path: Path) -> None:
    write_map(tmp_path / "moon.tif", cells=64, crs=MOON)
    site = Site(body="Mars", latitude_deg=-4.6, longitude_deg=137.4, height_m=0.0, north_rad=0.0)
    with pytest.raises(InputError, match=r"moon\.tif: expected .*Mars.*, found .*Moon"):
        read_map_image(tmp_path / "moon.tif", np.zeros((1, 2)), site)


def test_ties_of_a_file_are_those_of_the_traverse_beside_its_own(tmp_path: Path) -> None:
    traverse = simulate(mer_navcam(), SimulationOptions(stops=1, pans=2, points_per_image=8), seed=1).traverse
    (stop,) = traverse.stops
    tie = StopPlacement(
        stop=stop.id, world_T_mast=stop.world_T_mast, covariance=np.eye(6) * 1e-4, robust=True
    )
    write_ties([tie], tmp_path / "ties.json")
    tied = read_ties(tmp_path / "ties.json", traverse)
    assert (stop.sigmas == 0).all()
    assert (tied.stops[0].sigmas > 0).all()  # held by the tie now
    (read,) = tied.constraints
    assert isinstance(read, StopPlacement)
    np.testing.assert_allclose(read.world_T_mast.matrix(), tie.world_T_mast.matrix(), atol=1e-12)
    np.testing.assert_array_equal(read.covariance, tie.covariance)
    assert read.robust
    with pytest.raises(InputError, match=r"ties\.json: expected a new file, found one that is there"):
        write_ties([tie], tmp_path / "ties.json")
    other = replace(tie, stop="nowhere")
    write_ties([other], tmp_path / "other.json")
    with pytest.raises(InputError, match=r"other\.json: .*nowhere"):
        read_ties(tmp_path / "other.json", traverse)
