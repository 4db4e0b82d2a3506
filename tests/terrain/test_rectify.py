"""Rectification through lenses and fields: points lie in one row, at the disparity of their depth."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from pancam_graph import Frame, Image, Stop, Traverse
from pancam_graph.cameras import Brown, Camera, with_field
from pancam_graph.rigs import Eye, Rig, mer_navcam
from pancam_graph.terrain import Drive
from pancam_graph.terrain._drive import stereo_pairs
from pancam_graph.terrain._rectify import rectify

RANGE_M = 6.0


def lens(seed: int, cx_px: float) -> Camera:
    rng = np.random.default_rng(seed)
    plain = Brown(
        width_px=200,
        height_px=160,
        fx_px=210.0 + seed,
        fy_px=211.0,
        cx_px=cx_px,
        cy_px=80.0,
        distortion=(-0.1, 0.02, 1e-3, -1e-3, 0.0),
    )
    return with_field(plain, rng.normal(0, 0.3, (2, 7, 7)))


def drive(folder: Path, second_m: tuple[float, float, float], turn: tuple[float, float, float]) -> Drive:
    rig = mer_navcam()
    first = rig.eyes[0]
    place = first.head_T_camera.compose(gtsam.Pose3(gtsam.Rot3.Rodrigues(*turn), np.array(second_m)))
    eyes = (
        replace(first, camera=lens(1, 98.0)),
        Eye(name="right", camera=lens(2, 104.0), head_T_camera=place),
    )
    rig = Rig(name="bent", pan_T_tilt=gtsam.Pose3(), eyes=eyes, mast_height_m=1.5)
    for name in ("a.png", "b.png"):
        (folder / name).write_bytes(b"")
    traverse = Traverse(
        name="pair",
        rig=rig,
        folder=folder,
        stops=(Stop(id="s", world_T_mast=gtsam.Pose3(), sigma_rotation_rad=0.0, sigma_translation_m=0.0),),
        frames=(Frame(id="f", stop="s", pan_rad=0.4, tilt_rad=-0.5, sigma_pan_rad=0.0, sigma_tilt_rad=0.0),),
        images=tuple(
            Image(id=eye.name, frame="f", camera=eye.name, file=file)
            for eye, file in zip(rig.eyes, ("a.png", "b.png"), strict=True)
        ),
    )
    R, t = traverse.camera_poses()
    return Drive(
        traverse=traverse,
        cameras=tuple(eye.camera for eye in rig.eyes),
        world_R_camera=R,
        world_t_camera=t,
        angle_sigma_rad=np.zeros((1, 2)),
    )


@pytest.mark.parametrize(
    ("second_m", "turn"),
    [
        ((0.2, 0.01, -0.02), (0.02, -0.03, 0.05)),  # beside
        ((-0.2, 0.0, 0.0), (0.0, 0.0, 0.0)),  # on the other side
        ((0.02, 0.2, 0.01), (0.01, 0.02, -0.04)),  # below
    ],
)
def test_a_point_lies_in_one_row_at_the_disparity_of_its_depth(
    tmp_path: Path, second_m: tuple[float, float, float], turn: tuple[float, float, float]
) -> None:
    made = drive(tmp_path, second_m, turn)
    (pair,), warnings = stereo_pairs(made)
    assert not warnings
    assert pair.baseline_m == pytest.approx(np.linalg.norm(second_m))
    rectified = rectify(made, pair)
    rng = np.random.default_rng(3)
    v = rng.integers(30, rectified.left.height_px - 30, 200)
    u = rng.integers(60, rectified.left.width_px - 60, 200)
    rays = rectified.rays()[v, u]
    points = rectified.world_t_left + rays * (RANGE_M / np.linalg.norm(rays, axis=1))[:, None]
    at = []
    for row, hole, centre in (
        (pair.left, rectified.left, rectified.world_t_left),
        (pair.right, rectified.right, made.world_t_camera[pair.right]),
    ):
        # Where the real camera sees the point is where the map of the rectified pixel leads.
        seen, _ = hole.project((points - centre) @ rectified.world_R_pair)
        real, valid = made.cameras[row].project(
            (points - made.world_t_camera[row]) @ made.world_R_camera[row]
        )
        inside = valid & made.cameras[row].contains(real)
        assert inside.sum() > 60
        uv_px = rectified.maps[0 if row == pair.left else 1]
        if row == pair.left:
            np.testing.assert_allclose(uv_px[v, u][inside], real[inside], atol=2e-3)
        at.append(seen)
    np.testing.assert_allclose(at[0], np.column_stack([u, v]), atol=1e-6)
    np.testing.assert_allclose(at[0][:, 1], at[1][:, 1], atol=1e-9)
    depth = rectified.depth_m(at[0][:, 0] - at[1][:, 0])
    np.testing.assert_allclose(rectified.world_t_left + rays * depth[:, None], points, atol=1e-9)


def test_a_baseline_of_nothing_is_no_stereo(tmp_path: Path) -> None:
    made = drive(tmp_path, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert stereo_pairs(made) == ([], [])
