"""Fit of a rig: directions that cameras leave open are named, free of cost, and near the reference."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pancam_graph.base.geometry import FloatArray
from pancam_graph.rigs import (
    ReferenceSigma,
    RigFit,
    RigFitOptions,
    fit_rig,
)
from support.rig_cameras import ALWAYS_FREE, NAVCAM, WORLD_T_MAST, angles_of, camera_at, cameras_of, texts

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
