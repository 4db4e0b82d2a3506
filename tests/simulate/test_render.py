"""Rendered panoramas: their geometry is that of the truth; files are whole, repeatable and readable."""

import runpy
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import Pinhole
from pancam_graph.io import read_image, read_traverse
from pancam_graph.rigs import TEMPLATES, Rig, rig_template
from pancam_graph.simulate import Rendering, RenderOptions, render, write_rendering
from support.parameters import slow_but_for
from support.small_worlds import smaller_worlds

STEREO = RenderOptions(
    stops=2, pans=2, sweep_rad=0.6, spacing_m=0.7, heading_change_rad=0.0, sensor_noise=0.0
)


@pytest.fixture(scope="module", autouse=True)
def small_world() -> Iterator[None]:
    """The same ground and rocks over less of it."""
    with smaller_worlds():
        yield


def cropped(rig: Rig, width_px: int, height_px: int) -> Rig:
    """The rig with the upper left corner of each of its images."""
    eyes = [replace(e, camera=replace(e.camera, width_px=width_px, height_px=height_px)) for e in rig.eyes]
    return replace(rig, eyes=tuple(eyes))


def coarse(rig: Rig, share: float) -> Rig:
    """The rig with fewer pixels over the same field of view."""
    eyes = []
    for eye in rig.eyes:
        camera = eye.camera
        assert isinstance(camera, Pinhole)
        size = int(share * camera.width_px)
        focal, centre = share * camera.fx_px, (size - 1) / 2
        camera = Pinhole(width_px=size, height_px=size, fx_px=focal, fy_px=focal, cx_px=centre, cy_px=centre)
        eyes.append(replace(eye, camera=camera))
    return replace(rig, eyes=tuple(eyes))


def poses(rendering: Rendering) -> tuple[FloatArray, FloatArray]:
    truth = rendering.truth
    return replace(rendering.traverse, rig=truth.rig).camera_poses(truth.world_T_mast, truth.pan_tilt_rad)


def pixels(rendering: Rendering, row: int, points_m: FloatArray) -> FloatArray:
    rotation, centre = poses(rendering)
    eye = int(rendering.traverse.image_eye[row])
    uv, valid = rendering.truth.rig.eyes[eye].camera.project((points_m - centre[row]) @ rotation[row])
    assert valid.all()
    return uv


@pytest.fixture(scope="module")
def stereo(small_world: None) -> Rendering:
    return render(coarse(rig_template("mer-navcam"), 0.375), STEREO, seed=4)


@pytest.fixture(scope="module")
def stereo_images(stereo: Rendering) -> dict[int, FloatArray]:
    return {row: stereo.image(row).astype(np.float32) for row in (0, 1, 4)}


@pytest.fixture(scope="module")
def tiny(small_world: None) -> Rendering:
    return render(cropped(rig_template("mer-navcam"), 64, 48), replace(STEREO, bits=12), seed=3)


def shifts(rendering: Rendering, images: dict[int, FloatArray], a: int, b: int, half: int = 6) -> FloatArray:
    """How far patches of image b lie from where the truth puts those of image a, pixels (n, 2)."""
    image, other = images[a], images[b]
    rng, size, out = np.random.default_rng(0), image.shape[0], []
    near = np.stack(np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1)), axis=-1)
    for at in rng.integers(half, size - half, (400, 2)):
        points, hit = rendering.points(a, (at + near).reshape(-1, 2).astype(float))
        if not hit.all():
            continue
        uv = pixels(rendering, b, points)
        if uv.min() < 2 or uv.max() > size - 3:
            continue
        again, hit = rendering.points(b, uv)
        hidden = np.linalg.norm(again - points, axis=1) > 0.01 * np.linalg.norm(
            points - poses(rendering)[1][a], axis=1
        )
        if hidden.any() or not hit.all():
            continue
        map_u, map_v = (uv[:, k].reshape(near.shape[:2]).astype(np.float32) for k in (0, 1))
        there = cv2.remap(other, map_u, map_v, cv2.INTER_CUBIC)
        here = image[at[1] - half : at[1] + half + 1, at[0] - half : at[0] + half + 1]
        if here.std() < 4:
            continue
        grad_v, grad_u = np.gradient(there)
        columns = np.stack([grad_u, grad_v, np.ones_like(there), there], axis=-1).reshape(-1, 4)
        fit = np.linalg.lstsq(columns, here.ravel(), rcond=None)[0]
        out.append(fit[:2] / fit[3])
    return np.array(out)


@pytest.mark.parametrize(
    ("a", "b"),
    [pytest.param(0, 1, marks=pytest.mark.slow), (0, 4)],
    ids=["both eyes", "two stops"],
)
def test_images_show_each_point_where_the_truth_has_it(
    stereo: Rendering, stereo_images: dict[int, FloatArray], a: int, b: int
) -> None:
    found = shifts(stereo, stereo_images, a, b)
    assert len(found) > 80
    assert np.abs(np.median(found, axis=0)).max() < 0.02
    assert np.median(np.abs(found)) < 0.1


def test_what_a_pixel_sees_projects_back_into_it(stereo: Rendering) -> None:
    uv = np.random.default_rng(1).uniform(0, 383, (200, 2))
    points, hit = stereo.points(3, uv)
    assert 100 < hit.sum() < 200  # the horizon is in the picture
    np.testing.assert_allclose(pixels(stereo, 3, points[hit]), uv[hit], atol=1e-7)


def test_depths_and_heights_are_of_the_surface_that_pixels_see(small_world: None) -> None:
    rendering = render(
        coarse(rig_template("mer-navcam"), 0.0625), replace(STEREO, rock_abundance=0.1), seed=4
    )
    rotation, centre = poses(rendering)
    depth = rendering.depth_m(0)
    assert 0.02 < np.isnan(depth).mean() < 0.6  # the horizon is in the picture
    v, u = np.nonzero(depth < 4)
    camera = rendering.truth.rig.eyes[0].camera
    rays = camera.unproject(np.column_stack([u, v]).astype(float)).direction
    seen = centre[0] + rays / rays[:, 2:] * depth[v, u][:, None] @ rotation[0].T
    again, _ = rendering.points(0, np.column_stack([u, v]).astype(float))
    np.testing.assert_allclose(seen, again, atol=1e-9)
    # Heights from above are no lower than what the mast sees, and most of what it sees is on top.
    above = rendering.heights_m(seen[:, :2], 0.01)
    assert np.all(above > seen[:, 2] - 1e-3)
    assert np.median(above - seen[:, 2]) < 1e-3
    bare = render(coarse(rig_template("mer-navcam"), 0.0625), replace(STEREO, rock_abundance=0.0), seed=4)
    xy = np.random.default_rng(1).uniform(-3, 3, (500, 2))
    stones = bare.heights_m(xy, 0.001) - bare.heights_m(xy, 1.0)
    assert stones.min() > -1e-9
    assert 0.005 < stones.max() < 0.03  # pebbles of up to 4 cm, partly buried; wide footprints show none
    with pytest.raises(InputError, match="footprint_m: expected a number above 0, found 0"):
        bare.heights_m(xy, 0.0)


@pytest.mark.parametrize("template", slow_but_for(["mer-navcam", "msl-mastcam", "ladybug3"], TEMPLATES))
def test_any_rig_renders(template: str) -> None:
    options = RenderOptions(stops=1, pans=1, tilts_rad=(-0.5,), rock_abundance=0.0)
    rig = cropped(rig_template(template), 40, 30)
    rendering = render(rig, options, seed=2)
    for row in range(len(rig.eyes)):
        image = rendering.image(row)
        assert image.shape == (30, 40)
        assert image.dtype == np.uint8
        assert image.std() > 0


def test_same_seed_same_bytes_on_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = cropped(rig_template("mer-navcam"), 60, 400)
    options = replace(STEREO, sensor_noise=1.0)
    images = []
    for threads in ("1", "3"):
        monkeypatch.setenv("PANCAM_GRAPH_THREADS", threads)
        rendering = render(rig, options, seed=7)
        images.append([rendering.image(row) for row in (5, 0)])
    np.testing.assert_array_equal(images[0], images[1])
    assert (render(rig, options, seed=8).image(0) != images[0][1]).mean() > 0.5


def test_the_deck_moves_along_with_the_mast() -> None:
    rig = coarse(rig_template("mer-navcam"), 0.1)
    options = RenderOptions(stops=2, pans=1, sweep_rad=1.0, tilts_rad=(-0.9,), deck=True)
    rendering = render(replace(rig, pan_T_tilt=gtsam.Pose3(gtsam.Rot3.Rz(np.pi), np.zeros(3))), options)
    at_mast = []
    for row, pose in zip((0, 2), rendering.truth.world_T_mast, strict=True):
        points, _ = rendering.points(row, np.array([[50.0, 60.0]]))
        at_mast.append(pose.transformTo(points[0]))
    np.testing.assert_allclose(at_mast[0], at_mast[1], atol=1e-9)
    assert at_mast[0][2] == pytest.approx(-0.88, abs=0.03)
    bare = render(rendering.truth.rig, replace(options, deck=False))
    assert (
        bare.points(0, np.array([[50.0, 60.0]]))[0][0, 2]
        < rendering.points(0, np.array([[50.0, 60.0]]))[0][0, 2] - 0.3
    )


def test_folder_is_read_back_without_observations_and_with_the_truth_apart(
    tiny: Rendering, tmp_path: Path
) -> None:
    rendering = tiny
    write_rendering(rendering, tmp_path / "out")
    traverse = read_traverse(tmp_path / "out")
    assert traverse.observations is None
    assert len(traverse.images) == 8
    image = read_image(tmp_path / "out" / str(traverse.images[5].file))
    np.testing.assert_array_equal(image, rendering.image(5))
    assert image.dtype == np.uint16
    assert 255 < image.max() < 4096
    truth = np.load(tmp_path / "out" / "truth.npz")
    np.testing.assert_array_equal(truth["pan_tilt_rad"], rendering.truth.pan_tilt_rad)
    np.testing.assert_array_equal(truth["world_T_mast"][1], rendering.truth.world_T_mast[1].matrix())
    off = traverse.pan_tilt_rad - truth["pan_tilt_rad"]
    assert 2e-4 < np.abs(off).max() < 6e-3  # telemetry of 1.3 mrad


def test_an_interrupted_folder_is_not_there(tiny: Rendering, tmp_path: Path) -> None:
    def stop(done: int, _total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_rendering(tiny, tmp_path / "out", progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_files_is_left_alone(tiny: Rendering, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("text")
    with pytest.raises(InputError, match="expected a new or empty folder"):
        write_rendering(tiny, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stops": 0}, "simulation: stops: expected a whole number of 1 or more, found 0"),
        ({"rock_abundance": 0.5}, "rock_abundance: expected a share from 0 to 0.3, found 0.5"),
        ({"bits": 10}, "bits: expected 8 or 12, found 10"),
        ({"sun_elevation_rad": 0.1}, "sun_elevation_rad: expected"),
    ],
)
def test_options_that_make_no_sense_are_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        RenderOptions(**change)


@pytest.mark.parametrize("arguments", [["--rig", "mer-nocam"], ["--stops", "0"]])
def test_bad_arguments_end_with_one_sentence(
    scripts_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["render_traverse.py", "--out", str(tmp_path / "out"), *arguments])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(scripts_folder / "render_traverse.py"), run_name="__main__")
    assert end.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()
