"""What is known at a pixel: values by other formulas, Jacobians against differences."""

import gtsam
import numpy as np
import pytest

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CALIBRATION_ENTRIES, Brown
from pancam_graph.factors import (
    Corrected,
    Fixed,
    Key,
    Seen,
    SeenDirection,
    SeenPixel,
    SeenPlace,
    camera_seen_factor,
    mast_seen_factor,
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


def what(name: str, pixel: SeenPixel, direction: FloatArray, camera: gtsam.Pose3) -> Seen:
    """A direction, or a place that lies there from the camera."""
    if name == "direction":
        return SeenDirection(pixel, direction, sigma_px=0.5, sigma_rad=1e-3)
    place = camera.translation() + 3.0 * direction
    return SeenPlace(pixel, place, sigma_px=0.5, sigma_m=0.01)


def by_mast(seen: Seen, field: Key | Fixed) -> gtsam.CustomFactor:
    mount, axis = Corrected(E, MOUNT, (0, 4)), Corrected(T, AXIS, (1,))
    head = Corrected(F, gtsam.Pose3(), (0, 5))
    return mast_seen_factor(seen, Key(M), Key(A), mount, axis, Key(K), field, head)


def whitened(factor: gtsam.CustomFactor, values: gtsam.Values) -> FloatArray:
    return np.asarray(factor.noiseModel().whiten(factor.unwhitenedError(values)))


def require_jacobians(factor: gtsam.CustomFactor, values: gtsam.Values) -> None:
    jacobian, begin = factor.linearize(values).jacobian()[0], 0
    size = np.abs(jacobian).max()
    for key in factor.keys():  # noqa: SIM118  a gtsam factor
        dim = 6 if key in {M, X} else len(values.atVector(key))
        for k in range(dim):
            ends = []
            for h in (1e-6, -1e-6):
                delta = gtsam.VectorValues()
                delta.insert(key, h * np.eye(dim)[k])
                ends.append(whitened(factor, values.retract(delta)))
            numeric = (ends[0] - ends[1]) / 2e-6
            assert jacobian[:, begin + k] == pytest.approx(numeric, abs=1e-7 * size, rel=1e-5)
        begin += dim


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("kind", ["direction", "place"])
@pytest.mark.parametrize("name", CAMERAS)
def test_jacobians_are_those_of_differences(name: str, kind: str, state: str) -> None:
    pixel, _ = pixel_of(name)
    values, rng = drawn(3), np.random.default_rng(50)
    camera = camera_at(values)
    sight, *_ = pixel.sight(values.atVector(K), values.atVector(D))
    axis = rng.normal(size=3)
    turn = gtsam.Rot3.Rodrigues(STATES[state] * axis / np.linalg.norm(axis))
    direction = turn.rotate(camera.rotation().rotate(sight[3:]))
    require_jacobians(by_mast(what(kind, pixel, direction, camera), Key(D)), values)
    plain = SeenPixel(
        CAMERAS[name].with_unit_calibration(),
        CAMERAS[name].pinhole.calibration_matrix,
        np.array([300.0, 500.0]),
        basis=np.eye(5)[:, [0, 3]],
    )
    seen = what(kind, plain, direction, camera)
    alone = camera_seen_factor(seen, Key(X), Key(K))
    require_jacobians(alone, values)
    assert whitened(alone, values) == pytest.approx(
        whitened(by_mast(seen, Fixed(np.zeros(0))), values), abs=1e-6
    )


@pytest.mark.parametrize("kind", ["direction", "place"])
@pytest.mark.parametrize("name", CAMERAS)
def test_a_pixel_that_is_off_is_as_many_sigmas(name: str, kind: str) -> None:
    """By the projection of the camera model itself: the nearest pixel is half a pixel off."""
    camera = CAMERAS[name]
    K0 = camera.pinhole.calibration_matrix
    uv = np.array([0.3 * camera.width_px, 0.6 * camera.height_px])
    values, none = gtsam.Values(), Fixed(np.zeros(0))
    values.insert(X, gtsam.Pose3())
    rays = camera.unproject(uv[None])
    place = rays.origin_m[0] + 4.0 * rays.direction[0]
    assert camera.project(place[None])[0][0] == pytest.approx(uv, abs=1e-6)
    for off in ([0.5, 0.0], [0.0, 0.5], [-0.3, 0.4]):
        pixel = SeenPixel(camera.with_unit_calibration(), K0, uv + off)
        assert pixel.is_valid
        seen: Seen = SeenPlace(pixel, place, sigma_px=0.25, sigma_m=0.0)
        if kind == "direction":
            seen = SeenDirection(pixel, rays.direction[0], sigma_px=0.25)
        assert np.linalg.norm(whitened(camera_seen_factor(seen, Key(X), none), values)) == pytest.approx(
            2.0, rel=1e-2
        )


def test_a_place_far_less_certain_than_pixels_is_off_by_its_own_sigmas() -> None:
    _, direction = pixel_of("brown")
    plain = SeenPixel(
        BROWN.with_unit_calibration(), BROWN.calibration_matrix, np.array([0.3 * 1024, 0.6 * 1024])
    )
    across = np.cross(direction, [0.0, 0.0, 1.0])
    place = 5.0 * direction + 0.3 * across / np.linalg.norm(across)
    values = gtsam.Values()
    values.insert(X, gtsam.Pose3())
    seen = SeenPlace(plain, place, sigma_px=1e-3, sigma_m=0.1)
    error = whitened(camera_seen_factor(seen, Key(X), Fixed(np.zeros(0))), values)
    assert np.linalg.norm(error) == pytest.approx(3.0, rel=5e-3)


def test_what_lies_behind_or_at_the_camera_itself_is_finite() -> None:
    _, direction = pixel_of("brown")
    values = gtsam.Values()
    values.insert(X, gtsam.Pose3())
    plain = SeenPixel(BROWN.with_unit_calibration(), BROWN.calibration_matrix, np.array([300.0, 600.0]))
    for seen in (
        SeenDirection(plain, -direction, sigma_px=1.0),
        SeenPlace(plain, np.zeros(3), sigma_px=1.0, sigma_m=0.1),
    ):
        factor = camera_seen_factor(seen, Key(X), Fixed(np.zeros(0)))
        assert np.all(np.isfinite(factor.linearize(values).jacobian()[0]))
        assert factor.error(values) > 1e3


def test_entries_of_k_move_the_sight_as_a_camera_with_another_k() -> None:
    pixel, _ = pixel_of("brown")
    K0 = BROWN.calibration_matrix.copy()
    K0[CALIBRATION_ENTRIES[0][0], CALIBRATION_ENTRIES[1][0]] += 3.0
    K0[0, 2] -= 2.0
    uv = np.array([[0.3 * 1024, 0.6 * 1024]])
    expected = BROWN.with_calibration(K0).unproject(uv).direction[0]
    assert pixel.sight(np.array([3.0, -2.0]), np.zeros(6))[0][3:] == pytest.approx(expected, abs=1e-12)
