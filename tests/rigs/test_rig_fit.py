"""Fit of a rig: exact without noise, honest with it, and clear about what cameras cannot tell."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray, pose_arrays, ry, rz
from pancam_graph.cameras import CAHV, CAHVORE, Pinhole
from pancam_graph.factors import mast_residual
from pancam_graph.io import read_pds
from pancam_graph.io._pds_label import read_label
from pancam_graph.rigs import (
    MSL_MAST,
    ReferenceSigma,
    Rig,
    RigFit,
    RigFitOptions,
    fit_rig,
    mars2020_navcam,
    msl_navcam,
    stereo_pan_tilt,
)
from pancam_graph.rigs._chain import Chain, PosedCameras
from support.published_cameras import MODEL_B

NAVCAM = msl_navcam()
"""A tilt axis that is neither square to the pan axis nor meets it."""
WORLD_T_MAST = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.02, -0.03, 1.1])), np.array([0.8, -0.5, 1.9]))


def turned(angle_rotation: FloatArray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3(angle_rotation), np.zeros(3))


def camera_at(
    world_T_mast: gtsam.Pose3,
    pan_T_tilt: gtsam.Pose3,
    head_T_camera: gtsam.Pose3,
    angles: Sequence[float],
) -> gtsam.Pose3:
    """The chain written out with gtsam's poses, apart from the package's own."""
    pan, tilt = angles
    return world_T_mast * turned(rz(pan)) * pan_T_tilt * turned(ry(-tilt)) * head_T_camera


def cameras_of(
    rig: Rig, angles: FloatArray, eyes: Sequence[str], world_T_mast: gtsam.Pose3 = WORLD_T_MAST
) -> list[gtsam.Pose3]:
    mounts = [rig.eyes[rig.eye_index(e)].head_T_camera for e in eyes]
    return [
        camera_at(world_T_mast, rig.pan_T_tilt, m, a) for m, a in zip(mounts, angles.tolist(), strict=True)
    ]


def angles_of(n: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform([-2.5, -0.9], [2.5, 0.6], (n, 2))


def worst_unseen(fit: RigFit, rig: Rig) -> float:
    """Largest miss, metres or radians, of the fit at pointings that it was not made from."""
    worst = 0.0
    for angles in angles_of(7, seed=99):
        for eye, mount in zip(fit.eyes, fit.head_T_camera, strict=True):
            found = camera_at(
                fit.world_T_mast, fit.pan_T_tilt, mount, (angles + fit.angle_offset_rad).tolist()
            )
            (true,) = cameras_of(rig, angles[None], [eye])
            worst = max(worst, float(np.abs(true.localCoordinates(found)).max()))
    return worst


def noisy(poses: Sequence[gtsam.Pose3], sigma: float, rng: np.random.Generator) -> list[gtsam.Pose3]:
    """Rotation disturbed in the camera's frame, centre in the world's, independently."""
    return [
        gtsam.Pose3(
            p.rotation() * gtsam.Rot3.Expmap(sigma * rng.standard_normal(3)),
            p.translation() + sigma * rng.standard_normal(3),
        )
        for p in poses
    ]


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

ALWAYS_FREE = ("zero point of pan", "height", "zero point of tilt", "place along the tilt axis")


def texts(fit: RigFit) -> list[str]:
    return [d.text for d in fit.free_directions]


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


# --- What cameras leave open ----------------------------------------------------------------------

PAN, TILT = (
    ("direction of the pan axis", "place of the pan axis"),
    ("direction of the tilt axis", "place of the tilt axis"),
)


@pytest.mark.parametrize(
    ("angles", "eyes", "named"),
    [
        ([(p, -0.2) for p, _ in angles_of(6)], ["left", "right"] * 3, {*ALWAYS_FREE, *TILT}),
        ([(p, -0.2 + 1e-7 * t) for p, t in angles_of(6)], ["left", "right"] * 3, {*ALWAYS_FREE, *TILT}),
        ([(0.4, t) for _, t in angles_of(6)], ["left", "right"] * 3, {*ALWAYS_FREE, *PAN}),
        ([(0.4, -0.3)] * 2, ["left", "right"], {*ALWAYS_FREE, *PAN, *TILT}),
        ([(0.4, -0.3)] * 5, ["left"] * 5, {*ALWAYS_FREE, *PAN, *TILT}),
        ([(0.4, -0.3), (-1.0, 0.2)], ["left"] * 2, {*ALWAYS_FREE, "a combination"}),
    ],
    ids=["one tilt", "hardly two tilts", "one pan", "one pointing", "all equal", "two cameras"],
)
def test_degenerate_sets_are_fitted_and_named(
    angles: list[tuple[float, float]], eyes: list[str], named: set[str]
) -> None:
    pan_tilt = np.array(angles)
    fit = fit_rig(cameras_of(NAVCAM, pan_tilt, eyes), pan_tilt, eyes=eyes)
    assert fit.converged
    assert max(fit.worst_m, fit.worst_rad) < 1e-9
    starts = {t.split(":")[0].split(",")[0] for t in texts(fit)}
    assert starts == named
    assert len(fit.free_directions) == np.sum(fit.singular_values < 1)
    for name in (*PAN, *TILT):  # about x and y, along x and y
        assert sum(t.startswith(name) for t in texts(fit)) == (2 if name in named else 0)
    steps = np.array([d.step for d in fit.free_directions])
    assert np.linalg.matrix_rank(steps / np.linalg.norm(steps, axis=1)[:, None]) == len(steps)
    assert np.isfinite(fit.covariance).all()


def moved(fit: RigFit, step: FloatArray) -> list[gtsam.Pose3]:
    """The fitted cameras with every pose turned and shifted in its own frame, by a small step."""
    poses = [fit.world_T_mast, fit.pan_T_tilt, *fit.head_T_camera]
    changed = [
        p * gtsam.Pose3(gtsam.Rot3.Expmap(s[:3]), s[3:])
        for p, s in zip(poses, step[:-2].reshape(-1, 6), strict=True)
    ]
    return [
        camera_at(changed[0], changed[1], changed[2 + i % len(fit.eyes)], (a + step[-2:]).tolist())
        for i, a in enumerate(fit.pan_tilt_rad)
    ]


@pytest.mark.parametrize("case", ["rich", "one tilt", "two cameras", "one pointing"])
def test_along_a_free_direction_no_camera_moves(case: str) -> None:
    """And the number of free directions is what a numerical Jacobian has, apart from the package's."""
    pan_tilt = angles_of({"rich": 8, "two cameras": 2}.get(case, 4), seed=2)
    if case == "one tilt":
        pan_tilt[:, 1] = -0.3
    if case == "one pointing":
        pan_tilt[:] = (0.3, -0.4)
    names = ["left", "right"] * (len(pan_tilt) // 2)
    fit = fit_rig(
        cameras_of(NAVCAM, pan_tilt, names),
        pan_tilt,
        eyes=names,
        reference=NAVCAM,
        world_T_mast=WORLD_T_MAST,
        options=RigFitOptions(angles="offsets"),
    )
    before = moved(fit, np.zeros(len(fit.names)))

    def change(step: FloatArray) -> FloatArray:
        h = 1e-5
        pairs = zip(moved(fit, h * step), moved(fit, -h * step), strict=True)
        ends = [
            (b.localCoordinates(high), b.localCoordinates(low))
            for b, (high, low) in zip(before, pairs, strict=True)
        ]
        return np.concatenate([(high - low) / (2 * h) for high, low in ends])

    for direction in fit.free_directions:
        assert np.abs(direction.step).max() > 1e-4
        assert np.abs(change(direction.step)).max() < 1e-8
    jacobian = np.column_stack([change(e) for e in np.eye(len(fit.names))])
    rank = np.linalg.matrix_rank(jacobian, tol=1e-6)
    assert len(fit.free_directions) == len(fit.names) - rank


@pytest.mark.parametrize("case", ["rich", "one tilt", "one pan", "two cameras"])
def test_what_is_free_stays_as_near_to_the_reference_as_can_be(case: str) -> None:
    """Consistent references are kept to the last digit; others are left across the free directions only."""
    pan_tilt = angles_of(2 if case == "two cameras" else 8, seed=4)
    if case == "one tilt":
        pan_tilt[:, 1] = -0.3
    if case == "one pan":
        pan_tilt[:, 0] = 0.7
    names = ["left", "right"] * (len(pan_tilt) // 2)
    poses = cameras_of(NAVCAM, pan_tilt, names)
    kept = fit_rig(poses, pan_tilt, eyes=names, reference=NAVCAM, world_T_mast=WORLD_T_MAST)
    for found, true in zip(
        (kept.world_T_mast, kept.pan_T_tilt, *kept.head_T_camera),
        (WORLD_T_MAST, NAVCAM.pan_T_tilt, *(e.head_T_camera for e in NAVCAM.eyes)),
        strict=True,
    ):
        assert np.abs(true.localCoordinates(found)).max() < 1e-10
    rng = np.random.default_rng(0)
    off = [gtsam.Pose3.Expmap(3e-3 * rng.normal(size=6)) for _ in range(4)]
    eyes = tuple(
        replace(e, head_T_camera=e.head_T_camera * d) for e, d in zip(NAVCAM.eyes, off[2:], strict=True)
    )
    reference = replace(NAVCAM, pan_T_tilt=NAVCAM.pan_T_tilt * off[0], eyes=eyes)
    mast = WORLD_T_MAST * off[1]
    fit = fit_rig(poses, pan_tilt, eyes=names, reference=reference, world_T_mast=mast)
    assert max(fit.worst_m, fit.worst_rad) < 1e-9
    away = []
    for found, given in zip(
        (fit.world_T_mast, fit.pan_T_tilt, *fit.head_T_camera),
        (mast, reference.pan_T_tilt, *(e.head_T_camera for e in eyes)),
        strict=True,
    ):
        between = given.between(found)
        away += [*gtsam.Rot3.Logmap(between.rotation()), *between.translation()]
    s = ReferenceSigma()
    units = [(s.mast_rad, s.mast_m), (s.axis_rad, s.axis_m), *[(s.mount_rad, s.mount_m)] * 2]
    sigma = np.repeat(np.array(units), 3, axis=1).ravel()
    in_units = np.array(away) / sigma
    assert np.linalg.norm(in_units) > 0.1
    for direction in fit.free_directions:
        assert abs(in_units @ (direction.step[:-2] / sigma)) < 1e-7 * np.linalg.norm(in_units)


def test_a_chain_that_is_held_is_only_compared() -> None:
    nothing = ReferenceSigma(mast_rad=0, mast_m=0, axis_rad=0, axis_m=0, mount_rad=0, mount_m=0)
    pan_tilt, names = angles_of(4), ["left", "right"] * 2
    poses = cameras_of(NAVCAM, pan_tilt, names)
    poses[1] = poses[1] * gtsam.Pose3(gtsam.Rot3.Rx(2e-3), np.array([3e-3, 0, 0]))
    fit = fit_rig(
        poses,
        pan_tilt,
        eyes=names,
        reference=NAVCAM,
        world_T_mast=WORLD_T_MAST,
        options=RigFitOptions(reference_sigma=nothing),
    )
    assert fit.converged
    assert (fit.worst_m, fit.worst_rad) == pytest.approx((3e-3, 2e-3))
    assert (fit.rms_m, fit.rms_rad) == pytest.approx((1.5e-3, 1e-3))
    assert "worst 3.0000 mm (camera 1)" in fit.report()
    assert "directions that the cameras do not tell: 0 of 0" in fit.report()


def test_a_mast_that_is_held_stays_where_it_is() -> None:
    """Only mounts are sought: one camera is enough, and nothing is free."""
    held = RigFitOptions(reference_sigma=ReferenceSigma(mast_rad=0, mast_m=0, axis_rad=0, axis_m=0))
    pan_tilt = np.array([[0.3, -0.2]])
    (pose,) = cameras_of(NAVCAM, pan_tilt, ["left"])
    fit = fit_rig([pose], pan_tilt, world_T_mast=WORLD_T_MAST, pan_T_tilt=NAVCAM.pan_T_tilt, options=held)
    assert fit.free_directions == ()
    assert fit.world_T_mast.equals(WORLD_T_MAST, 1e-15)
    assert fit.head_T_camera[0].equals(NAVCAM.eyes[0].head_T_camera, 1e-12)
    assert fit.covariance[:12].tolist() == np.zeros((12, len(fit.names))).tolist()


# --- With noise -----------------------------------------------------------------------------------


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


@pytest.mark.parametrize("source", ["encoders", "quaternions"])
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


# --- Bad input ------------------------------------------------------------------------------------

POSES = cameras_of(NAVCAM, angles_of(4), ["left"] * 4)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"cameras": []}, "cameras: expected 2 or more, found 0"),
        ({"cameras": POSES[:1], "pan_tilt_rad": np.zeros((1, 2))}, "cameras: expected 2 or more, found 1"),
        ({"pan_tilt_rad": np.zeros((3, 2))}, r"pan_tilt_rad: expected shape \(4, 2\), found \(3, 2\)"),
        ({"pan_tilt_rad": np.zeros((2, 4))}, r"pan_tilt_rad: expected shape \(4, 2\), found \(2, 4\)"),
        (
            {"pan_tilt_rad": np.full((4, 2), np.nan)},
            r"pan_tilt_rad, row 0: expected finite angles, found \[nan, nan\]",
        ),
        ({"eyes": ["left"] * 3}, "eyes: expected 4 names, one per camera, found 3"),
        ({"pointings": [0]}, "pointings: expected 4 numbers, one per camera, found 1"),
        ({"eyes": ["up"] * 4, "reference": NAVCAM}, "camera 'up': the rig msl-navcam has left, right"),
        (
            {"reference": NAVCAM, "pan_T_tilt": gtsam.Pose3(), "eyes": ["left"] * 4},
            "pan_T_tilt: expected none beside a reference rig, which has one; found one",
        ),
        (
            {"cameras": [*POSES[:3], gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0, 0]))]},
            r"cameras\[3\]: expected a pose of finite numbers, found .*nan",
        ),
        (
            {"cameras": [*POSES[:3], gtsam.Pose3(gtsam.Rot3(), np.array([1e300, 0, 0]))]},
            r"cameras\[3\]: expected a pose of finite numbers, found .*1e\+300",
        ),
        (
            {"cameras": [*POSES[:3], MODEL_B]},
            r"cameras\[3\]: expected a pose like the others of eye camera, found a CAHVOR of 1024 x 1024",
        ),
        (
            {"cameras": [MODEL_B, MODEL_B, replace(MODEL_B, width_px=512), MODEL_B]},
            r"cameras\[2\]: expected a CAHVOR of 1024 x 1024 like the others of eye camera, found .* 512 x",
        ),
    ],
)
def test_what_cannot_be_fitted_is_said_in_one_sentence(arguments: dict[str, object], sentence: str) -> None:
    given: dict[str, object] = {"cameras": POSES, "pan_tilt_rad": np.zeros((len(POSES), 2))}
    given |= arguments
    if given["cameras"] == []:
        given["pan_tilt_rad"] = np.zeros((0, 2))
    with pytest.raises(InputError, match=sentence) as caught:
        fit_rig(**given)  # type: ignore[arg-type]  # what a type checker would refuse too
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: RigFitOptions(angles="about right"),  # type: ignore[arg-type]  # the mistake under test
            "angles: expected exact, offsets or free; found 'about",
        ),
        (lambda: RigFitOptions(centre_sigma_m=0.0), "centre_sigma_m: expected a number above 0, found 0.0"),
        (lambda: RigFitOptions(angle_sigma_rad=float("nan")), "angle_sigma_rad: expected a number above 0"),
        (
            lambda: RigFitOptions(reference_sigma=ReferenceSigma(axis_m=-1.0)),
            r"reference_sigma: axis_m: expected 0 \(held\) or above, found -1.0",
        ),
    ],
)
def test_options_of_nonsense_are_refused(make: Callable[[], RigFitOptions], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make()


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
