"""What lies in a known direction, at a pixel: values by other formulas, Jacobians against differences."""

import gtsam
import numpy as np
import pytest

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CALIBRATION_ENTRIES, Brown
from pancam_graph.factors import (
    Corrected,
    Fixed,
    Key,
    SeenPixel,
    camera_direction_factor,
    mast_direction_factor,
)
from pancam_graph.rigs import mars2020_navcam

M, A, E, T, K, F, D, X = (gtsam.symbol(c, 0) for c in "MAETKFDX")
CAMERA_R = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
MOUNT = gtsam.Pose3(CAMERA_R * gtsam.Rot3.Rodrigues(0.02, 0.01, -0.03), np.array([0.1, 0.2, 0.05]))
AXIS = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.02, -0.01, 0.03), np.array([0.03, -0.02, 0.05]))
BROWN = Brown(
    width_px=1024,
    height_px=1024,
    fx_px=1100.0,
    fy_px=1090.0,
    cx_px=512.0,
    cy_px=500.0,
    skew_px=0.3,
    distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.0),
)
CAMERAS = {"brown": BROWN, "cahvore": mars2020_navcam().eyes[0].camera}
STATES = {"random": 0.3, "near": 1e-7, "far": 2.5}
"""Radians by which the mast is turned from where the camera sees the direction."""


def pixel_of(name: str) -> tuple[SeenPixel, FloatArray]:
    camera = CAMERAS[name]
    uv = np.array([0.3 * camera.width_px, 0.6 * camera.height_px])
    basis = np.zeros((5, 2))
    basis[[0, 3], [0, 1]] = 1.0
    field = np.random.default_rng(4).normal(size=(2, 6))
    pixel = SeenPixel(
        camera.with_unit_calibration(),
        camera.pinhole.calibration_matrix,
        uv,
        basis=basis,
        field=field,
    )
    return pixel, camera.unproject(uv[None]).direction[0]


def camera_at(values: gtsam.Values) -> gtsam.Pose3:
    """The camera's pose, of poses multiplied by GTSAM."""
    pan, tilt = values.atVector(A)
    mount, axis = Corrected(E, MOUNT, (0, 4)).pose(values)[0], Corrected(T, AXIS, (1,)).pose(values)[0]
    head = Corrected(F, gtsam.Pose3(), (0, 5)).pose(values)[0]
    zero = np.zeros(3)
    turned = gtsam.Pose3(gtsam.Rot3.Rz(pan), zero) * axis * gtsam.Pose3(gtsam.Rot3.Ry(-tilt), zero)
    return values.atPose3(M) * turned * head * mount


def drawn(seed: int) -> gtsam.Values:
    rng, values = np.random.default_rng(seed), gtsam.Values()
    values.insert(M, gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 1, 3)), rng.normal(0, 20, 3)))
    values.insert(A, np.array([rng.uniform(-3, 3), rng.uniform(-1.4, 1.4)]))
    for key, n, size in ((E, 2, 0.01), (T, 1, 0.01), (F, 2, 0.01), (K, 2, 2.0), (D, 6, 0.1)):
        values.insert(key, size * rng.normal(size=n))
    values.insert(X, camera_at(values))
    return values


def factors_of(pixel: SeenPixel, direction: FloatArray) -> tuple[gtsam.CustomFactor, gtsam.CustomFactor]:
    unit = gtsam.noiseModel.Unit.Create(2)
    mount, axis = Corrected(E, MOUNT, (0, 4)), Corrected(T, AXIS, (1,))
    head = Corrected(F, gtsam.Pose3(), (0, 5))
    by_mast = mast_direction_factor(
        unit, pixel, Key(M), Key(A), mount, axis, Key(K), Key(D), head, direction=direction
    )
    return by_mast, camera_direction_factor(unit, pixel, Key(X), Key(K), direction=direction)


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("name", CAMERAS)
def test_jacobians_are_those_of_differences(name: str, state: str) -> None:
    for seed in range(3):
        pixel, _ = pixel_of(name)
        values, rng = drawn(seed), np.random.default_rng(seed + 50)
        sight, *_ = pixel.sight(values.atVector(K), values.atVector(D))
        axis = rng.normal(size=3)
        turn = gtsam.Rot3.Rodrigues(STATES[state] * axis / np.linalg.norm(axis))
        direction = turn.rotate(camera_at(values).rotation().rotate(sight))
        factor, _ = factors_of(pixel, direction)
        jacobian = factor.linearize(values).jacobian()[0]
        begin = 0
        for key in factor.keys():  # noqa: SIM118  a gtsam factor
            dim = 6 if key == M else len(values.atVector(key))
            for k in range(dim):
                ends = []
                for h in (1e-6, -1e-6):
                    delta = gtsam.VectorValues()
                    delta.insert(key, h * np.eye(dim)[k])
                    ends.append(factor.unwhitenedError(values.retract(delta)))
                numeric = (ends[0] - ends[1]) / 2e-6
                assert jacobian[:, begin + k] == pytest.approx(numeric, abs=2e-8, rel=1e-6)
            begin += dim


@pytest.mark.parametrize("name", CAMERAS)
def test_a_camera_of_its_own_has_the_residual_of_the_mast_and_its_jacobian(name: str) -> None:
    camera = CAMERAS[name]
    uv = np.array([0.7 * camera.width_px, 0.4 * camera.height_px])
    pixel = SeenPixel(
        camera.with_unit_calibration(), camera.pinhole.calibration_matrix, uv, basis=np.eye(5)[:, :2]
    )
    values = drawn(8)
    seen = camera_at(values).rotation().rotate(camera.unproject(uv[None]).direction[0])
    direction = gtsam.Rot3.Rodrigues(0.02, -0.01, 0.03).rotate(seen)
    unit = gtsam.noiseModel.Unit.Create(2)
    factor = camera_direction_factor(unit, pixel, Key(X), Key(K), direction=direction)
    by_mast = mast_direction_factor(
        unit,
        pixel,
        Key(M),
        Key(A),
        Corrected(E, MOUNT, (0, 4)),
        Corrected(T, AXIS, (1,)),
        Key(K),
        Fixed(np.zeros(0)),
        Corrected(F, gtsam.Pose3(), (0, 5)),
        direction=direction,
    )
    assert factor.unwhitenedError(values) == pytest.approx(by_mast.unwhitenedError(values), abs=1e-12)
    jacobian = factor.linearize(values).jacobian()[0]
    for k in range(6):
        ends = []
        for h in (1e-6, -1e-6):
            delta = gtsam.VectorValues()
            delta.insert(X, h * np.eye(6)[k])
            ends.append(factor.unwhitenedError(values.retract(delta)))
        assert jacobian[:, k] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-8)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_pixel_off_by_some_pixels_is_as_many_sigmas_and_half_a_turn_is_finite(name: str) -> None:
    """Whitened by the covariance of a pixel, the residual is the pixel's distance."""
    camera, (_, direction) = CAMERAS[name], pixel_of(name)
    K0 = camera.pinhole.calibration_matrix
    uv = np.array([0.3 * camera.width_px, 0.6 * camera.height_px])
    pixel = SeenPixel(camera.with_unit_calibration(), K0, uv)
    values = gtsam.Values()
    values.insert(X, gtsam.Pose3())
    for off in ([1.0, 0.0], [0.0, 1.0], [-0.6, 0.8]):
        other = SeenPixel(camera.with_unit_calibration(), K0, uv + off)
        noise = gtsam.noiseModel.Gaussian.Covariance(other.covariance_per_px2)
        factor = camera_direction_factor(noise, other, Key(X), Fixed(np.zeros(0)), direction=direction)
        assert 2 * factor.error(values) == pytest.approx(1.0, rel=1e-2)
    behind = camera_direction_factor(
        gtsam.noiseModel.Unit.Create(2), pixel, Key(X), Fixed(np.zeros(0)), direction=-direction
    )
    assert np.linalg.norm(behind.unwhitenedError(values)) == pytest.approx(np.pi)
    assert np.all(np.isfinite(behind.linearize(values).jacobian()[0]))


def test_entries_of_k_move_the_sight_as_a_camera_with_another_k() -> None:
    pixel, _ = pixel_of("brown")
    K0 = BROWN.calibration_matrix.copy()
    K0[CALIBRATION_ENTRIES[0][0], CALIBRATION_ENTRIES[1][0]] += 3.0
    K0[0, 2] -= 2.0
    uv = np.array([[0.3 * 1024, 0.6 * 1024]])
    expected = BROWN.with_calibration(K0).unproject(uv).direction[0]
    assert pixel.sight(np.array([3.0, -2.0]), np.zeros(6))[0] == pytest.approx(expected, abs=1e-12)
