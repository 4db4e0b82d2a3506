"""A terrain point seen from a rigid mast: against GTSAM's own projection and against differences."""

from itertools import product

import gtsam
import numpy as np
import pytest

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import Pinhole
from pancam_graph.factors import Corrected, Fixed, Key, mast_projection_factor
from support.parameters import slow_for

L, M, A, E, T, K, F = (gtsam.symbol(c, 0) for c in "LMAETKF")
NOMINAL = np.array([[1100.0, 0.3, 512.0], [0.0, 1090.0, 500.0], [0.0, 0.0, 1.0]])
CAMERA_R = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
MOUNT = gtsam.Pose3(CAMERA_R * gtsam.Rot3.Rodrigues(0.02, 0.01, -0.03), np.array([0.1, 0.2, 0.05]))
AXIS = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.02, -0.01, 0.03), np.array([0.03, -0.02, 0.05]))
LENS = Pinhole(width_px=1, height_px=1, fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0)
ENTRIES = (0, 3)
"""Free entries of K: fx and cx."""


def camera_at(values: gtsam.Values) -> gtsam.Pose3:
    """The camera's pose, of poses multiplied by GTSAM."""
    pan, tilt = values.atVector(A)
    corrected = [Corrected(E, MOUNT, (0, 4)).pose(values)[0], Corrected(T, AXIS, (1,)).pose(values)[0]]
    zero = np.zeros(3)
    turned = gtsam.Pose3(gtsam.Rot3.Rz(pan), zero) * corrected[1] * gtsam.Pose3(gtsam.Rot3.Ry(-tilt), zero)
    return values.atPose3(M) * turned * corrected[0]


def random_values(rng: np.random.Generator, depth_m: float) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(M, gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 1, 3)), rng.normal(0, 20, 3)))
    values.insert(A, np.array([rng.uniform(-3, 3), rng.uniform(-1.4, 1.4)]))
    values.insert(E, 0.01 * rng.normal(size=2))
    values.insert(T, 0.01 * rng.normal(size=1))
    values.insert(K, np.array([3.0, -2.0]))
    seen = depth_m * np.array([*rng.uniform(-0.4, 0.4, 2), 1.0])
    values.insert(L, camera_at(values).transformFrom(seen))
    return values


def made(uv_px: FloatArray, head: Corrected | None = None) -> gtsam.CustomFactor:
    basis = np.zeros((1, 5, 2))
    basis[0, ENTRIES, (0, 1)] = 1.0
    return mast_projection_factor(
        gtsam.noiseModel.Unit.Create(2),
        Key(L),
        Key(M),
        Key(A),
        Corrected(E, MOUNT, (0, 4)),
        Corrected(T, AXIS, (1,)),
        Key(K),
        head,
        nominal=NOMINAL[None],
        basis=basis,
        lens=LENS,
        uv_px=uv_px[None],
    )


@pytest.mark.parametrize("depth_m", [0.5, 5.0, 1e4])
def test_the_residual_is_that_of_gtsams_camera(depth_m: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        values = random_values(rng, depth_m)
        dfx, dcx = values.atVector(K)
        calibration = gtsam.Cal3_S2(1100.0 + dfx, 1090.0, 0.3, 512.0 + dcx, 500.0)
        seen = gtsam.PinholeCameraCal3_S2(camera_at(values), calibration).project(values.atPoint3(L))
        uv = seen + rng.normal(size=2)
        assert made(uv).unwhitenedError(values) == pytest.approx(seen - uv, abs=1e-7)


@pytest.mark.parametrize(
    ("flexes", "depth_m"),
    slow_for([(True, 5.0), (False, 0.5), (False, 1e4)], product([True, False], [0.5, 5.0, 1e4])),
)
def test_jacobians_are_those_of_differences(flexes: bool, depth_m: float) -> None:
    head = Corrected(F, gtsam.Pose3(), (0, 3, 4, 5)) if flexes else None
    rng = np.random.default_rng(2)
    for _ in range(5):
        values = random_values(rng, depth_m)
        values.insert(F, 1e-3 * rng.normal(size=4))
        factor = made(np.array([500.0, 400.0]), head)
        jacobian, column = factor.linearize(values).jacobian()[0], 0
        for key in factor.keys():  # noqa: SIM118  a gtsam factor, not a dictionary
            dim = {L: 3, M: 6, A: 2, E: 2, T: 1, K: 2, F: 4}[key]
            step = 1e-5 * depth_m if key == L else 1e-6
            for i in range(dim):
                errors = []
                for h in (step, -step):
                    delta = gtsam.VectorValues()
                    delta.insert(key, h * np.eye(dim)[i])
                    errors.append(factor.unwhitenedError(values.retract(delta)))
                numeric = (errors[0] - errors[1]) / (2 * step)
                assert jacobian[:, column] == pytest.approx(numeric, abs=1e-5 * max(1, np.abs(numeric).max()))
                column += 1


def test_a_point_behind_its_camera_has_a_large_residual_that_moves_nowhere() -> None:
    values = random_values(np.random.default_rng(3), 5.0)
    values.update(L, camera_at(values).transformFrom(np.array([0.1, 0.2, -3.0])))
    factor = made(np.array([500.0, 400.0]))
    assert np.all(factor.unwhitenedError(values) > 1e5)
    assert not factor.linearize(values).jacobian()[0].any()


def test_what_is_fixed_is_no_variable() -> None:
    values = random_values(np.random.default_rng(4), 5.0)
    camera = MOUNT
    factor = mast_projection_factor(
        gtsam.noiseModel.Unit.Create(2),
        Key(L),
        Fixed(gtsam.Pose3()),
        Fixed(np.zeros(2)),
        Fixed(MOUNT),
        Fixed(gtsam.Pose3()),
        Fixed(np.zeros(0)),
        nominal=NOMINAL[None],
        basis=np.zeros((1, 5, 0)),
        lens=LENS,
        uv_px=np.zeros((1, 2)),
    )
    assert list(factor.keys()) == [L]
    values.update(L, camera.transformFrom(np.array([0.0, 0.0, 2.0])))
    assert factor.unwhitenedError(values) == pytest.approx([512.0, 500.0])
