"""Rotations, quaternions, angles and the pan-tilt chain: round trips, GTSAM, and differences."""

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
import scipy
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pancam_graph.base.errors import GeometryError
from pancam_graph.base.geometry import (
    HEAD_R_FORWARD_CAMERA,
    Z_DOWN_R_Z_UP,
    FloatArray,
    block_diagonal,
    compose,
    corrected_poses,
    correction_twists,
    d_pan_tilt_rotation,
    pan_tilt_from_rotation,
    pan_tilt_rotation,
    pose_arrays,
    pose_from_wxyz,
    rotation_from_wxyz,
    rx,
    ry,
    rz,
    skew,
    so3_exp,
    so3_log,
    so3_right_jacobian,
    so3_right_jacobian_inverse,
    twists_in_parent,
    wrap_angle,
    wxyz_from_rotation,
)

COMPONENT = st.floats(-1, 1, allow_subnormal=False)
AXIS = st.tuples(COMPONENT, COMPONENT, COMPONENT)
REPEATABLE = settings(derandomize=True, deadline=None)


@pytest.mark.parametrize(
    ("ours", "native"), [(rx, gtsam.Rot3.Rx), (ry, gtsam.Rot3.Ry), (rz, gtsam.Rot3.Rz)], ids="xyz"
)
@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.7, -2.5, np.pi])
def test_axis_rotations_are_gtsams(
    ours: Callable[[float], FloatArray], native: Callable[[float], gtsam.Rot3], angle: float
) -> None:
    assert ours(angle) == pytest.approx(native(angle).matrix(), abs=1e-15)


def test_pan_turns_left_and_tilt_lifts() -> None:
    ahead = np.array([1.0, 0.0, 0.0])
    assert pan_tilt_rotation(np.pi / 2, 0.0) @ ahead == pytest.approx([0, 1, 0], abs=1e-15)
    assert pan_tilt_rotation(0.0, np.pi / 6) @ ahead == pytest.approx([np.sqrt(0.75), 0, 0.5], abs=1e-15)


def test_fixed_frames() -> None:
    """A camera's right, down and forward are the head's right, down and forward."""
    assert HEAD_R_FORWARD_CAMERA.tolist() == [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    assert np.linalg.det(HEAD_R_FORWARD_CAMERA) == pytest.approx(1)
    assert (Z_DOWN_R_Z_UP @ Z_DOWN_R_Z_UP).tolist() == np.eye(3).tolist()
    assert np.linalg.det(Z_DOWN_R_Z_UP) == pytest.approx(1)


def test_batches_of_pan_and_tilt_are_products_of_single_rotations() -> None:
    rng = np.random.default_rng(0)
    pan, tilt = rng.uniform(-4, 4, (5, 1)), rng.uniform(-1.5, 1.5, 3)
    batch = pan_tilt_rotation(pan, tilt)
    assert batch.shape == (5, 3, 3, 3)
    for i in range(5):
        for j in range(3):
            assert batch[i, j] == pytest.approx(rz(pan[i, 0]) @ ry(-tilt[j]), abs=1e-15)


@pytest.mark.parametrize("tilt", [-1.5, -0.3, 0.0, 1e-7, 0.8, np.pi / 2])
def test_pan_tilt_derivative_against_differences(tilt: float) -> None:
    pan, h = 0.9, 1e-6
    here = pan_tilt_rotation(pan, tilt)
    for column, (dp, dt) in enumerate([(h, 0.0), (0.0, h)]):
        ahead, behind = pan_tilt_rotation(pan + dp, tilt + dt), pan_tilt_rotation(pan - dp, tilt - dt)
        turn = Rotation.from_matrix([here.T @ ahead, here.T @ behind]).as_rotvec()
        assert d_pan_tilt_rotation(tilt)[:, column] == pytest.approx((turn[0] - turn[1]) / (2 * h), abs=1e-9)


@REPEATABLE
@given(st.floats(-10, 10), st.floats(-np.pi / 2 + 1e-6, np.pi / 2 - 1e-6), st.floats(-3, 3))
def test_pan_and_tilt_come_back_whatever_the_twist(pan: float, tilt: float, twist: float) -> None:
    found_pan, found_tilt = pan_tilt_from_rotation(pan_tilt_rotation(pan, tilt) @ rx(twist))
    assert wrap_angle(found_pan - pan) == pytest.approx(0, abs=1e-9)
    assert found_tilt == pytest.approx(tilt, abs=1e-9)


@pytest.mark.parametrize("tilt", [np.pi / 2, -np.pi / 2])
def test_looking_straight_up_or_down_pan_comes_from_the_y_axis(tilt: float) -> None:
    """Whether or not the head's x axis is vertical to the last digit."""
    for pan in (0.0, 1.3, -2.8):
        rotation = pan_tilt_rotation(pan, tilt)
        exactly = rotation.copy()
        exactly[:2, 0] = 0.0
        for r in (rotation, exactly):
            assert np.array(pan_tilt_from_rotation(r)) == pytest.approx(np.array([pan, tilt]))


def quaternion_cases() -> st.SearchStrategy[tuple[float, float, float, float]]:
    """Any direction, with half turns (w = 0) and turns beside them as often as the rest."""
    w = st.one_of(st.just(0.0), st.sampled_from([1e-300, 1e-16, -1e-16, 1e-9, -1e-9]), COMPONENT)
    return st.tuples(w, COMPONENT, COMPONENT, COMPONENT)


@REPEATABLE
@given(quaternion_cases())
def test_quaternion_round_trip(wxyz: tuple[float, float, float, float]) -> None:
    assume(np.linalg.norm(wxyz) > 1e-3)
    rotation = rotation_from_wxyz(wxyz)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1)
    found = wxyz_from_rotation(rotation)
    assert found[0] >= 0
    assert np.linalg.norm(found) == pytest.approx(1)
    unit = np.array(wxyz) / np.linalg.norm(wxyz)
    assert abs(found @ unit) == pytest.approx(1, abs=1e-14)
    assert rotation_from_wxyz(found) == pytest.approx(rotation, abs=1e-14)


@REPEATABLE
@given(AXIS)
def test_half_turns_mirror_across_their_axis(axis: tuple[float, float, float]) -> None:
    n = np.array(axis)
    assume(np.linalg.norm(n) > 1e-3)
    n /= np.linalg.norm(n)
    assert rotation_from_wxyz([0.0, *n]) == pytest.approx(2 * np.outer(n, n) - np.eye(3), abs=1e-14)


def test_quaternions_need_no_unit_length_and_agree_with_gtsam() -> None:
    q = np.array([0.3, -0.5, 0.7, 0.2])
    native = gtsam.Rot3.Quaternion(*(q / np.linalg.norm(q))).matrix()
    for scale in (1e-6, 1.0, -40.0):
        assert rotation_from_wxyz(scale * q) == pytest.approx(native, abs=1e-14)
    pose = pose_from_wxyz(q.tolist(), [1.0, 2.0, 3.0])
    assert pose.rotation().matrix() == pytest.approx(native, abs=1e-14)
    assert pose.translation().tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    "wxyz", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1], [0, 0, 1], [1, 0, 0, 0, 0], []]
)
def test_what_is_no_quaternion_is_refused(wxyz: list[float]) -> None:
    with pytest.raises(GeometryError, match="4 finite numbers of norm above 0"):
        rotation_from_wxyz(wxyz)


def test_skew_is_the_cross_product_in_batches() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 4, 5, 3))
    assert (skew(a) @ b[..., None])[..., 0] == pytest.approx(np.cross(a, b), abs=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-160, 1e-12, 1e-7, 1e-3, 1.0, 3.0, np.pi - 1e-4])
def test_logarithm_inverts_the_exponential(angle: float) -> None:
    w = angle * np.array([[2.0, -1.0, 2.0], [0.0, 0.0, 3.0]]) / 3
    assert so3_log(so3_exp(w)) == pytest.approx(w, rel=1e-11, abs=1e-170)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.99e-4, 1.01e-4, 1e-2, 1.0, 3.0, np.pi - 1e-4])
def test_right_jacobian_inverse_is_gtsams(angle: float) -> None:
    w = angle * np.array([2.0, -1.0, 2.0]) / 3
    assert so3_right_jacobian_inverse(w) == pytest.approx(gtsam.Rot3.LogmapDerivative(w), abs=1e-9)


@pytest.mark.parametrize("angle", [1e-6, 1e-3, 0.5, np.pi - 1e-9, np.pi - 1e-13])
def test_right_jacobian_inverse_inverts_the_right_jacobian(angle: float) -> None:
    """Right Jacobian by Rodrigues' series, which has no cancellation next to half a turn."""
    axis = np.array([2.0, -1.0, 2.0]) / 3
    k = skew(axis)
    sinc, versine = np.sin(angle) / angle, 2 * np.sin(angle / 2) ** 2 / angle
    right = sinc * np.eye(3) + (1 - sinc) * np.outer(axis, axis) - versine * k
    assert so3_right_jacobian_inverse(angle * axis) @ right == pytest.approx(np.eye(3), abs=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.99e-2, 1.01e-2, 0.1, 1.0, 3.0, np.pi, 6.0])
def test_exponential_and_right_jacobian_are_gtsams(angle: float) -> None:
    w = angle * np.array([[2.0, -1.0, 2.0], [0.0, 0.0, 3.0]]) / 3
    for found, jacobian, one in zip(so3_exp(w), so3_right_jacobian(w), w, strict=True):
        assert found == pytest.approx(gtsam.Rot3.Expmap(one).matrix(), abs=1e-14)
        assert jacobian == pytest.approx(gtsam.Rot3.ExpmapDerivative(one), abs=1e-12)


def test_a_correction_of_nothing_changes_no_bit() -> None:
    rng = np.random.default_rng(3)
    pose = pose_arrays([gtsam.Pose3.Expmap(rng.normal(size=6)) for _ in range(20)])
    for held in (slice(0, 6), slice(0, 3), slice(3, 6)):
        correction = rng.normal(size=(20, 6))
        correction[:, held] = 0.0
        rotation, translation = corrected_poses(*pose, correction)
        if held.start == 0:
            assert np.array_equal(rotation, pose[0])
        if held.stop == 6:
            assert np.array_equal(translation, pose[1])


@pytest.mark.parametrize("size", [0.0, 1e-7, 0.3, 2.0])
def test_twists_of_corrections_against_differences(size: float) -> None:
    rng = np.random.default_rng(4)
    (rotation,), (translation,) = pose_arrays([gtsam.Pose3.Expmap(rng.normal(size=6))])
    correction, h = size * rng.normal(size=6), 1e-6

    def moved(step: FloatArray) -> gtsam.Pose3:
        a_R_b, a_t_b = corrected_poses(rotation, translation, correction + step)
        return gtsam.Pose3(gtsam.Rot3(a_R_b), a_t_b)

    here = moved(np.zeros(6))
    differences = [
        (here.localCoordinates(moved(h * e)) - here.localCoordinates(moved(-h * e))) / (2 * h)
        for e in np.eye(6)
    ]
    assert correction_twists(correction) == pytest.approx(np.array(differences).T, abs=1e-8)


def test_twists_in_the_parent_are_gtsams_adjoint() -> None:
    rng = np.random.default_rng(5)
    poses = [gtsam.Pose3.Expmap(rng.normal(size=6)) for _ in range(4)]
    twists = rng.normal(size=(4, 6, 2))
    for pose, given_, found in zip(poses, twists, twists_in_parent(*pose_arrays(poses), twists), strict=True):
        assert found == pytest.approx(pose.AdjointMap() @ given_, abs=1e-13)


@REPEATABLE
@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_lie_in_their_interval_and_are_the_same_directions(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle), abs=1e-11)


@pytest.mark.parametrize("angle", [np.nextafter(-np.pi, -4), -np.pi, np.pi, np.nextafter(3 * np.pi, 0)])
def test_angles_beside_half_a_turn_stay_in_the_interval(angle: float) -> None:
    assert -np.pi <= wrap_angle(angle) < np.pi


def test_composition_is_gtsams() -> None:
    rng = np.random.default_rng(2)
    a = [gtsam.Pose3.Expmap(rng.normal(size=6)) for _ in range(4)]
    b = gtsam.Pose3.Expmap(rng.normal(size=6))
    rotation, translation = compose(*pose_arrays(a), *(x[0] for x in pose_arrays([b])))
    for i in range(4):
        assert rotation[i] == pytest.approx((a[i] * b).rotation().matrix(), abs=1e-14)
        assert translation[i] == pytest.approx((a[i] * b).translation(), abs=1e-14)


def test_no_poses_are_empty_arrays() -> None:
    rotations, translations = pose_arrays([])
    assert rotations.shape == (0, 3, 3)
    assert translations.shape == (0, 3)


def test_blocks_stand_on_the_diagonal_of_a_matrix() -> None:
    blocks = [np.arange(6.0).reshape(2, 3) + 1, np.zeros((0, 1)), np.full((1, 1), 9.0)]
    np.testing.assert_array_equal(block_diagonal(blocks), scipy.linalg.block_diag(*blocks))
    assert block_diagonal([]).shape == (0, 0)
