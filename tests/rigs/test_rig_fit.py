"""Fit of a rig: exact without noise, honest with it, and the labels of a real rover."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, pose_arrays
from pancam_graph.cameras import CAHV, CAHVORE, Pinhole
from pancam_graph.factors import mast_residual
from pancam_graph.io import read_pds
from pancam_graph.io._pds_label import read_label
from pancam_graph.rigs import (
    MSL_MAST,
    RigFitOptions,
    fit_rig,
    mars2020_navcam,
    stereo_pan_tilt,
)
from pancam_graph.rigs._chain import Chain, PosedCameras
from support.parameters import slow_but_for
from support.published_cameras import MODEL_B
from support.rig_cameras import (
    ALWAYS_FREE,
    NAVCAM,
    WORLD_T_MAST,
    angles_of,
    camera_at,
    cameras_of,
    noisy,
    texts,
    turned,
    worst_unseen,
)

# --- Derivatives ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("angle", "apart", "correction"),
    [
        (2.0, 1.0, 0.5),
        (1e-7, 1e-7, 1e-7),
        (1e-4, 1e-4, 0.0),
        (0.5, 300.0, 1.0),
        (0.0, 0.0, 0.0),
        (np.pi - 0.01, 1.0, 0.0),
    ],
    ids=["random", "near identity", "at the reference", "far", "identity", "half a turn away"],
)
def test_the_misfits_derivatives_are_the_numerical_ones(
    angle: float, apart: float, correction: float
) -> None:
    """The rotation vector jumps at half a turn: near there steps must be small, and so are the digits."""
    rng = np.random.default_rng(3)
    n, eyes = 9, 2
    rotation = Rotation.random(2 + eyes, random_state=1).as_matrix()
    chain = Chain(rotation=rotation, translation_m=rng.normal(0, 1, (2 + eyes, 3)))
    eye, angles = np.arange(n) % eyes, rng.uniform(-2, 2, (n, 2))
    x = correction * rng.normal(size=(2 + eyes, 6))
    R, t = chain.corrected(x).world_T_camera(angles, eye)
    axes = rng.normal(size=(n, 3))
    turn = angle * axes / np.linalg.norm(axes, axis=1)[:, None]
    cameras = PosedCameras(
        rotation=R @ Rotation.from_rotvec(-turn).as_matrix(),
        centre_m=t + apart * rng.normal(size=(n, 3)),
        eye=eye,
        pointing=np.arange(n),
    )
    misfit, by_correction, by_angle = chain.misfit_jacobian(cameras, angles, x)
    assert misfit[:, :3] == pytest.approx(turn, abs=1e-9)
    h = 1e-6
    for pose in range(2 + eyes):
        for k in range(6):
            step = np.zeros_like(x)
            step[pose, k] = h
            high, low = (chain.corrected(x + s * step).misfit(cameras, angles) for s in (1, -1))
            assert by_correction[:, :, pose, k] == pytest.approx((high - low) / (2 * h), abs=1e-7)
    for k in range(2):
        step = h * np.eye(2)[k]
        high, low = (chain.corrected(x).misfit(cameras, angles + s * step) for s in (1, -1))
        assert by_angle[:, :, k] == pytest.approx((high - low) / (2 * h), abs=1e-7)


def test_twists_agree_with_the_mast_factor() -> None:
    """The factor works out the same chain for one camera, by itself."""
    rng = np.random.default_rng(5)
    rotations = Rotation.random(3, random_state=2).as_matrix()
    chain = Chain(rotation=rotations, translation_m=rng.normal(size=(3, 3)))
    angles, eye = rng.uniform(-1, 1, (1, 2)), np.array([0])
    by_pose, by_angle = chain.camera_twists(angles, eye)
    R, t = chain.world_T_camera(angles, eye)
    mount = chain.mounts[0][0], chain.mounts[1][0]
    residual, jacobians = mast_residual((R[0], t[0]), chain.mast, angles[0], mount, chain.axis)
    assert residual == pytest.approx(np.zeros(6), abs=1e-12)
    # Where they meet, moving the chain is moving the camera the other way.
    assert by_pose[0, 0] == pytest.approx(-jacobians[1], abs=1e-12)
    assert by_angle[0] == pytest.approx(-jacobians[2], abs=1e-12)
    assert by_pose[0, 2] == pytest.approx(-jacobians[3], abs=1e-12)


# --- Exact without noise --------------------------------------------------------------------------


@pytest.mark.parametrize("eyes", [("left",), ("left", "right")], ids=["one eye", "two eyes"])
@pytest.mark.parametrize("angles", ["exact", "offsets", "free"])
def test_a_rig_is_found_exactly_from_exact_cameras(angles: str, eyes: tuple[str, ...]) -> None:
    """Without any reference: from axes that meet, a mast anywhere and mounts anywhere."""
    pointings = angles_of(8)
    pan_tilt, names = np.repeat(pointings, len(eyes), axis=0), list(eyes) * len(pointings)
    poses = cameras_of(NAVCAM, pan_tilt, names)
    fit = fit_rig(poses, pan_tilt, eyes=names, options=RigFitOptions(angles=angles))  # type: ignore[arg-type]  # parametrised
    assert fit.converged
    assert fit.eyes == eyes
    assert max(fit.worst_m, fit.worst_rad) < 1e-10
    assert worst_unseen(fit, NAVCAM) < 1e-9
    expected = [*ALWAYS_FREE, *(["offset of pan", "offset of tilt"] if angles == "offsets" else [])]
    assert len(texts(fit)) == len(expected)
    assert all(t.startswith(e) for t, e in zip(texts(fit), expected, strict=True))
    assert fit.covariance.shape == (len(fit.names),) * 2
    assert np.linalg.matrix_rank(fit.covariance, tol=1e-16) <= len(fit.singular_values) - len(expected)
    assert "rms 0.0000 mm" in fit.report()
    assert all(text in fit.report() for text in texts(fit))


@pytest.mark.parametrize("seed", range(6))
def test_cameras_may_look_anywhere(seed: int) -> None:
    """Mounts and mast from the whole of SO(3), axes some degrees from square."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(3, random_state=seed).as_matrix()
    base = stereo_pan_tilt()
    eyes = tuple(
        replace(e, head_T_camera=gtsam.Pose3(gtsam.Rot3(R), rng.normal(0, 0.3, 3)))
        for e, R in zip(base.eyes, turns, strict=False)
    )
    axis = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 0.03, 3)), rng.normal(0, 0.05, 3))
    rig, mast = (
        replace(base, eyes=eyes, pan_T_tilt=axis),
        gtsam.Pose3(gtsam.Rot3(turns[2]), rng.normal(0, 9, 3)),
    )
    pan_tilt, names = angles_of(10, seed), ["left", "right"] * 5
    poses = cameras_of(rig, pan_tilt, names, mast)
    fit = fit_rig(poses, pan_tilt, eyes=names)
    assert fit.converged
    assert max(fit.worst_m, fit.worst_rad) < 1e-10


def test_the_axes_of_curiosity_are_found_from_its_cameras() -> None:
    """The pan axis, which leans, and the tilt axis 0.14 mm beside it, as published."""
    rover_T_mast, pan_T_tilt = MSL_MAST.chain()
    joints = np.random.default_rng(0).uniform([0.5, 0.6], [6.0, 1.7], (9, 2))
    pan_tilt = np.array([MSL_MAST.pan_tilt_rad(*j) for j in joints.tolist()])
    # Models in the rover frame, z down as in labels.
    flip = turned(np.diag([1.0, -1.0, -1.0]))
    head_model = NAVCAM.eyes[1].head_model()
    models = [head_model.transformed(flip * MSL_MAST.rover_T_head(*j)) for j in joints.tolist()]
    fit = fit_rig(models, pan_tilt, eyes=["right"] * 9)
    assert max(fit.worst_m, fit.worst_rad) < 1e-9
    found_axis = (flip * fit.world_T_mast).rotation().matrix()[:, 2]
    assert found_axis == pytest.approx(rover_T_mast.rotation().matrix()[:, 2], abs=1e-9)
    found = fit.pan_T_tilt.rotation().matrix()[:, 1]
    expected = pan_T_tilt.rotation().matrix()[:, 1]
    assert found[2] == pytest.approx(expected[2], abs=1e-9)  # how far from square
    # How far the tilt axis passes by the pan axis.
    distances = []
    for p, a in ((fit.pan_T_tilt, found), (pan_T_tilt, expected)):
        across = np.cross([0, 0, 1], a)
        distances.append(abs(float(p.translation() @ across)) / float(np.linalg.norm(across)))
    assert distances[0] == pytest.approx(distances[1], abs=1e-9)
    assert distances[1] > 1e-4
    camera = fit.cameras[0]
    assert isinstance(camera, CAHV)
    assert camera.fx_px == pytest.approx(MODEL_B.fx_px)


def test_models_come_back_as_a_rig_that_projects_as_they_do() -> None:
    rig = mars2020_navcam()
    pan_tilt, names = angles_of(8, seed=1), ["left", "right"] * 4
    models = [
        rig.eyes[rig.eye_index(name)].camera.transformed(pose)  # type: ignore[attr-defined]  # CAHVORE
        for name, pose in zip(names, cameras_of(rig, pan_tilt, names), strict=True)
    ]
    fit = fit_rig(models, pan_tilt, eyes=names)
    found = fit.rig("mine", pointing_sigma=rig.pointing_sigma)
    assert (found.name, found.pointing_sigma) == ("mine", rig.pointing_sigma)
    assert all(isinstance(e.camera, CAHVORE) for e in found.eyes)
    angles = np.array([[0.3, -0.4]])
    for i, eye in enumerate(found.eyes):
        true = rig.eyes[i].camera.transformed(cameras_of(rig, angles, [eye.name])[0])  # type: ignore[attr-defined]  # CAHVORE
        pose = camera_at(fit.world_T_mast, found.pan_T_tilt, eye.head_T_camera, angles[0].tolist())
        points = np.array([pose.transformFrom(np.array([x, 0.2, 6.0])) for x in (-2.0, 0.1, 3.0)])
        expected, valid = true.project(points)
        assert valid.all()
        again, _ = eye.camera.project(np.array([pose.transformTo(p) for p in points]))
        np.testing.assert_allclose(again, expected, atol=1e-6)


def test_poses_need_cameras_to_be_a_rig() -> None:
    pan_tilt = angles_of(4)
    fit = fit_rig(cameras_of(NAVCAM, pan_tilt, ["left"] * 4), pan_tilt, eyes=["left"] * 4)
    assert fit.cameras == (None,)
    with pytest.raises(InputError, match="eye left: expected a camera, found only its poses"):
        fit.rig()
    with pytest.raises(InputError, match="expected 1 cameras, found 2"):
        fit.rig(cameras=[NAVCAM.eyes[0].camera] * 2)
    camera = Pinhole(width_px=9, height_px=9, fx_px=9.0, fy_px=9.0, cx_px=4.0, cy_px=4.0)
    rig = fit.rig("mine", cameras=[camera])
    assert rig.eyes[0].camera is camera
    assert rig.eyes[0].head_T_camera is fit.head_T_camera[0]


# --- With noise -----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("angles", ["exact", "free"])
def test_errors_have_the_covariance_that_is_said(angles: str) -> None:
    """60 noisy sets from one truth: squared errors over the covariance, where it is not 0, and residuals.

    The reference is the truth, so that along free directions the estimate has no error to be judged.
    """
    sigma, encoder = 2e-4, 1e-3
    options = RigFitOptions(
        angles=angles,  # type: ignore[arg-type]  # parametrised
        rotation_sigma_rad=sigma,
        centre_sigma_m=sigma,
        angle_sigma_rad=encoder,
    )
    pointings = angles_of(10, seed=7)
    pan_tilt, names = np.repeat(pointings, 2, axis=0), ["left", "right"] * 10
    poses = cameras_of(NAVCAM, pan_tilt, names)
    truth = (WORLD_T_MAST, NAVCAM.pan_T_tilt, *(e.head_T_camera for e in NAVCAM.eyes))
    rng = np.random.default_rng(0)
    squared, factors, ranks = [], [], set()
    for _ in range(60):
        read = np.repeat(encoder * rng.standard_normal(pointings.shape), 2, axis=0) * (angles == "free")
        fit = fit_rig(
            noisy(poses, sigma, rng),
            pan_tilt + read,
            eyes=names,
            reference=NAVCAM,
            world_T_mast=WORLD_T_MAST,
            options=options,
        )
        assert fit.converged
        error = np.zeros(len(fit.names))
        found = (fit.world_T_mast, fit.pan_T_tilt, *fit.head_T_camera)
        error[:-2] = np.concatenate([t.localCoordinates(f) for t, f in zip(truth, found, strict=True)])
        values, vectors = np.linalg.eigh(fit.covariance)
        told = values > 1e-9 * values[-1]
        ranks.add(int(told.sum()))
        squared.append(float(np.sum((vectors[:, told].T @ error) ** 2 / values[told])))
        factors.append(fit.variance_factor)
    assert ranks == {24 - 4}
    assert abs(np.mean(squared) / 20 - 1) < 1.96 * np.sqrt(2 / (20 * len(squared)))
    spare = 6 * len(poses) - 20
    assert abs(np.mean(factors) - 1) < 2.6 * np.sqrt(2 / (spare * len(factors)))


def test_pointings_that_share_angles_share_their_errors() -> None:
    """Encoders that read wrong move both eyes of a pointing alike: then the mounts to each other are safe."""
    pointings = angles_of(8, seed=3)
    wrong = pointings + 2e-3 * np.random.default_rng(1).standard_normal(pointings.shape)
    names = ["left", "right"] * 8
    poses = cameras_of(NAVCAM, np.repeat(pointings, 2, axis=0), names)
    fit = fit_rig(
        poses,
        np.repeat(wrong, 2, axis=0),
        eyes=names,
        options=RigFitOptions(angles="free", angle_sigma_rad=2e-3),
    )
    assert max(fit.worst_m, fit.worst_rad) < 1e-5
    left_T_right = fit.head_T_camera[0].between(fit.head_T_camera[1])
    true = NAVCAM.eyes[0].head_T_camera.between(NAVCAM.eyes[1].head_T_camera)
    assert np.abs(true.localCoordinates(left_T_right)).max() < 1e-5
    exact = fit_rig(poses, np.repeat(wrong, 2, axis=0), eyes=names)
    assert exact.worst_rad > 1e-3
    assert exact.variance_factor > 100


# --- Opportunity ----------------------------------------------------------------------------------


@pytest.mark.parametrize("source", slow_but_for("encoders", ["encoders", "quaternions"]))
def test_opportunitys_labels_follow_the_chain(source: str, opportunity_folder: Path) -> None:
    """Five labels, their own angles, no reference: 0.1 mm and 0.05 mrad were asked for.

    The encoders' zero points (0.267 and 3.59 degrees) are taken up by the mast's yaw and by the mounts.
    """
    pds = read_pds(opportunity_folder)
    labels = [read_label(opportunity_folder / str(image.file)) for image in pds.images]
    models = []
    for label in labels:
        group = label.group("GEOMETRIC_CAMERA_MODEL")
        c, a, h, v = (group.numbers(f"MODEL_COMPONENT_{k}", 3) for k in range(1, 5))
        models.append(CAHV(width_px=1024, height_px=1024, C=c, A=a, H=h, V=v))
    if source == "encoders":
        measured = [label.group("PMA_ARTICULATION_STATE").angles_rad() for label in labels]
        angles = np.array([[-m["AZIMUTH-MEASURED"], m["ELEVATION-MEASURED"]] for m in measured])
    else:
        angles = pds.pan_tilt_rad
    fit = fit_rig(models, angles, eyes=["navcam-left"] * 5)
    assert fit.converged
    assert fit.worst_m < 5e-6
    assert fit.worst_rad < 5e-6
    assert fit.variance_factor < 0.1  # the labels' digits are finer than the sigma of 1e-5
    assert [t.split(":")[0].split(",")[0] for t in texts(fit)] == list(ALWAYS_FREE)
    # The pan axis is where each label has the pivot of the mast; the axes meet.
    pivot = labels[0].group("PMA_COORDINATE_SYSTEM").numbers("ORIGIN_OFFSET_VECTOR", 3)
    np.testing.assert_allclose(fit.world_T_mast.translation()[:2], pivot[:2], atol=2e-5)
    assert fit.world_T_mast.rotation().matrix()[:, 2] == pytest.approx([0, 0, -1], abs=2e-5)
    assert np.abs(fit.pan_T_tilt.translation()[[0, 2]]).max() < 2e-5


def test_angles_that_count_the_other_way_stand_the_mast_on_its_head() -> None:
    """An encoder's clockwise azimuth given as it is: the cameras fit, and only the mast's z shows it."""
    pan_tilt = angles_of(8)
    poses = cameras_of(NAVCAM, pan_tilt, ["left"] * 8)
    up = WORLD_T_MAST.rotation().matrix()[:, 2]
    for sign in (1, -1):
        fit = fit_rig(poses, pan_tilt * [sign, 1])
        assert max(fit.worst_m, fit.worst_rad) < 1e-9
        assert fit.world_T_mast.rotation().matrix()[:, 2] == pytest.approx(sign * up, abs=1e-9)


def test_angles_of_other_cameras_do_not_fit_and_say_so() -> None:
    pan_tilt = angles_of(8)
    fit = fit_rig(cameras_of(NAVCAM, pan_tilt, ["left"] * 8), pan_tilt[::-1])
    assert fit.worst_rad > 0.1
    assert fit.variance_factor > 1e4


def test_the_head_of_a_fit_is_the_package_s_own() -> None:
    """A camera that looks forwards at pan and tilt 0 gets a mount that looks forwards."""
    pan_tilt = angles_of(6)
    rig = stereo_pan_tilt(toe_in_rad=0.0)
    fit = fit_rig(cameras_of(rig, pan_tilt, ["left"] * 6), pan_tilt, eyes=["left"] * 6)
    rotations, _ = pose_arrays(fit.head_T_camera)
    assert rotations[0] == pytest.approx(HEAD_R_FORWARD_CAMERA, abs=0.05)
