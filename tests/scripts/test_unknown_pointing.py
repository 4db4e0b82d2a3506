"""The script that measures pointing from pictures: its errors are what they say. It is not run here."""

import numpy as np
import pytest

pytest.importorskip("unknown_pointing", reason="scripts are part of the repository, not of the package")

from pancam_graph import SimulationOptions, simulate
from pancam_graph.base.geometry import pan_tilt_from_rotation, pan_tilt_rotation, so3_exp
from pancam_graph.data import UNKNOWN_RAD
from pancam_graph.rigs import mer_navcam
from unknown_pointing import ARM_SIGMA_M, FOCAL_SIGMA, errors_rad, forgotten

RING = np.column_stack([np.arange(20) * np.pi / 10, np.tile([-0.35, 0.0], 10)])


def test_a_turn_of_all_together_is_no_error() -> None:
    turned = so3_exp(np.array([0.01, -0.02, 2.0])) @ pan_tilt_rotation(RING[:, 0], RING[:, 1])
    # A head that is rolled by the turn has no pan and tilt of its own; the roll is of second order here.
    pan, tilt = pan_tilt_from_rotation(turned)
    assert errors_rad(np.column_stack([pan, tilt]), RING).max() < 0.01
    yaw = RING + np.array([1.3, 0.0])
    np.testing.assert_allclose(errors_rad(yaw, RING), 0, atol=1e-9)


def test_errors_of_pan_and_of_tilt_are_told_apart() -> None:
    sign = np.where(np.arange(20) // 2 % 2, 1.0, -1.0)[:, None]
    for error in ([2e-4, 0.0], [0.0, 3e-4]):
        np.testing.assert_allclose(errors_rad(RING + sign * error, RING), error, atol=2e-6)


def test_what_is_forgotten_is_said() -> None:
    traverse = simulate(mer_navcam(), SimulationOptions(stops=1, pans=4, points_per_image=5)).traverse
    truth = traverse.pan_tilt_rad
    blind = forgotten(traverse, truth, None, np.random.default_rng(0))
    assert not blind.pan_tilt_rad.any()
    assert {frame.sigma_pan_rad for frame in blind.frames} == {UNKNOWN_RAD}
    scale, arms = [], []
    for seed in range(200):
        told = forgotten(traverse, truth, 0.1, np.random.default_rng(seed))
        scale.append(told.rig.eyes[0].camera.pinhole.fx_px / traverse.rig.eyes[0].camera.pinhole.fx_px - 1)
        arms.append(
            told.rig.eyes[0].head_T_camera.translation() - traverse.rig.eyes[0].head_T_camera.translation()
        )
    assert np.std(scale) == pytest.approx(FOCAL_SIGMA, rel=0.2)
    assert np.std(arms) == pytest.approx(ARM_SIGMA_M, rel=0.2)
    assert np.std(told.pan_tilt_rad - truth) == pytest.approx(0.1, rel=0.6)
