"""Parameters of each model from camera matrices, and back (thesis 5.1)."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph.base.errors import CameraError, GeometryError, InputError
from pancam_graph.base.geometry import FloatArray, wrap_angle
from pancam_graph.cameras import projection_matrix
from pancam_graph.initialise import extract_circle, extract_free, extract_mast
from pancam_graph.rigs import Rig, exomars_pancam, mer_navcam, mer_pancam

EXACT = 1e-12
"""Relative to each row's own size."""


def bent(rig: Rig) -> Rig:
    """A tilt axis askew to the pan axis and beside it, as measured ones are."""
    offset = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.02, -0.01, 0.03), np.array([0.03, -0.02, 0.05]))
    return replace(rig, pan_T_tilt=offset)


@lru_cache
def cluster(rig: Rig, seed: int = 0, *, tilts: bool = True) -> tuple[Any, ...]:
    """Matrices of all eyes at nine pans, each times a factor; mast, angles, eyes, K."""
    rng = np.random.default_rng(seed)
    mast = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 0.3, 3)), rng.normal(0, 20, 3))
    angles = np.column_stack(
        [np.linspace(-2.5, 2.6, 9), rng.uniform(-0.6, 0.4, 9) if tilts else np.full(9, -0.2)]
    )
    eye = np.tile(np.arange(len(rig.eyes)), 9)
    angles = np.repeat(angles, len(rig.eyes), axis=0)
    R, t = rig.mast_T_camera(angles, eye)
    R, t = mast.rotation().matrix() @ R, t @ mast.rotation().matrix().T + mast.translation()
    K = np.array([p.calibration_matrix for p in rig.pinholes])[eye]
    K[:, 0, 1] = rng.normal(0, 3, len(eye))
    factor = rng.normal(0, 5, len(eye))
    return factor[:, None, None] * projection_matrix(K, R.transpose(0, 2, 1), t), R, t, K, angles, eye


def assert_same_matrices(found: FloatArray, given: FloatArray) -> None:
    """Up to each one's factor, and relative to the size of the rows."""
    unit = given / np.linalg.norm(given[:, 2, :3], axis=1)[:, None, None]
    unit *= np.sign(np.linalg.det(given[:, :, :3]))[:, None, None]
    size = np.linalg.norm(unit, axis=2, keepdims=True)
    assert np.abs((found - unit) / size).max() < EXACT


RIGS = {
    "navcam": mer_navcam(),
    "pancam": mer_pancam(),
    "exomars": exomars_pancam(),
    "bent": bent(mer_navcam()),
}


# --- back and forth ---


@pytest.mark.parametrize("name", RIGS)
def test_free_parameters_and_back(name: str) -> None:
    given, R, t, K, _, _ = cluster(RIGS[name])
    found = extract_free(given)
    assert found.calibration == pytest.approx(K, rel=1e-11, abs=1e-8)
    assert found.world_R_camera == pytest.approx(R, abs=1e-12)
    assert found.centre_m == pytest.approx(t, abs=1e-11)
    assert_same_matrices(found.projections, given)


@pytest.mark.parametrize("name", RIGS)
def test_circle_parameters_and_back(name: str) -> None:
    """One eye, one tilt; the radius is the rig's, the angles are the pans but for where they count from."""
    rig = RIGS[name]
    given, R, _, _, angles, eye = cluster(rig, tilts=False)
    own = eye == 0
    found = extract_circle(given[own])
    radius, _, _ = rig.circle(0, -0.2)
    assert found.circle.radius_m == pytest.approx(radius, abs=1e-11)
    turned = wrap_angle(found.circle.angle_rad - (angles[own, 0] - angles[0, 0]))
    assert turned == pytest.approx(np.zeros(9), abs=1e-9)
    assert found.world_R_camera == pytest.approx(R[own], abs=1e-12)
    assert found.circle.residual_m == pytest.approx(np.zeros((9, 2)), abs=1e-11)
    assert_same_matrices(found.projections, given[own])


def test_a_circles_normal_is_up_in_the_images_unless_said_otherwise() -> None:
    given, _, _, _, _, eye = cluster(mer_navcam(), tilts=False)
    own = given[eye == 0]
    up = extract_circle(own).circle.rotation[:, 2]
    assert extract_circle(own[::-1]).circle.rotation[:, 2] == pytest.approx(up, abs=1e-9)
    assert extract_circle(own, -up).circle.rotation[:, 2] == pytest.approx(-up, abs=1e-9)


def test_centres_off_their_circle_come_back_on_it() -> None:
    given, _, _, _, _, eye = cluster(mer_navcam(), tilts=False)
    cameras = extract_free(given[eye == 0])
    off = replace(cameras, centre_m=cameras.centre_m + np.random.default_rng(0).normal(0, 1e-4, (9, 3)))
    found = extract_circle(off.projections)
    assert np.abs(found.circle.residual_m).max() > 1e-5
    again = extract_free(found.projections)
    moved = np.linalg.norm(again.centre_m - off.centre_m, axis=1)
    assert moved == pytest.approx(np.linalg.norm(found.circle.residual_m, axis=1), rel=1e-6)
    assert again.world_R_camera == pytest.approx(off.world_R_camera, abs=1e-12)


@pytest.mark.parametrize("name", RIGS)
def test_mast_parameters_and_back(name: str) -> None:
    rig = RIGS[name]
    given, _, _, K, angles, eye = cluster(rig)
    names = [rig.eyes[e].name for e in eye]
    found = extract_mast(given, rig, names, first_pan_rad=float(angles[0, 0]))
    assert wrap_angle(found.pan_tilt_rad - angles) == pytest.approx(np.zeros_like(angles), abs=1e-11)
    assert found.residual_rad == pytest.approx(np.zeros((len(eye), 3)), abs=1e-11)
    assert found.residual_m == pytest.approx(np.zeros((len(eye), 3)), abs=1e-11)
    assert found.calibration == pytest.approx(K, rel=1e-11, abs=1e-8)
    assert_same_matrices(found.projections, given)


def test_a_turn_of_the_mast_is_a_shift_of_the_pans() -> None:
    rig = mer_navcam()
    given, _, _, _, angles, eye = cluster(rig)
    names = [rig.eyes[e].name for e in eye]
    zero = extract_mast(given, rig, names)
    assert zero.pan_tilt_rad[0, 0] == pytest.approx(0, abs=1e-12)
    assert wrap_angle(zero.pan_tilt_rad[:, 0] - angles[:, 0] + angles[0, 0]) == pytest.approx(
        np.zeros(len(eye)), abs=1e-11
    )
    assert_same_matrices(zero.projections, given)


def test_what_is_off_the_mast_is_told() -> None:
    """A camera turned about its own axis, another shifted: residuals say so; matrices come back on it."""
    rig = mer_navcam()
    given, _, _, _, _, eye = cluster(rig)
    names = [rig.eyes[e].name for e in eye]
    cameras = extract_free(given)
    turned = cameras.world_R_camera.copy()
    turned[3] = turned[3] @ Rotation.from_rotvec([0, 0, 1e-3]).as_matrix()
    centre = cameras.centre_m.copy()
    centre[5] += 0.01
    off = replace(cameras, world_R_camera=turned, centre_m=centre)
    found = extract_mast(off.projections, rig, names)
    assert np.argmax(np.linalg.norm(found.residual_rad, axis=1)) == 3
    assert np.argmax(np.linalg.norm(found.residual_m, axis=1)) == 5
    back = extract_mast(found.projections, rig, names)
    assert back.residual_rad == pytest.approx(np.zeros((len(eye), 3)), abs=1e-11)


def test_two_pans_are_enough_for_a_mast() -> None:
    rig = bent(mer_navcam())
    given, _, _, _, angles, eye = cluster(rig)
    few = given[[0, 6]]
    found = extract_mast(few, rig, ["left", "left"], first_pan_rad=float(angles[0, 0]))
    assert eye[0] == eye[6] == 0
    assert found.pan_tilt_rad == pytest.approx(angles[[0, 6]], abs=1e-10)
    assert_same_matrices(found.projections, few)


# --- bad input ---


def spoilt(**entries: object) -> FloatArray:
    """Good matrices, one of them spoilt."""
    given = cluster(mer_navcam())[0].copy()
    for where, what in entries.items():
        if where == "third_row":
            given[2, 2] = what
        elif where == "second_row":
            given[2, 1] = given[2, 0]
        else:
            given[2, 0, 1] = what
    return np.asarray(given)


@pytest.mark.parametrize(
    ("projections", "error", "message"),
    [
        (spoilt(third_row=0.0), CameraError, "camera 2: .*third row with a direction, found zeros"),
        (spoilt(second_row=None), CameraError, "camera 2: .*rank 3"),
        (spoilt(entry=np.nan), CameraError, "camera 2: .*expected finite numbers, found"),
        (spoilt(entry=np.inf), CameraError, "camera 2: .*expected finite numbers, found"),
        (np.zeros((4, 4)), InputError, r"expected shape \(n, 3, 4\), found \(4, 4\)"),
        (np.zeros((2, 3, 3)), InputError, r"expected shape \(n, 3, 4\), found \(2, 3, 3\)"),
        (np.zeros((0, 3, 4)), InputError, r"expected shape \(n, 3, 4\), found \(0, 3, 4\)"),
        ([[1, 2], [3]], InputError, "camera matrices: expected numbers, found"),
        ("P", InputError, "camera matrices: expected numbers, found"),
    ],
)
def test_matrices_that_are_no_cameras_are_refused(
    projections: FloatArray, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message) as raised:
        extract_free(projections)
    assert "\n" not in str(raised.value)
    with pytest.raises(error, match=message):
        extract_circle(projections)
    with pytest.raises(error, match=message):
        extract_mast(projections, mer_navcam(), ["left"] * 18)


def test_fewer_cameras_than_a_circle_needs() -> None:
    given = cluster(mer_navcam(), tilts=False)[0][::2]
    with pytest.raises(GeometryError, match="circle: expected at least 3 centres, found 2"):
        extract_circle(given[:2])
    with pytest.raises(GeometryError, match="circle: the 3 centres coincide"):
        extract_circle(given[[0, 0, 0]])
    assert extract_circle(given[:3]).circle.radius_m > 0


def test_what_determines_no_mast_is_refused() -> None:
    rig = mer_navcam()
    given = cluster(rig)[0]
    with pytest.raises(GeometryError, match="cameras at two pans or more, found 2 at one"):
        extract_mast(given[:2], rig, ["left", "right"])
    with pytest.raises(GeometryError, match="cameras at two pans or more, found 1 at one"):
        extract_mast(given[:1], rig, ["left"])
    with pytest.raises(InputError, match="eyes: expected one for each of 18 cameras, found 1"):
        extract_mast(given, rig, ["left"])
    with pytest.raises(InputError, match="camera 'middle': the rig mer-navcam has left, right"):
        extract_mast(given, rig, ["middle"] * 18)
