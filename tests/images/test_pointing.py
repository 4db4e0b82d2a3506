"""Pointing from pictures alone: each step exact without noise, and the whole on pictures of a sphere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gtsam import Pose3

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import (
    FloatArray,
    axes_across,
    pan_tilt_rotation,
    so3_exp,
    so3_log,
    wrap_angle,
)
from pancam_graph.cli import main
from pancam_graph.data import Traverse
from pancam_graph.images.pointing import find_pointing
from pancam_graph.images.pointing._averaging import averaged, groups_of
from pancam_graph.images.pointing._head_fit import (
    HeadState,
    Points,
    Priors,
    fit_head,
    residuals,
)
from pancam_graph.images.pointing._levelling import levelled
from pancam_graph.images.pointing._pair_turns import FocalRange, PairTurn, pair_turn
from pancam_graph.images.pointing._two_points import d_directions, directions, focal_scales, turns_of
from pancam_graph.io import read_input
from pancam_graph.io.plain import PlainOptions, plain_traverse
from pancam_graph.rigs import Rig, stereo_pan_tilt
from support.sphere_pictures import FOCAL_PX, WIDTH, texture, write_pictures

RING = np.column_stack([np.arange(0, 360, 30), 4 * np.sin(np.arange(12))]) * np.pi / 180


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def rotations(n: int, rng: np.random.Generator, size: float = 1.0) -> FloatArray:
    return so3_exp(size * rng.normal(size=(n, 3)))


def seen(looks: FloatArray, world_R_camera: FloatArray, scale: float) -> FloatArray:
    """Points (n, 2) of the plane z = 1 of a camera that is told a focal length `scale` times too short."""
    rays = looks @ world_R_camera
    return np.asarray(scale * rays[:, :2] / rays[:, 2:])


# --- turns of pairs ---


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.7])
def test_two_points_tell_turn_and_focal_length(scale: float, rng: np.random.Generator) -> None:
    turn = rotations(1, rng, 0.2)[0]
    looks = rng.normal(size=(40, 2, 3)) * [0.3, 0.3, 0.0] + [0.0, 0.0, 1.0]
    a = np.stack([seen(looks[:, k], np.eye(3), scale) for k in range(2)], axis=1)
    b = np.stack([seen(looks[:, k], turn.T, scale) for k in range(2)], axis=1)
    scales, real = focal_scales(a, b)
    nearest = np.min(np.where(real, np.abs(scales / scale - 1), np.inf), axis=1)
    assert np.median(nearest) < 1e-9  # near double roots lose half the digits
    assert nearest.max() < 1e-3
    np.testing.assert_allclose(turns_of(directions(a, scale), directions(b, scale)), [turn] * 40, atol=1e-7)


def test_directions_have_the_derivative_that_is_said(rng: np.random.Generator) -> None:
    plane = rng.normal(size=(20, 2))
    for scale in (0.3, 1.0, 4.0):
        h = 1e-6
        numeric = (directions(plane, scale * np.exp(h)) - directions(plane, scale * np.exp(-h))) / (2 * h)
        np.testing.assert_allclose(d_directions(directions(plane, scale), plane, scale), numeric, atol=1e-9)


@pytest.mark.parametrize("noise_rad", [0.0, 5e-4])
def test_a_turn_is_found_among_wrong_matches(noise_rad: float, rng: np.random.Generator) -> None:
    turn = so3_exp(np.array([0.05, 0.35, -0.02]))
    looks = np.column_stack([rng.uniform(-0.4, 0.1, 300), rng.uniform(-0.4, 0.4, 300), np.ones(300)])
    a, b = seen(looks, np.eye(3), 1.1), seen(looks, turn.T, 1.1)
    b = b + noise_rad * rng.normal(size=b.shape)
    wrong = rng.random(300) < 0.5
    b[wrong] = rng.uniform(-0.4, 0.4, (wrong.sum(), 2))
    found = pair_turn(0, 1, (a, b), FocalRange(low=0.4, high=8.0), 0.7, 50)
    assert found is not None
    assert np.linalg.norm(so3_log(found.b_R_a @ turn.T)) < 2e-3 + 10 * noise_rad
    assert abs(found.scale / 1.1 - 1) < 0.01 + 100 * noise_rad
    fixed = pair_turn(0, 1, (a[~wrong], b[~wrong]), FocalRange(low=1.1, high=1.1), 0.7, 50)
    assert fixed is not None
    assert np.linalg.norm(so3_log(fixed.b_R_a @ turn.T)) < 1e-9 + noise_rad
    by_chance = rng.uniform(-0.4, 0.4, (2, 300, 2))
    assert pair_turn(0, 1, (by_chance[0], by_chance[1]), FocalRange(low=0.4, high=8.0), 0.7, 50) is None


# --- all turns together ---


def test_groups_are_what_pairs_join() -> None:
    assert groups_of([(0, 3), (4, 1), (1, 5), (5, 4)], 6) == [[1, 4, 5], [0, 3], [2]]


@pytest.mark.parametrize("noise_rad", [0.0, 1e-3])
def test_averaged_rotations_are_exact_but_for_noise(noise_rad: float, rng: np.random.Generator) -> None:
    count = 12
    truth = rotations(count, rng)
    pairs = np.array([(i, (i + k) % count) for i in range(count) for k in (1, 2, 3)])
    turns = np.swapaxes(truth[pairs[:, 1]], 1, 2) @ truth[pairs[:, 0]]
    turns = turns @ rotations(len(pairs), rng, noise_rad)
    wrong = [3, 20]
    turns[wrong] = rotations(2, rng)
    weight = np.ones(len(pairs))
    weight[wrong] = 0.5
    found = averaged(pairs, turns, weight, count)
    off = so3_log(np.swapaxes(found, 1, 2) @ (truth[0].T @ truth))
    assert np.abs(off).max() < 3e-3 + 3 * noise_rad
    right = np.delete(np.arange(len(pairs)), wrong)
    clean = averaged(pairs[right], turns[right], weight[right], count)
    off = so3_log(np.swapaxes(clean, 1, 2) @ (truth[0].T @ truth))
    assert np.abs(off).max() < 1e-9 + 3 * noise_rad


@pytest.mark.parametrize(
    "pan_tilt", [RING, RING[:3] * [1, -8], np.array([[0.0, 1.8], [1.0, -0.9], [2.5, 1.2]])]
)
def test_levelled_heads_have_their_pans_and_tilts(pan_tilt: FloatArray, rng: np.random.Generator) -> None:
    heads = pan_tilt_rotation(pan_tilt[:, 0], pan_tilt[:, 1])
    level = levelled(rotations(1, rng)[0] @ heads)
    assert level.told
    np.testing.assert_allclose(wrap_angle(level.pan_rad - pan_tilt[:, 0] + pan_tilt[0, 0]), 0, atol=1e-9)
    np.testing.assert_allclose(wrap_angle(level.tilt_rad - pan_tilt[:, 1]), 0, atol=1e-7)
    assert level.off_rad.max() < 1e-7


def test_heads_that_look_one_way_do_not_tell_the_pan_axis(rng: np.random.Generator) -> None:
    pan_tilt = np.column_stack([[0.0, 0.1, -0.1], [0.3, 0.0, -0.3]])
    level = levelled(rotations(1, rng)[0] @ pan_tilt_rotation(pan_tilt[:, 0], pan_tilt[:, 1]))
    assert not level.told
    np.testing.assert_allclose(level.tilt_rad, pan_tilt[:, 1], atol=0.02)


# --- the head ---


def head_scene(
    rng: np.random.Generator, noise_rad: float, far: bool
) -> tuple[Rig, HeadState, Points, FloatArray]:
    """Two eyes on a ring of frames: rig, truth, points and their inverse depths."""
    rig = stereo_pan_tilt()
    state = HeadState(
        pan_rad=RING[:, 0],
        tilt_rad=RING[:, 1] - 0.2,
        roll_rad=np.array([0.01, -0.004]),
        log_scale=np.array([0.03, 0.01]),
        shift_m=np.zeros((2, 3)),
    )
    pairs, depths = [], []
    n = 20
    image_frame, image_eye = np.repeat(np.arange(12), 2), np.tile([0, 1], 12)
    mounts = np.array([e.head_T_camera.rotation().matrix() for e in rig.eyes])
    rolled = so3_exp(np.column_stack([state.roll_rad, np.zeros(2), np.zeros(2)])) @ mounts
    for a in range(24):
        b = (a + 2) % 24
        fa, fb, ea, eb = image_frame[a], image_frame[b], image_eye[a], image_eye[b]
        angles = np.column_stack([state.pan_rad, state.tilt_rad])[[fa, fb]]
        head, _ = rig.mast_T_head(angles[:, 0], angles[:, 1])
        _, centre = rig.mast_T_camera(angles, np.array([ea, eb]))
        R = head @ rolled[[ea, eb]]
        middle = R[0, :, 2] + R[1, :, 2]
        looks = middle / np.linalg.norm(middle) + 0.15 * rng.normal(size=(n, 3))
        looks = looks / np.linalg.norm(looks, axis=1, keepdims=True)
        near = np.zeros(n) if far else rng.uniform(0.0, 0.25, n)
        from_b = looks + near[:, None] * (centre[0] - centre[1])
        planes = [
            seen(looks, R[0], np.exp(state.log_scale[ea])),
            seen(from_b, R[1], np.exp(state.log_scale[eb])),
        ]
        planes = [plane + noise_rad * rng.normal(size=plane.shape) for plane in planes]
        pairs.append(
            PairTurn(
                a=a, b=b, b_R_a=np.eye(3), scale=1.0, sigma_scale=1.0, plane_a=planes[0], plane_b=planes[1]
            )
        )
        depths.append(near)
    return rig, state, Points.of(pairs, image_frame, image_eye), np.concatenate(depths)


def test_residuals_of_the_head_vanish_at_the_truth_and_have_their_jacobian(rng: np.random.Generator) -> None:
    rig, truth, points, inverse_depth = head_scene(rng, 0.0, far=False)
    axes = axes_across(np.tile([[0.0, 0.6, 0.8]], (len(inverse_depth), 1)))
    assert np.abs(residuals(rig, truth, points, inverse_depth, axes)[0]).max() < 1e-9
    for size in (0.0, 1e-3, 0.5):  # at the truth, near it, and far away
        width = 2 * len(truth.pan_rad) + 10
        state = truth.moved(size * rng.normal(size=width))
        near = inverse_depth + 0.3 * size
        _, J, by_depth = residuals(rig, state, points, near, axes)
        h = 1e-6
        for column in rng.choice(width, 6, replace=False):
            step = h * np.eye(width)[column]
            up, down = (residuals(rig, state.moved(s * step), points, near, axes)[0] for s in (1, -1))
            np.testing.assert_allclose(
                J[:, :, column], (up - down) / (2 * h), atol=2e-5 * (1 + np.abs(J).max())
            )
        up, down = (residuals(rig, state, points, near + s * h, axes)[0] for s in (1, -1))
        np.testing.assert_allclose(by_depth, (up - down) / (2 * h), atol=1e-3)


def test_the_head_is_exact_without_noise(rng: np.random.Generator) -> None:
    rig, truth, points, _ = head_scene(rng, 0.0, far=True)
    start = HeadState.of(
        truth.pan_rad + 0.02 * rng.normal(size=12), truth.tilt_rad + 0.02 * rng.normal(size=12), np.zeros(2)
    )
    start = replace(start, pan_rad=np.where(np.arange(12) == 0, truth.pan_rad, start.pan_rad))
    found = fit_head(rig, start, points, Priors(roll_rad=1e3, scale=1e3, shift_m=0.0))
    assert not len(found.wrong)
    for name in ("pan_rad", "tilt_rad", "log_scale"):
        np.testing.assert_allclose(getattr(found.state, name), getattr(truth, name), atol=1e-5)


def test_arms_and_focal_length_are_found_together(rng: np.random.Generator) -> None:
    # Arms and depths have a common scale that only priors settle.
    rig, truth, points, _ = head_scene(rng, 1e-4, far=False)
    bare = replace(
        rig,
        eyes=tuple(
            replace(e, head_T_camera=Pose3(e.head_T_camera.rotation(), np.zeros(3))) for e in rig.eyes
        ),
    )
    arms = np.array([e.head_T_camera.translation() for e in rig.eyes])
    start = replace(truth, log_scale=truth.log_scale + 0.006, roll_rad=np.zeros(2))
    found = fit_head(bare, start, points, Priors(roll_rad=0.02, scale=0.5, shift_m=0.15), near=True)
    assert not len(found.wrong)
    np.testing.assert_allclose(found.state.log_scale, truth.log_scale, atol=1e-3)
    shift = found.state.shift_m
    assert np.sum(shift * arms) > 0.99 * np.linalg.norm(shift) * np.linalg.norm(arms)


@pytest.mark.slow
def test_errors_of_the_head_agree_with_its_sigmas() -> None:
    squares = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        rig, truth, points, _ = head_scene(rng, 1e-3 / np.sqrt(2), far=True)
        points = replace(points, worth=np.ones_like(points.worth))
        start = HeadState.of(truth.pan_rad, truth.tilt_rad, np.zeros(2))
        found = fit_head(rig, start, points, Priors(roll_rad=0.1, scale=0.1, shift_m=0.0))
        squares.append(((found.state.pan_rad - truth.pan_rad)[1:] / found.sigma.pan_rad[1:]) ** 2)
        squares.append(((found.state.log_scale - truth.log_scale) / found.sigma.log_scale) ** 2)
    assert 0.3 < np.mean(np.concatenate(squares)) < 2.0


# --- the whole, from pictures ---


def errors_deg(found: Traverse, truth: FloatArray) -> FloatArray:
    """Differences of pans and tilts (n, 2), the common pan taken off."""
    off = wrap_angle(found.pan_tilt_rad - truth)
    off[:, 0] = wrap_angle(off[:, 0] - off[0, 0])
    return np.asarray(np.rad2deg(off))


@pytest.mark.slow
def test_a_ring_of_pictures_alone_tells_pointing_and_focal_length(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "F"
    write_pictures(folder, texture(1), RING)
    assert main(["init", str(folder)]) == 0
    assert "the pointing" not in capsys.readouterr().err
    found = read_input(folder)
    assert np.abs(errors_deg(found, RING)).max() < 0.2
    assert found.rig.eyes[0].camera.pinhole.fx_px == pytest.approx(FOCAL_PX, rel=0.01)
    assert found.pan_tilt_rad[0, 0] == 0.0
    assert all(0.008 < s < 0.05 for f in found.frames for s in f.sigmas_rad)
    assert "from the pictures" in (folder / "traverse.txt").read_text()


@pytest.mark.slow
def test_told_pans_are_the_gauge_and_a_check(tmp_path: Path, rng: np.random.Generator) -> None:
    folder = tmp_path / "F"
    write_pictures(folder, texture(2), RING[:7])
    told = np.rad2deg(RING[:7]) + [40.0, 0.0] + 5 * rng.normal(size=(7, 2))
    told[3, 0] += 90
    told[5] = np.rad2deg(RING[5]) + np.array([40.3, 0.1])
    lines = [f"{n:02d}.png,{pan},{tilt},{0.2 if n == 5 else ''}" for n, (pan, tilt) in enumerate(told)]
    lines = [f"{line},{0.2 if n == 5 else ''}" for n, line in enumerate(lines)]
    (tmp_path / "p.csv").write_text("\n".join(["file,pan_deg,tilt_deg,sigma_pan_deg,sigma_tilt_deg", *lines]))
    options = PlainOptions(pointing=tmp_path / "p.csv", sigma_rad=np.deg2rad(5), focal_px=0.95 * FOCAL_PX)
    found = find_pointing(plain_traverse(folder, options).traverse).traverse
    off = errors_deg(found, RING[:7])
    assert np.abs(off).max() < 1.5
    sigma = np.rad2deg([frame.sigmas_rad for frame in found.frames])
    assert np.all(np.abs(off) < 3 * np.hypot(sigma, sigma[0]))
    assert np.rad2deg(found.pan_tilt_rad[0, 0]) == pytest.approx(40.0, abs=6.0)
    np.testing.assert_allclose(np.rad2deg(found.pan_tilt_rad[5]), told[5])  # it is known well
    (warning,) = (w for w in found.warnings if "told pans disagree" in w)
    assert "frame003" in warning


@pytest.mark.slow
def test_of_pictures_of_two_places_the_larger_group_is_kept(tmp_path: Path) -> None:
    folder = tmp_path / "F"
    write_pictures(folder, texture(3), RING[:4])
    write_pictures(folder, texture(4), RING[:2], first=4)
    found = find_pointing(plain_traverse(folder, PlainOptions(focal_px=FOCAL_PX)).traverse).traverse
    assert [image.id for image in found.images] == ["00", "01", "02", "03"]
    assert any(w.endswith("group are left out: 04.png, 05.png") for w in found.warnings)
    assert np.abs(errors_deg(found, RING[:4])).max() < 1.0


def test_what_tells_no_pointing_is_one_sentence(tmp_path: Path) -> None:
    def refusal(place: str) -> str:
        with pytest.raises(InputError) as error:
            find_pointing(plain_traverse(tmp_path / place, PlainOptions(focal_px=float(WIDTH))).traverse)
        return str(error.value)

    write_pictures(tmp_path / "apart", texture(5), RING[[0, 6]])
    assert "expected pictures that overlap, found no two that show the same things" in refusal("apart")
    write_pictures(tmp_path / "one", texture(5), RING[:1])
    assert "expected two pictures or more" in refusal("one")
    write_pictures(tmp_path / "blank", np.full((512, 1024), 90.0), RING[:2])
    assert "expected pictures with features, found none" in refusal("blank")
    stops = tmp_path / "two"
    stops.mkdir()
    for name in ("s1", "s2"):
        write_pictures(stops / name, texture(5), RING[:2])
    (tmp_path / "stops.csv").write_text("stop,x_m,y_m,z_m\ns1,0,0,0\ns2,1,0,0\n")
    with pytest.raises(InputError, match=r"stop s1: expected the pan of one of its pictures at least"):
        find_pointing(
            plain_traverse(stops, PlainOptions(focal_px=FOCAL_PX, stops=tmp_path / "stops.csv")).traverse
        )
