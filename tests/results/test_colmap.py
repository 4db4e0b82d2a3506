"""The COLMAP workspace: what COLMAP reads is the solution, and the images show what the model says."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pancam_graph import (
    SimulationOptions,
    Solution,
    SolveOptions,
    find_observations,
    read_pds,
    simulate,
    solve,
    write_colmap,
    write_traverse,
)
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, rotation_from_wxyz
from pancam_graph.cameras import Camera, straight_pixels
from pancam_graph.data._sharing import parse_sharing
from pancam_graph.io import read_traverse
from pancam_graph.results import check_out, write_results
from pancam_graph.rigs import Rig, rig_template
from support.parameters import slow_for
from support.pictures import read_picture

SMALL = SimulationOptions(stops=2, pans=2, sweep_rad=0.8, points_per_image=30, outliers=0.02)
RIGS = ("stereo-pan-tilt", "msl-navcam", "mars2020-navcam")
"""Pinhole, CAHVOR, CAHVORE."""


def small_rig(name: str) -> Rig:
    """The template with a quarter of its pixels each way, of the same field of view."""
    rig, eyes = rig_template(name), []
    for eye in rig.eyes:
        k = np.diag([0.25, 0.25, 1.0]) @ eye.camera.pinhole.calibration_matrix
        size = {"width_px": eye.camera.width_px // 4, "height_px": eye.camera.height_px // 4}
        eyes.append(replace(eye, camera=replace(eye.camera.with_calibration(k), **size)))
    return replace(rig, eyes=tuple(eyes))


@pytest.fixture(scope="module")
def solved() -> Callable[..., Solution]:
    made: dict[str, Solution] = {}

    def of(rig: str, **options: Any) -> Solution:
        key = f"{rig} {options}"
        if key not in made:
            made[key] = solve(
                simulate(small_rig(rig), SMALL, seed=0).traverse, SolveOptions(**{"rig": "held"} | options)
            )
        return made[key]

    return of


def table(path: Path) -> list[list[str]]:
    lines = path.read_text().splitlines()
    return [line.split() for line in lines if not line.startswith("#")]


def pose(words: list[str]) -> FloatArray:
    """A 4 x 4 matrix of COLMAP's seven numbers."""
    out = np.eye(4)
    out[:3, :3] = rotation_from_wxyz([float(w) for w in words[:4]])
    out[:3, 3] = [float(w) for w in words[4:7]]
    return out


def about(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "export.json").read_text())
    return content


def expected_length(solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Each used observation's residual on its camera's pinhole: as a length, and as a vector.

    Not the exporter's way: the solution's raw residual, turned by the derivative of the carry.
    """
    t, final = solution.traverse, solution.final
    assert t.observations is not None
    row, out = solution.landmark_row, np.full((len(solution.used), 2), np.nan)
    for i, camera in enumerate(solution.image_cameras):
        own = np.flatnonzero(solution.used & (t.observations.image == i))
        range_m = np.linalg.norm(final.landmarks_m[row[own]] - final.world_t_camera[i], axis=1)
        plain = replace(camera.pinhole, skew_px=0.0)  # COLMAP has none
        seen, _, _ = straight_pixels(camera, plain, t.observations.uv_px[own], range_m)
        points = (final.landmarks_m[row[own]] - final.world_t_camera[i]) @ final.world_R_camera[i]
        out[own] = plain.project(points)[0] - seen
    return np.linalg.norm(out, axis=1), out


@pytest.mark.parametrize("rig", RIGS)
def test_colmap_finds_our_residuals(solved: Callable[..., Solution], tmp_path: Path, rig: str) -> None:
    """COLMAP's own projections: each residual, and the mean over points that it reports."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is an extra (bench)")
    solution = solved(rig)
    write_colmap(solution, tmp_path / "colmap")
    scene = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse")
    length, vector = expected_length(solution)
    t = solution.traverse
    assert t.observations is not None
    track_row = {j: n for n, j in enumerate(solution.landmark_track.tolist())}
    rows = {
        (int(i), track_row[j]): r
        for r, (i, j) in enumerate(zip(t.observations.image, t.observations.track.tolist(), strict=True))
        if solution.used[r]
    }
    lengths, apart = dict[int, list[float]](), list[float]()
    for number, image in scene.images.items():
        camera = scene.cameras[image.camera_id]
        for point in image.points2D:
            world = scene.points3D[point.point3D_id].xyz
            found = camera.img_from_cam(image.cam_from_world() * world) - point.xy
            row = rows[number - 1, point.point3D_id - 1]
            apart.append(np.abs(found - vector[row]).max())
            lengths.setdefault(point.point3D_id, []).append(float(length[row]))
    assert len(apart) > 0.99 * solution.used.sum()
    # All but for points near infinity, which stand at the least distance that they may have.
    assert np.quantile(apart, 0.98) < 1e-7
    assert max(apart) < 1e-3
    mean = float(np.mean([np.mean(of_point) for of_point in lengths.values()]))
    written = scene.compute_mean_reprojection_error()
    assert written == pytest.approx(mean, abs=1e-5)
    scene.update_point_3d_errors()
    assert scene.compute_mean_reprojection_error() == pytest.approx(written, abs=1e-9)
    assert about(tmp_path / "colmap")["mean_reprojection_error_px"] == pytest.approx(written, abs=1e-9)


def test_colmap_adjusts_and_undistorts_it(solved: Callable[..., Solution], tmp_path: Path) -> None:
    """Its rig adjustment takes the model, and moves the masts of a converged solution by little."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is an extra (bench)")
    solution = solved("msl-navcam")
    write_colmap(solution, tmp_path / "colmap")
    scene = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse")
    assert scene.is_valid()
    assert scene.num_reg_frames() == len(solution.traverse.frames)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.refine_sensor_from_rig = False
    options.print_summary = False
    options.ceres.solver_options.max_num_iterations = 20
    config = pycolmap.BundleAdjustmentConfig()
    for number in scene.images:
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(options, config, scene).solve().ceres_summary
    rms = np.sqrt(2 * summary.initial_cost / (summary.num_residuals / 2))
    assert rms == pytest.approx(about(tmp_path / "colmap")["rms_px"], abs=1e-6)
    # Frames have no mast there, six numbers each in place of two: a little must go.
    assert 0.6 * summary.initial_cost < summary.final_cost <= summary.initial_cost


@pytest.mark.parametrize("rig", slow_for("mars2020-navcam", RIGS))
def test_frames_times_rigs_are_the_images(solved: Callable[..., Solution], tmp_path: Path, rig: str) -> None:
    solution = solved(rig)
    write_colmap(solution, tmp_path / "colmap")
    require_consistent(solution, tmp_path / "colmap")
    assert len(table(tmp_path / "colmap" / "sparse" / "rigs.txt")) == 1
    assert len(table(tmp_path / "colmap" / "sparse" / "cameras.txt")) == 2


def require_consistent(solution: Solution, folder: Path) -> None:
    sparse, t, final = folder / "sparse", solution.traverse, solution.final
    sensor: dict[str, tuple[str, FloatArray]] = {}  # by camera: its rig, sensor_from_rig
    for rig, n, kind, reference, *others in table(sparse / "rigs.txt"):
        assert kind == "CAMERA"
        assert len(others) == 10 * (int(n) - 1)
        assert reference not in sensor  # a sensor is of one rig
        sensor[reference] = rig, np.eye(4)
        for begin in range(0, len(others), 10):
            _, camera, has_pose, *seven = others[begin : begin + 10]
            assert has_pose == "1"
            assert camera not in sensor
            sensor[camera] = rig, pose(seven)
    assert sorted(sensor) == sorted(row[0] for row in table(sparse / "cameras.txt"))
    found = {}
    for frame, rig, *rest in table(sparse / "frames.txt"):
        count, data = int(rest[7]), rest[8:]
        assert len(data) == 3 * count
        for begin in range(0, len(data), 3):
            _, camera, image = data[begin : begin + 3]
            assert sensor[camera][0] == rig
            assert t.image_frame[int(image) - 1] == int(frame) - 1
            found[image] = camera, sensor[camera][1] @ pose(rest[:7])
    heads = [words for words in table(sparse / "images.txt") if words and words[-1].endswith(".png")]
    assert sorted(found) == sorted(words[0] for words in heads)
    assert len(heads) == len(t.images)
    for words in heads:
        camera, through_rig = found[words[0]]
        assert words[8] == camera
        camera_T_world = pose(words[1:8])
        assert through_rig == pytest.approx(camera_T_world, abs=1e-9)
        world_T_camera = np.linalg.inv(camera_T_world)
        i = int(words[0]) - 1
        assert world_T_camera[:3, :3] == pytest.approx(final.world_R_camera[i], abs=1e-12)
        assert world_T_camera[:3, 3] == pytest.approx(final.world_t_camera[i], abs=1e-11)


@pytest.mark.parametrize(
    ("options", "rigs"),
    [
        pytest.param({"model": "free"}, "each frame", marks=pytest.mark.slow),
        pytest.param({"model": "circle"}, "each frame", marks=pytest.mark.slow),
        pytest.param({"sharing": parse_sharing(["mounts=stop"])}, "each stop", marks=pytest.mark.slow),
        ({"sharing": parse_sharing(["calibration=stop:focal"])}, "each stop"),
        ({"sharing": parse_sharing(["calibration=image:focal"])}, "each frame"),
        pytest.param(
            {"sharing": parse_sharing(["calibration=eye:focal", "mounts=eye"])}, "all", marks=pytest.mark.slow
        ),
    ],
)
def test_what_is_not_rigid_together_is_not_one_rig(
    solved: Callable[..., Solution], tmp_path: Path, options: dict[str, Any], rigs: str
) -> None:
    solution = solved("stereo-pan-tilt", **options)
    write_colmap(solution, tmp_path / "colmap")
    require_consistent(solution, tmp_path / "colmap")
    t = solution.traverse
    n = {"each frame": len(t.frames), "each stop": len(t.stops), "all": 1}[rigs]
    assert len(table(tmp_path / "colmap" / "sparse" / "rigs.txt")) == n
    focal = {words[4] for words in table(tmp_path / "colmap" / "sparse" / "cameras.txt")}
    assert focal == {repr(float(k[0, 0])) for k in solution.calibration}


def test_frames_of_one_eye_share_the_rig_of_two(solved: Callable[..., Solution], tmp_path: Path) -> None:
    """A frame of which one image is missing stands on the same rig."""
    solution = solved("stereo-pan-tilt")
    centres = solution.final.world_t_camera.copy()
    lost = [0, 3]  # left of the first frame, right of the second
    centres[lost] = np.nan
    write_colmap(replace(solution, final=replace(solution.final, world_t_camera=centres)), tmp_path / "c")
    assert len(table(tmp_path / "c" / "sparse" / "rigs.txt")) == 1
    images = [w[0] for w in table(tmp_path / "c" / "sparse" / "images.txt") if w and w[-1].endswith("png")]
    assert sorted(map(int, images)) == [i + 1 for i in range(len(centres)) if i not in lost]
    assert [w[9] for w in table(tmp_path / "c" / "sparse" / "frames.txt")][:3] == ["1", "1", "2"]


# --- images ---


def scenery(direction: FloatArray) -> FloatArray:
    """A smooth brightness (n,) of directions (n, 3), 0 to 1; its waves are 20 pixels long or more."""
    d = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    return np.asarray(0.5 + 0.2 * np.sin(60 * d[..., 0] + 30 * d[..., 1]) + 0.2 * np.sin(50 * d[..., 1]))


def grid(width_px: int, height_px: int) -> FloatArray:
    return np.stack(np.meshgrid(np.arange(float(width_px)), np.arange(float(height_px))), -1).reshape(-1, 2)


def photographed(camera: Camera, world_R_camera: FloatArray, dtype: type) -> np.ndarray[Any, Any]:
    """A picture of scenery at infinity."""
    seen = scenery(camera.unproject(grid(camera.width_px, camera.height_px)).direction @ world_R_camera.T)
    largest = 255 if dtype is np.uint8 else 4000
    return np.rint(seen * largest).astype(dtype).reshape(camera.height_px, camera.width_px)


def with_pictures(solution: Solution, folder: Path, dtype: type) -> Solution:
    """The solution of a traverse that has image files, all but the last."""
    images = []
    for n, (image, camera, R) in enumerate(
        zip(solution.traverse.images, solution.image_cameras, solution.final.world_R_camera, strict=True)
    ):
        last = n == len(solution.traverse.images) - 1
        images.append(replace(image, file=None if last else f"{n}.png"))
        if not last:
            cv2.imwrite(str(folder / f"{n}.png"), photographed(camera, R, dtype))
    return replace(solution, traverse=replace(solution.traverse, images=tuple(images), folder=folder))


@pytest.fixture
def pictured(solved: Callable[..., Solution], tmp_path: Path) -> Callable[..., Solution]:
    (tmp_path / "pictures").mkdir()
    return lambda rig, dtype: with_pictures(solved(rig), tmp_path / "pictures", dtype)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_an_undistorted_image_shows_what_its_pinhole_sees(
    pictured: Callable[..., Solution], tmp_path: Path, dtype: type
) -> None:
    solution = pictured("msl-navcam", dtype)
    write_colmap(solution, tmp_path / "colmap")
    words = {w[0]: w for w in table(tmp_path / "colmap" / "sparse" / "cameras.txt")}
    white = about(tmp_path / "colmap")["white"]
    assert dtype is np.uint8 or 3000 < white < 3700  # waves reach 0.9 of 4000
    entries = about(tmp_path / "colmap")["images"]
    assert [e["written"] for e in entries] == [True] * (len(entries) - 1) + [False]
    for entry in entries[:2]:
        i = entry["image_id"] - 1
        head = next(w for w in table(tmp_path / "colmap" / "sparse" / "images.txt") if w[-1] == entry["name"])
        _, _, width, height, fx, fy, cx, cy = words[head[8]]
        image = read_picture(tmp_path / "colmap" / "images" / entry["name"])
        assert image.shape == (int(height), int(width))
        assert image.dtype == np.uint8
        uv = grid(int(width), int(height)) + 0.5  # as COLMAP counts
        ray = (uv - [float(cx), float(cy)]) / [float(fx), float(fy)]
        seen = scenery(np.column_stack([ray, np.ones(len(ray))]) @ solution.final.world_R_camera[i].T)
        expected = seen * (255 if dtype is np.uint8 else 4000 * 255 / white)
        difference = (image.ravel() - np.minimum(expected, 255)).reshape(image.shape)[8:-8, 8:-8]
        # Rounding twice, and coordinates to a 32nd of a pixel.
        assert np.abs(difference).max() < 3
        assert np.sqrt(np.mean(difference**2)) < 0.6


def test_a_pinhole_image_is_written_as_it_is_and_points_have_its_grey(
    pictured: Callable[..., Solution], tmp_path: Path
) -> None:
    solution = pictured("stereo-pan-tilt", np.uint8)
    write_colmap(solution, tmp_path / "colmap")
    entry = about(tmp_path / "colmap")["images"][0]
    one, other = (
        read_picture(p)
        for p in (tmp_path / "colmap" / "images" / entry["name"], tmp_path / "pictures" / "0.png")
    )
    assert np.array_equal(one, other)
    points = table(tmp_path / "colmap" / "sparse" / "points3D.txt")
    t = solution.traverse
    assert t.observations is not None
    for words in points:
        own = solution.used & (solution.landmark_row == int(words[0]) - 1)
        own &= t.observations.image < len(t.images) - 1  # the last has no file
        if not own.any():
            continue
        image, uv = t.observations.image[own], t.observations.uv_px[own]
        rays = [solution.image_cameras[i].unproject(p[None]) for i, p in zip(image, uv, strict=True)]
        ray = np.concatenate([r.direction for r in rays])
        seen = scenery(np.einsum("nij,nj->ni", solution.final.world_R_camera[image], ray))
        assert words[4] == words[5] == words[6]
        assert abs(int(words[4]) - 255 * seen.mean()) < 3
    assert len({words[4] for words in points}) > 50


def test_dense_stereo_finds_its_folders_and_only_images_that_are_there(
    pictured: Callable[..., Solution], tmp_path: Path
) -> None:
    solution = pictured("stereo-pan-tilt", np.uint8)
    write_colmap(solution, tmp_path / "colmap")
    names = (tmp_path / "colmap" / "stereo" / "fusion.cfg").read_text().split()
    assert len(names) == len(solution.traverse.images) - 1
    for name in names:
        assert (tmp_path / "colmap" / "images" / name).is_file()
        assert (tmp_path / "colmap" / "stereo" / "depth_maps" / name).parent.is_dir()
    config = (tmp_path / "colmap" / "stereo" / "patch-match.cfg").read_text().splitlines()
    assert config[::2] == names
    assert set(config[1::2]) == {"__auto__, 20"}


# --- whole or not at all ---


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_an_older_export_is_replaced_and_what_others_made_is_kept(
    solved: Callable[..., Solution], tmp_path: Path
) -> None:
    solution, out = solved("stereo-pan-tilt"), tmp_path / "colmap"
    write_colmap(solution, out)
    first = contents(out)
    write_colmap(solution, out)
    assert contents(out) == first
    (out / "stereo" / "depth_maps" / "left.bin").write_bytes(b"hours of work")
    before = contents(tmp_path)
    with pytest.raises(InputError, match=r"found what others made in it: colmap/stereo/depth_maps/left.bin"):
        write_colmap(solution, out)
    assert contents(tmp_path) == before
    other = tmp_path / "thesis"
    other.mkdir()
    (other / "chapter.tex").write_text("years")
    with pytest.raises(InputError, match=r"which is no export of ours"):
        write_colmap(solution, other)
    with pytest.raises(InputError, match=r"found a file"):
        write_colmap(solution, other / "chapter.tex")
    assert contents(other) == {"chapter.tex": b"years"}


def test_nothing_is_left_half_written(
    pictured: Callable[..., Solution], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solution = pictured("stereo-pan-tilt", np.uint8)
    write_results(solution, tmp_path / "out", report=False, exports=["colmap", "cahvor"])
    before = contents(tmp_path)
    assert {p.name for p in (tmp_path / "out").iterdir()} >= {"solution.json", "colmap", "cahvor"}

    def full(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(cv2, "imencode", full)
    with pytest.raises(InputError, match="no space left"):
        write_results(solution, tmp_path / "out", report=False, exports=["colmap"])
    with pytest.raises(InputError, match="no space left"):
        write_colmap(solution, tmp_path / "new")
    assert contents(tmp_path) == before
    assert {p.name for p in tmp_path.iterdir()} == {"out", "pictures"}
    monkeypatch.undo()
    write_results(solution, tmp_path / "out", report=False)  # older exports go, as all older results
    assert not (tmp_path / "out" / "colmap").exists()


def test_results_with_dense_work_in_them_are_left_alone(
    solved: Callable[..., Solution], tmp_path: Path
) -> None:
    solution, out = solved("stereo-pan-tilt"), tmp_path / "out"
    write_results(solution, out, report=False, exports=["colmap"])
    check_out(out)
    (out / "colmap" / "fused.ply").write_bytes(b"hours of work")
    for attempt in (check_out, lambda o: write_results(solution, o, report=False)):
        with pytest.raises(InputError) as caught:
            attempt(out)
        text = str(caught.value)
        assert text.startswith(f"{out}: expected a new folder or one of older results, found ")
        assert text.endswith("what others made in it: colmap/fused.ply")


def test_names_are_safe_and_different(solved: Callable[..., Solution], tmp_path: Path) -> None:
    solution = solved("stereo-pan-tilt")
    t = solution.traverse
    ids = ["a b", "a/b", "A_B", "../x", "é", "ü", *[f.id for f in t.frames[6:]]]
    name = dict(zip([f.id for f in t.frames], ids, strict=False))
    frames = tuple(replace(f, id=name[f.id]) for f in t.frames)
    images = tuple(replace(i, frame=name[i.frame]) for i in t.images)
    write_colmap(replace(solution, traverse=replace(t, frames=frames, images=images)), tmp_path / "colmap")
    names = [e["name"] for e in about(tmp_path / "colmap")["images"]]
    assert len({n.lower() for n in names}) == len(t.images)
    assert all(re.fullmatch(r"(left|right)/[A-Za-z0-9._-]+\.png", n) for n in names)
    assert sum(n.startswith("left/") for n in names) == len(t.frames)


@pytest.mark.slow
def test_opportunity(opportunity_folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """COLMAP's own error of the five frames, and its own colours of the points off the images."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is an extra (bench)")
    solution = solve(find_observations(read_pds(opportunity_folder)))
    caplog.set_level("INFO")
    write_colmap(solution, tmp_path / "colmap")
    scene = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse")
    length, _ = expected_length(solution)
    t = solution.traverse
    assert t.observations is not None
    said = about(tmp_path / "colmap")
    assert 0 < said["points_beyond_infinity"] <= said["points_left_out"] < 0.01 * said["points"]
    (line,) = [r.getMessage() for r in caplog.records if r.getMessage().startswith("colmap: ")]
    assert f"{said['points_beyond_infinity']} of them because they fit best beyond infinity" in line
    assert scene.num_points3D() == said["points"]
    scene.update_point_3d_errors()
    landmark = solution.landmark_row
    for number, point in list(scene.points3D.items())[::20]:
        own = solution.used & (landmark == number - 1)
        assert point.error == pytest.approx(length[own].mean(), abs=1e-3)
    raw = np.linalg.norm(solution.residual_final_px[solution.used], axis=1)
    assert scene.compute_mean_reprojection_error() == pytest.approx(raw.mean(), abs=1e-3)
    ours = np.array([p.color[0] for p in scene.points3D.values()], dtype=float)
    scene.extract_colors_for_all_images(tmp_path / "colmap" / "images")
    theirs = np.array([p.color[0] for p in scene.points3D.values()], dtype=float)
    assert np.abs(ours - theirs).mean() < 1.0
    assert np.corrcoef(ours, theirs)[0, 1] > 0.99


def test_a_traverse_folder_with_pictures_goes_through(
    pictured: Callable[..., Solution], tmp_path: Path
) -> None:
    """Read from its files again: where pictures are is the traverse's folder."""
    solution = pictured("stereo-pan-tilt", np.uint8)
    write_traverse(solution.traverse, tmp_path / "traverse")
    again = replace(solution, traverse=read_traverse(tmp_path / "traverse"))
    write_colmap(again, tmp_path / "colmap")
    written = sum(e["written"] for e in about(tmp_path / "colmap")["images"])
    assert written == len(solution.traverse.images) - 1
