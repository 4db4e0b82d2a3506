"""Terrain of a plane with known truth, from pictures to files that other libraries open."""

import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pancam_graph import Solution
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cli import main
from pancam_graph.data import StereoCovariance
from pancam_graph.images import Cache, find_masks
from pancam_graph.io import write_traverse
from pancam_graph.results import check_out, read_drive, write_results
from pancam_graph.rigs import stereo_pan_tilt
from pancam_graph.terrain import Terrain, TerrainOptions, drive_of, make_terrain
from pancam_graph.terrain import _extra as extra
from pancam_graph.terrain._drive import Pair, stereo_pairs
from pancam_graph.terrain._frames import Frames, Seen
from pancam_graph.terrain._levels import levels_around
from support.mosaic_scenes import PLACE_M, Scene, solved, without_file

RIG = stereo_pan_tilt(field_rad=np.deg2rad(55.0), width_px=224, height_px=224)
SCENE = Scene(
    cameras=tuple(eye.name for eye in RIG.eyes),
    rig=RIG,
    error_rad=((0.0, 0.01), (0.0, -0.01)),
    exposure=(1.0, 1.25, 0.9),
)
OPTIONS = TerrainOptions(reach_m=5.0, cell_m=0.05)


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Solution:
    folder = tmp_path_factory.mktemp("plane")
    solution = solved(SCENE, folder)
    write_traverse(solution.traverse, folder)
    return solution


@pytest.fixture(scope="module")
def terrain(plane: Solution) -> Terrain:
    return make_terrain(drive_of(plane), OPTIONS)


@pytest.fixture(scope="module")
def results(plane: Solution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("results") / "out"
    write_results(plane, out, report=False, terrain=OPTIONS)
    return out


def test_heights_of_a_plane_err_as_their_sigmas_say(terrain: Terrain) -> None:
    fused = terrain.drive
    x, y = fused.grid.middles()
    away = np.hypot(x - PLACE_M[0], (y - PLACE_M[1])[:, None])
    seen = np.isfinite(fused.height_m) & (away < 4)
    assert seen.sum() > 3000
    off, sigma = fused.height_m[seen], fused.sigma_m[seen]
    assert np.abs(np.median(off)) < 0.002
    assert np.sqrt(np.mean(off**2)) < 0.008
    # Sigmas are calibrated on rendered ground; a texture that is sampled at points aliases between pictures.
    squared = (off / sigma) ** 2
    assert 0.1 < np.mean(np.minimum(squared, 16)) < 3.0
    assert 0.1 < np.median(squared) / 0.455 < 1.6
    assert (fused.count[np.isfinite(fused.height_m)] >= 1).all()
    assert list(terrain.stops) == ["A/1"]


def test_refined_surfaces_agree_and_those_of_telemetry_do_not(terrain: Terrain) -> None:
    assert [p.frames for p in terrain.agreement.pairs] == [(0, 1), (1, 2)]
    # Two tilts that are 20 mrad apart put ground 2.5 m away 5 cm apart.
    assert terrain.agreement.median_m("telemetry") > 0.02
    assert terrain.agreement.median_m("refined") < 0.003
    assert terrain.agreement.median_m("refined", same_stop=True) < 0.003


def test_the_section_shows_two_frames_that_telemetry_puts_apart(terrain: Terrain) -> None:
    section = terrain.section
    assert section is not None
    apart_m = {p.frames: p.telemetry_m for p in terrain.agreement.pairs}
    assert apart_m[section.frames] >= terrain.agreement.median_m("telemetry")
    assert len(section.along_m) == section.refined_m.shape[1] > 10
    assert np.linalg.norm(np.subtract(*section.ends_m)) == pytest.approx(section.along_m[-1])
    apart = [np.nanmedian(np.abs(np.diff(h, axis=0))) for h in (section.telemetry_m, section.refined_m)]
    assert apart[0] > 0.02
    assert apart[1] < 0.005
    assert np.nanmedian(np.abs(section.refined_m)) < 0.005  # the plane


def test_exposures_are_evened_out(terrain: Terrain) -> None:
    fused = terrain.drive
    both = fused.count > 1
    assert both.sum() > 200
    third = fused.grid.columns // 3
    means = [float(np.nanmean(fused.grey[:, k * third : (k + 1) * third])) for k in range(3)]
    assert max(means) < 1.12 * min(means)  # exposures differ by 1.4


def test_files_are_opened_by_other_libraries(results: Path, terrain: Terrain) -> None:
    rasterio, laspy = pytest.importorskip("rasterio"), pytest.importorskip("laspy")
    index = json.loads((results / "terrain" / "terrain.json").read_text())
    assert index["format"] == "pancam-graph/terrain"
    assert index["cell_m"] == 0.05
    assert set(index["disagreement_m"]) == {"telemetry", "refined"}
    assert index["disagreement_m"]["refined"] < 0.2 * index["disagreement_m"]["telemetry"]
    assert [p["stop"] for p in index["products"]] == [None, "A/1"]
    assert index["products"][1]["files"]["dem"] == "001_A-1/dem.tif"  # an id that is no name of a folder
    for product in index["products"]:
        for file in product["files"].values():
            assert (results / "terrain" / file).stat().st_size > 500
    grid = terrain.drive.grid
    with rasterio.open(results / "terrain" / "dem.tif") as dem:
        assert dem.descriptions == ("height", "sigma", "count", "disagreement")
        assert "pancam-graph world" in dem.crs.to_wkt()
        assert 'UNIT["metre",1' in dem.crs.to_wkt()
        assert np.isnan(dem.nodata)
        left, top = dem.transform.c, dem.transform.f
        assert (left, top) == pytest.approx((grid.left_m, grid.top_m), abs=1e-3)
        np.testing.assert_array_equal(dem.read(1), terrain.drive.height_m)
    with rasterio.open(results / "terrain" / "orthoimage.tif") as picture:
        grey = picture.read(1)
        np.testing.assert_array_equal(grey > 0, np.isfinite(terrain.drive.height_m))
        assert picture.nodata == 0
    cloud = laspy.read(results / "terrain" / "cloud.laz")
    xyz = np.asarray(cloud.xyz)
    assert len(xyz) == index["products"][0]["points"] > 10000
    assert np.median(np.abs(xyz[:, 2])) < 0.005
    assert set(np.unique(cloud.frame)) == {0, 1, 2}
    assert 0 < np.median(cloud.sigma_m) < 0.1


def test_the_mesh_lies_on_the_heights(results: Path, terrain: Terrain) -> None:
    data = (results / "terrain" / "mesh.glb").read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    document = json.loads(data[20 : 20 + size])
    binary = data[28 + size :]
    view = document["bufferViews"][0]
    position = np.frombuffer(binary, "<f4", document["accessors"][0]["count"] * 3, view["byteOffset"])
    position = position.reshape(-1, 3) + 0.0
    origin = document["asset"]["extras"]["world_origin_m"]
    world = np.stack([position[:, 0], -position[:, 2], position[:, 1]], axis=1) + origin
    place = np.rint(terrain.drive.grid.place(world)).astype(int)
    np.testing.assert_allclose(terrain.drive.height_m[place[:, 1], place[:, 0]], world[:, 2], atol=1e-5)
    index = np.frombuffer(
        binary, "<u4", document["accessors"][2]["count"], document["bufferViews"][2]["byteOffset"]
    )
    corners = world[index.reshape(-1, 3)]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert (up > 0).all()  # triangles turn so that their outside is up


def read_ply(path: Path) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) and sigmas (n,) of a binary PLY file of whatever properties."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    words = {"double": "<f8", "float": "<f4", "uint": "<u4", "uchar": "u1"}
    lines = [line.split() for line in head.decode("ascii").splitlines() if line.startswith("property")]
    vertex = np.frombuffer(body, dtype=[(name, words[kind]) for _, kind, name in lines])
    return np.stack([vertex[k] for k in "xyz"], axis=1), np.asarray(vertex["sigma_m"], dtype=float)


def assert_levels_are_one(folder: Path, files: dict[str, str], crs: str) -> None:
    """What GDAL shows of the joined file: the finer level where it knows heights, else the coarser."""
    rasterio = pytest.importorskip("rasterio")
    with (
        rasterio.open(folder / files["dem_whole"]) as whole,
        rasterio.open(folder / files["dem"]) as fine,
        rasterio.open(folder / files["dem_1"]) as coarse,
    ):
        assert whole.descriptions == fine.descriptions
        assert whole.crs == rasterio.crs.CRS.from_wkt(crs)
        # Of the finer file all that it knows, at its place.
        east, south = (round(n) for n in ~whole.transform * (fine.transform.c, fine.transform.f))
        window = rasterio.windows.Window(east, south, fine.width, fine.height)
        known = np.isfinite(fine.read(1))
        np.testing.assert_array_equal(whole.read(1, window=window)[known], fine.read(1)[known])
        everything = whole.read(1)
        assert np.abs(np.nanmedian(everything)) < 0.005  # the plane
        row, column = np.argwhere(np.isfinite(coarse.read(1)))[0]
        x, y = coarse.transform * (column + 0.5, row + 0.5)
        ((seen, *_),) = whole.sample([(x, y)])
        assert seen == coarse.read(1)[row, column]
        filled = (fine.read(3) == 0) & known
        assert filled.any()
        assert (fine.read(2)[filled] > 0).all()
    with rasterio.open(folder / files["orthoimage_whole"]) as picture:
        assert picture.shape == everything.shape
        np.testing.assert_array_equal(picture.read(1) > 0, np.isfinite(everything))


def test_terrain_of_older_results_replaces_itself_and_nothing_else(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = Path(shutil.copytree(results, results.parent / "of older"))  # others look at the first ones
    before = (results / "solution.json").read_bytes()
    assert main(["terrain", str(results), "--cell", "0.012", "--reach", "5", "--ply", "--fill", "0.1"]) == 0
    said = capsys.readouterr().out
    assert "3 stereo frames of 1 stops, cells of 0.012 to 0.024 m" in said
    assert "surfaces of frames differ by" in said
    assert (results / "solution.json").read_bytes() == before
    index = json.loads((results / "terrain" / "terrain.json").read_text())
    assert index["cell_m"] == 0.012
    drive = index["products"][0]
    assert drive["cells_filled"] > 0
    (coarser,) = drive["coarser"]
    assert coarser["cell_m"] == 0.024
    assert_levels_are_one(results / "terrain", drive["files"], index["crs"]["wkt"])
    assert "Heights along the line" in (results / "terrain" / "terrain.html").read_text()
    xyz, sigma_m = read_ply(results / "terrain" / index["products"][0]["files"]["cloud_ply"])
    assert len(xyz) == index["products"][0]["points"] > 10000
    assert np.median(np.abs(xyz[:, 2])) < 0.005  # the plane
    assert 0 < np.median(sigma_m) < 0.1
    check_out(results)  # a new refine may replace them all
    (results / "terrain" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match=r"found other things in it: terrain/mine\.txt"):
        check_out(results)
    assert main(["terrain", str(results)]) == 2
    assert "expected an older terrain or nothing, found other things in it" in capsys.readouterr().err
    (results / "terrain" / "mine.txt").unlink()


def test_poses_of_a_file_are_those_of_the_solution(results: Path, plane: Solution) -> None:
    read, made = read_drive(results), drive_of(plane)
    np.testing.assert_allclose(read.world_R_camera, made.world_R_camera, atol=1e-12)
    np.testing.assert_allclose(read.world_t_camera, made.world_t_camera, atol=1e-12)
    np.testing.assert_allclose(read.angle_sigma_rad, made.angle_sigma_rad)


@pytest.mark.parametrize(
    ("scene", "lost", "says"),
    [
        (Scene(cameras=("left",)), (), "expected frames with pictures of two eyes, found one eye in each"),
        (SCENE, (0, 1, 2, 3, 4, 5), "expected image files, found none"),
    ],
    ids=["one eye", "no pictures"],
)
def test_what_has_no_stereo_is_said_in_a_sentence(
    scene: Scene, lost: tuple[int, ...], says: str, tmp_path: Path
) -> None:
    solution = solved(scene, tmp_path)
    for row in lost:
        solution = without_file(solution, row)
    with pytest.raises(InputError, match=says):
        make_terrain(drive_of(solution))
    out = tmp_path.parent / f"{tmp_path.name}-out"
    written = write_results(solution, out, report=False, terrain=OPTIONS)
    assert says in written.warnings[-1]  # and the solve is not lost
    assert not (out / "terrain").exists()


def test_a_frame_that_lacks_an_eye_is_left_out_and_named(plane: Solution) -> None:
    made = make_terrain(drive_of(without_file(plane, 3)), OPTIONS)
    assert [p.frame for p in made.pairs] == [0, 2]
    assert "frames without a stereo pair of pictures are left out: f1" in made.warnings[0]


def test_a_package_that_is_missing_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extra, "_PACKAGES", ("no_such_package",))
    with pytest.raises(
        InputError, match=r"no_such_package, found none: pip install 'pancam-graph\[terrain\]'"
    ):
        extra.require_extra()


def test_pictures_of_another_drive_are_refused(results: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected the folder that was refined"):
        read_drive(results, tmp_path / "gone")
    other = solved(replace(SCENE, pans_rad=SCENE.pans_rad[:2]), tmp_path)
    write_traverse(other.traverse, tmp_path)
    with pytest.raises(InputError, match=r"images: expected those of .*, found those of another drive"):
        read_drive(results, tmp_path)


@pytest.mark.slow
def test_frames_on_workers_give_the_same_terrain(
    plane: Solution, terrain: Terrain, client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of them are matched by workers, and nothing of them is left in the cache."""
    told: list[tuple[str, int, int]] = []
    seen, on_workers = Frames.seen, list[bool]()

    def noted(frames: Frames, pair: Pair) -> Seen | str | None:
        on_workers.append("masks" in vars(frames) and frames.drive.traverse.observations is None)
        return seen(frames, pair)

    monkeypatch.setattr(Frames, "seen", noted)
    cache = tmp_path / "cache"
    found = make_terrain(
        drive_of(plane), OPTIONS, cache=cache, client=client, progress=lambda *event: told.append(event)
    )
    assert on_workers == [True] * len(terrain.pairs)
    assert ("terrain on workers", len(terrain.pairs), len(terrain.pairs)) in told
    assert not list(cache.glob("surface-*"))
    assert not list(cache.glob("parcel-*"))
    for one, other in zip(found.drive.levels, terrain.drive.levels, strict=True):
        bands = {name: band for name, band in vars(other).items() if isinstance(band, np.ndarray)}
        assert len(bands) >= 6
        for name, band in bands.items():
            assert getattr(one, name).tobytes() == band.tobytes(), name
    for stop, cloud in terrain.clouds.items():
        for name, column in vars(cloud.points).items():
            assert column.tobytes() == getattr(found.clouds[stop].points, name).tobytes()
    assert found.says() == terrain.says()
    assert found.warnings == terrain.warnings


@pytest.mark.slow
def test_what_a_frame_gave_is_kept_whole(plane: Solution, tmp_path: Path) -> None:
    """Also why it is left out, and that it sees nothing."""
    pairs, _ = stereo_pairs(drive_of(plane))
    covariance = np.zeros((len(pairs), 2, 2, 2, 6))
    covariance[..., [0, 3, 5]] = 1e-6
    shared = StereoCovariance(
        left=np.array([pair.left for pair in pairs]),
        right=np.array([pair.right for pair in pairs]),
        extent=np.tile([-1.0, 1.0, -1.0, 1.0], (len(pairs), 1)),
        depth_m=np.array([0.5, 50.0]),
        covariance=covariance,
    )
    drive = replace(drive_of(plane), stereo=shared)
    levels = levels_around(drive.world_t_camera, 5.0, 0.05, drive.traverse.rig.mast_height_m, 200.0)
    frames = Frames(
        drive=drive, levels=levels, reach_m=5.0, every=3, masks=find_masks(drive.traverse, cache=tmp_path)
    )
    made = frames.kept(pairs[0], Cache(tmp_path))
    again = frames.kept(pairs[0], Cache(tmp_path))
    assert isinstance(made, Seen)
    assert isinstance(again, Seen)
    for one, other in zip(made.refined + made.telemetry, again.refined + again.telemetry, strict=True):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            assert (one.frame, one.box) == (other.frame, other.box)
            for name in ("height_m", "variance_m2", "grey"):
                assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
    own, kept = made.refined[0], again.refined[0]
    assert own is not None
    assert kept is not None
    assert own.shared_m2 is not None
    assert kept.shared_m2 is not None
    assert own.shared_m2.tobytes() == kept.shared_m2.tobytes()
    assert again.points.covariance_m2.tobytes() == made.points.covariance_m2.tobytes()
    for reason in (None, "terrain: frame f is left out: it is torn"):
        answers = iter([reason])
        cache = Cache(tmp_path / str(reason is None))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Frames, "seen", lambda *_, answers=answers: next(answers))
            assert [frames.kept(pairs[0], cache) for _ in range(2)] == [reason] * 2


@pytest.mark.slow
def test_terrain_from_the_command_line_on_workers(results: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="needs the extra pancam-graph[cluster]")
    files = []
    for words in ([], ["--cluster", "local:1"]):
        out = tmp_path / f"out{len(words)}"
        shutil.copytree(results, out)
        assert main(["terrain", str(out), "--cell", "0.05", "--reach", "5", *words]) == 0
        files.append({path.name: path.read_bytes() for path in (out / "terrain").iterdir() if path.is_file()})
    assert files[0].keys() == files[1].keys()
    assert {name for name in files[0] if files[0][name] != files[1][name]} <= {"cloud.laz"}  # it has a date
