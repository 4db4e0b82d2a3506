"""Stops moved onto a map: made-up ground for speed, rendered ground for truth, and what does not fit."""

from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
import scipy

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import Pinhole
from pancam_graph.data import MapImage, Surface
from pancam_graph.rigs import mer_navcam
from pancam_graph.simulate import RenderOptions, render
from pancam_graph.terrain import Drive, Fused, Registration, TerrainOptions, make_terrain, register_stop
from pancam_graph.terrain._grid import Grid
from support.small_worlds import smaller_worlds

AT_M = np.array([1.3, -2.2])
TURN_RAD, SHIFT_M = 0.05, np.array([7.0, -7.0])  # 10 m and 3 degrees
PIXEL_M, CELL_M = 0.25, 0.05


def texture(rng: np.random.Generator, n: int) -> FloatArray:
    """Brightness with the spectrum of ground."""
    frequency = np.fft.fftfreq(n)[:, None] ** 2 + np.fft.rfftfreq(n)[None] ** 2
    made = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(n, n))) / (frequency + 1e-5) ** 0.65, (n, n))
    return np.asarray(made / made.std())


def made_up(seed: int, noise: float = 1.0, n: int = 1600) -> tuple[Fused, MapImage]:
    """A view of a stop, of other light and with gaps, and a map on which it is turned and shifted."""
    rng = np.random.default_rng(seed)
    ground = texture(rng, n)
    k = round(PIXEL_M / CELL_M)
    pixels = ground.reshape(n // k, k, n // k, k).mean(axis=(1, 3))
    pixels += 0.1 * rng.normal(size=pixels.shape)
    corner = (len(pixels) - 1) / 2 * PIXEL_M
    step = np.array([PIXEL_M, -PIXEL_M])
    chart = MapImage(first_m=np.array([-corner, corner]), step_m=step, grey=pixels)
    cells = 640
    grid = Grid(left_m=AT_M[0] - 16.013, top_m=AT_M[1] + 16.02, cell_m=CELL_M, rows=cells, columns=cells)
    x, y = grid.middles()
    right, up = np.meshgrid(x - AT_M[0], y - AT_M[1])
    c, s = np.cos(TURN_RAD), np.sin(TURN_RAD)
    true_x, true_y = AT_M[0] + c * right - s * up + SHIFT_M[0], AT_M[1] + s * right + c * up + SHIFT_M[1]
    half = (n - 1) / 2
    seen = scipy.ndimage.map_coordinates(ground, [half - true_y / CELL_M, half + true_x / CELL_M], order=1)
    # The light falls off along x, and is other than the map's; noise hangs together over a pixel.
    blurred = scipy.ndimage.gaussian_filter(rng.normal(size=seen.shape), 2.0)
    grey = 50 + 20 * (seen * (0.7 + 0.004 * right) + 0.06 * up) + 20 * noise * 7 * blurred
    distance = np.hypot(right, up)
    shown = (distance > 2) & (distance < 15) & (np.abs(np.arctan2(up, right)) < 2.2)
    shown &= scipy.ndimage.gaussian_filter(rng.normal(size=seen.shape), 6.0) > -0.04
    view = np.where(shown, grey, np.nan).astype(np.float32)
    height = np.where(shown, 0.02 * right, np.nan).astype(np.float32)
    fused = Fused(
        grid=grid,
        height_m=height,
        sigma_m=height,
        count=height,
        disagreement_m=height,
        grey=view,
        telemetry_m=height,
    )
    return fused, chart


def off(found: Registration) -> FloatArray:
    return np.array([found.turn_rad - TURN_RAD, *(found.shift_m - SHIFT_M)])


def test_a_view_is_found_ten_metres_off() -> None:
    view, chart = made_up(1, noise=0.3)
    slope = np.linspace(-60, 60, 241)
    c, s = np.cos(TURN_RAD), np.sin(TURN_RAD)
    east = slope - AT_M[0] - SHIFT_M[0]
    north = slope[:, None] - AT_M[1] - SHIFT_M[1]
    surface = Surface(
        first_m=np.array([-60.0, -60.0]),
        step_m=np.array([0.5, 0.5]),
        height_m=0.02 * (c * east + s * north) + 1.5,
    )
    found = register_stop("s0", view, AT_M, chart, surface=surface)
    assert np.abs(off(found)[1:]).max() < 0.1 * PIXEL_M
    assert abs(off(found)[0]) < 2e-3
    assert found.height_m == pytest.approx(1.5, abs=0.01)
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.4), np.array([*AT_M, 0.7]))
    tie = found.constraint(pose)
    moved = tie.world_T_mast
    assert found.height_m is not None
    assert moved.translation() == pytest.approx([*(AT_M + found.shift_m), 0.7 + found.height_m])
    assert moved.rotation().yaw() - pose.rotation().yaw() == pytest.approx(found.turn_rad, abs=1e-12)
    # Of the tie's covariance, turned to the world: what the map told; roll and pitch are as good as free.
    turn = np.kron(np.eye(2), moved.rotation().matrix())
    world = turn @ tie.covariance @ turn.T
    assert world[np.ix_([2, 3, 4], [2, 3, 4])] == pytest.approx(found.covariance, rel=1e-6)
    assert world[0, 0] == pytest.approx(1.0)


def test_another_places_map_is_refused_and_so_is_one_that_ends_too_near() -> None:
    view, chart = made_up(1)
    other = replace(chart, grey=texture(np.random.default_rng(77), len(chart.grey)))
    with pytest.raises(InputError, match=r"stop s0: map: expected a place that the view fits, found none"):
        register_stop("s0", view, AT_M, other)
    small = replace(chart, grey=chart.grey[:150, :150])
    with pytest.raises(InputError, match="expected it to cover the search about the stop, found its edge"):
        register_stop("s0", view, AT_M, small)
    twice = np.tile(chart.grey[110:170, 110:170], (6, 6))[: len(chart.grey), : len(chart.grey)]
    with pytest.raises(InputError, match=r"expected (one place|a place) that the view fits, found"):
        register_stop("s0", view, AT_M, replace(chart, grey=twice))
    with pytest.raises(InputError, match="expected a view of 400 of its pixels or more, found"):
        blind = np.full_like(view.grey, np.nan)
        register_stop("s0", replace(view, grey=blind), AT_M, chart)


@pytest.mark.slow
def test_the_spread_is_that_of_the_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    """On flat ground, where shapes look alike from the side and from above."""
    monkeypatch.setattr("pancam_graph.terrain._registration._SHAPE_PX", 0.0)
    squares = []
    for seed in range(40, 60):
        view, chart = made_up(seed, noise=0.5)
        found = register_stop("s0", view, AT_M, chart)
        error = off(found)
        assert np.abs(error[1:]).max() < PIXEL_M / 4
        squares.append(error @ np.linalg.solve(found.covariance, error) / 3)
    assert 0.6 < np.mean(squares) < 1.6


@pytest.mark.slow
def test_a_rendered_stop_is_moved_onto_a_rendered_orbital_map(tmp_path: Path) -> None:
    """Ten metres and three degrees off at the start; within a quarter of the map's pixel after."""
    size, eyes = 320, []
    for eye in mer_navcam().eyes:
        camera = eye.camera
        assert isinstance(camera, Pinhole)
        k, middle = size / camera.width_px, (size - 1) / 2
        small = replace(
            camera,
            width_px=size,
            height_px=size,
            cx_px=middle,
            cy_px=middle,
            fx_px=k * camera.fx_px,
            fy_px=k * camera.fy_px,
        )
        eyes.append(replace(eye, camera=small))
    with smaller_worlds():
        options = RenderOptions(stops=1, pans=6, sweep_rad=4.0, tilts_rad=(-0.35,))
        rendering = render(replace(mer_navcam(), eyes=tuple(eyes)), options, seed=3)
        t, truth = rendering.traverse, rendering.truth
        for row, image in enumerate(t.images):
            assert image.file is not None
            path = tmp_path / image.file
            path.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(path), rendering.image(row))
        true = truth.world_T_mast[0]
        n = 300
        offset = (np.arange(n) - n / 2 + 0.5) * PIXEL_M
        x, y = true.translation()[0] + offset, true.translation()[1] - offset
        third = PIXEL_M / 3 * np.array([-1.0, 0.0, 1.0])
        light = np.zeros((n, n))
        for right in third:
            for up in third:
                places = np.stack(np.meshgrid(x + right, y + up), axis=-1).reshape(-1, 2)
                light += rendering.light_from_above(places, PIXEL_M / 3).reshape(n, n) / 9
    light += np.random.default_rng(0).normal(0, 0.05 * light.std(), light.shape)
    chart = MapImage(first_m=np.array([x[0], y[0]]), step_m=np.array([PIXEL_M, -PIXEL_M]), grey=light)
    # Where the mast is told to be: turned back about its place, and shifted back.
    told = gtsam.Pose3(gtsam.Rot3.Rz(-TURN_RAD) * true.rotation(), true.translation() - [*SHIFT_M, 0.0])
    posed = replace(t, rig=truth.rig)
    rotations, centres = posed.camera_poses((told,), truth.pan_tilt_rad, truth.flex)
    drive = Drive(
        traverse=replace(posed, folder=tmp_path, stops=(replace(t.stops[0], world_T_mast=told),)),
        cameras=tuple(truth.rig.eyes[eye].camera for eye in t.image_eye.tolist()),
        world_R_camera=rotations,
        world_t_camera=centres,
        angle_sigma_rad=np.full((len(t.frames), 2), 1e-4),
    )
    terrain = make_terrain(drive, TerrainOptions(cell_m=0.1, reach_m=15.0))
    found = register_stop("s0", terrain.stops[t.stops[0].id], told.translation()[:2], chart, search_m=12.0)
    assert np.abs(off(found)[1:]).max() < PIXEL_M / 4
    assert abs(off(found)[0]) < 5e-3
    assert off(found) @ np.linalg.solve(found.covariance, off(found)) < 16.3  # 3 numbers: 0.1 % exceed it
