"""Known surfaces: heights and places as GDAL has them, and one sentence for what cannot be used."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.io import read_surface

rasterio = pytest.importorskip("rasterio")
HEIGHTS = np.arange(60.0, dtype=np.float32).reshape(6, 10)
MARS = 'PROJCS["Mars plate carree",GEOGCS["Mars",DATUM["Mars",SPHEROID["Mars",3396190,0]],PRIMEM["0",0],'
MARS += 'UNIT["degree",0.0174532925199433]],PROJECTION["Equirectangular"],UNIT["metre",1]]'


def written(path: Path, **changes: Any) -> Path:
    told = {
        "driver": "GTiff",
        "height": 6,
        "width": 10,
        "count": 1,
        "dtype": "float32",
        "nodata": -9999.0,
        "transform": rasterio.Affine(2.0, 0.0, 100.0, 0.0, -2.0, 50.0),
    }
    heights = HEIGHTS.copy()
    heights[0, 0] = -9999.0
    with rasterio.open(path, "w", **{**told, **changes}) as file:
        file.write(heights, 1)
    return path


def test_nodes_are_where_gdal_has_the_middles_of_cells(tmp_path: Path) -> None:
    path = written(tmp_path / "dem.tif")
    surface = read_surface(path)
    with rasterio.open(path) as file:
        for row, column in ((0, 1), (3, 4), (5, 9)):
            place = surface.first_m + surface.step_m * [column, row]
            assert np.allclose(place, file.xy(row, column), atol=0)
            assert surface.height_m[row, column] == next(file.sample([tuple(place)]))[0]
    assert np.isnan(surface.height_m[0, 0])


def test_only_what_is_near_the_stops_is_read(tmp_path: Path) -> None:
    path = written(tmp_path / "dem.tif", transform=rasterio.Affine(500.0, 0.0, 0.0, 0.0, -500.0, 3000.0))
    whole, part = read_surface(path), read_surface(path, np.array([[2600.0, 1500.0]]))
    x, y = part.first_m
    assert (x, y) == (1250.0, 2750.0)
    assert np.array_equal(part.height_m, whole.height_m[:6, 2:8])


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "a map projection": ({"crs": MARS}, "expected it in the world frame of the traverse .*Mars plate"),
    "turned": (
        {"transform": rasterio.Affine(2.0, 0.1, 0.0, 0.1, -2.0, 0.0)},
        "expected columns along x and rows along y, found a turned raster",
    ),
    "elsewhere": (
        {"transform": rasterio.Affine(2.0, 0.0, 9e5, 0.0, -2.0, 0.0)},
        "expected data within 1000 m of the stops, found it at x 900001 to 900019 m, y -11 to -1 m",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_one_sentence_says_what_is_wrong(name: str, tmp_path: Path) -> None:
    changes, sentence = WRONG[name]
    path = written(tmp_path / "dem.tif", **changes)
    with pytest.raises(InputError, match=sentence) as raised:
        read_surface(path, np.zeros((1, 2)))
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_file_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "dem.tif")
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"dem\.tif: expected a GeoTIFF, found"):
        read_surface(path)
