"""Custom factors: values against independent formulas, Jacobians against differences."""

from collections.abc import Callable
from itertools import product
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph.base.geometry import FloatArray, pose_arrays
from pancam_graph.factors import (
    CircleOffset,
    Corrected,
    Fixed,
    Key,
    circle_factor,
    circle_residual,
    conditional_prior_factor,
    joint_prior_factor,
    mast_factor,
)
from pancam_graph.rigs import Eye, Rig, exomars_pancam
from support.parameters import slow_but_for

UNIT3, UNIT6 = gtsam.noiseModel.Unit.Create(3), gtsam.noiseModel.Unit.Create(6)
X, M, A, E, R, T, F = (gtsam.symbol(c, 0) for c in "XMAERTF")
PAN_T_TILT = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.02, -0.01, 0.03), np.array([0.03, -0.02, 0.05]))


def random_pose(rng: np.random.Generator, angle: float, length: float) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, angle, 3)), rng.normal(0, length, 3))


def mast_values(rng: np.random.Generator, angle: float, length: float) -> gtsam.Values:
    """A mast anywhere, and a camera off the chain by a pose of the given size."""
    values = gtsam.Values()
    mast, mount = random_pose(rng, 1.0, 50.0), random_pose(rng, 1.0, 0.3)
    pan, tilt = rng.uniform(-np.pi, np.pi), rng.uniform(-1.5, 1.5)
    camera = mast * chain(pan, tilt) * mount * random_pose(rng, angle, length)
    for key, value in ((X, camera), (M, mast), (A, np.array([pan, tilt])), (E, mount)):
        values.insert(key, value)
    return values


def chain(pan: float, tilt: float) -> gtsam.Pose3:
    zero = np.zeros(3)
    return gtsam.Pose3(gtsam.Rot3.Rz(pan), zero) * PAN_T_TILT * gtsam.Pose3(gtsam.Rot3.Ry(-tilt), zero)


def check_jacobians(
    factor: gtsam.CustomFactor,
    values: gtsam.Values,
    *,
    tolerance: float = 2e-7,
    vectors: tuple[int, ...] = (),
) -> None:
    """Analytic Jacobians against central differences of the factor's own error."""
    gaussian = factor.linearize(values)
    jacobian = gaussian.jacobian()[0]
    column = 0
    for key in factor.keys():  # noqa: SIM118  a gtsam factor, not a dictionary
        dim = 1 if key == R else 6
        if key == A or key in vectors:
            dim = len(values.atVector(key))
        for i in range(dim):
            errors = []
            for h in (1e-6, -1e-6):
                delta = gtsam.VectorValues()
                delta.insert(key, np.eye(dim)[i] * h)
                errors.append(factor.unwhitenedError(values.retract(delta)))
            numeric = (errors[0] - errors[1]) / 2e-6
            size = max(1, np.abs(numeric).max())
            assert jacobian[:, column] == pytest.approx(numeric, abs=tolerance * size)
            column += 1


SIZES = (0.0, 1e-7, 0.1, 1.0)
"""Of corrections of the rig, radians and metres."""

STATES: list[tuple[str, float, float]] = [
    ("random", 0.5, 1.0),
    ("near identity", 1e-7, 1e-7),
    ("on the chain", 0.0, 0.0),
    ("far", 1.0, 1e3),
]


@pytest.mark.parametrize(("name", "angle", "length"), STATES, ids=[s[0] for s in STATES])
def test_mast_jacobians(name: str, angle: float, length: float) -> None:
    rng = np.random.default_rng(len(name))
    for _ in range(5):
        values = mast_values(rng, angle, length)
        values.insert(T, PAN_T_TILT)
        factor = mast_factor(UNIT6, Key(X), Key(M), Key(A), Key(E), Key(T))
        check_jacobians(factor, values, tolerance=1e-6)


@pytest.mark.parametrize(
    ("free", "size"),
    slow_but_for(
        [*((tuple(range(6)), size) for size in SIZES), ((1,), 0.1), ((0, 2, 5), 1.0), ((3, 4), 1e-7)],
        product([tuple(range(6)), (1,), (0, 2, 5), (3, 4)], SIZES),
    ),
)
def test_mast_jacobians_by_corrections(free: tuple[int, ...], size: float) -> None:
    """Of mount and tilt axis, of their free entries alone, at and away from the rig's own poses."""
    rng = np.random.default_rng(len(free))
    values = mast_values(rng, 0.1, 0.1)
    mount = values.atPose3(E)
    values.erase(E)
    values.insert(E, size * rng.normal(size=len(free)))
    values.insert(T, size * rng.normal(size=len(free)))
    slots = Corrected(E, mount, free), Corrected(T, PAN_T_TILT, free)
    factor = mast_factor(UNIT6, Key(X), Key(M), Key(A), *slots)
    check_jacobians(factor, values, tolerance=1e-6, vectors=(E, T))
    assert list(factor.keys()) == [X, M, A, E, T]
    known = gtsam.Values()
    for key, slot in zip((E, T), slots, strict=True):
        known.insert(key, slot.pose(values)[0])
    for key in (X, M):
        known.insert(key, values.atPose3(key))
    known.insert(A, values.atVector(A))
    same = mast_factor(UNIT6, Key(X), Key(M), Key(A), Key(E), Key(T))
    assert factor.unwhitenedError(values) == pytest.approx(same.unwhitenedError(known), abs=1e-14)


@pytest.mark.parametrize(
    ("free", "size"),
    slow_but_for(
        [*(((0, 3, 4, 5), size) for size in SIZES), ((0,), 1.0), (tuple(range(6)), 0.1)],
        product([(0,), (0, 3, 4, 5), tuple(range(6))], SIZES),
    ),
)
def test_mast_jacobians_by_a_head_that_flexes(free: tuple[int, ...], size: float) -> None:
    """The head's turn and shift stand between the tilt joint and the mount."""
    rng = np.random.default_rng(len(free))
    values = mast_values(rng, 0.1, 0.1)
    values.insert(F, size * rng.normal(size=len(free)))
    head = Corrected(F, gtsam.Pose3(), free)
    slots = Key(X), Key(M), Key(A), Key(E), Fixed(PAN_T_TILT)
    factor = mast_factor(UNIT6, *slots, head)
    check_jacobians(factor, values, tolerance=1e-6, vectors=(F,))
    assert list(factor.keys()) == [X, M, A, E, F]
    moved = gtsam.Values(values)
    moved.update(E, head.pose(values)[0] * values.atPose3(E))
    rigid = mast_factor(UNIT6, *slots)
    assert factor.unwhitenedError(values) == pytest.approx(rigid.unwhitenedError(moved), abs=1e-13)


def test_mast_residual_is_zero_on_the_chain_and_the_offset_beside_it() -> None:
    rng = np.random.default_rng(0)
    values = mast_values(rng, 0.0, 0.0)
    factor = mast_factor(UNIT6, Key(X), Key(M), Key(A), Key(E), Fixed(PAN_T_TILT))
    assert factor.unwhitenedError(values) == pytest.approx(np.zeros(6), abs=1e-12)
    offset = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.1, -0.2, 0.05])), np.array([1.0, 2.0, 3.0]))
    values.update(X, values.atPose3(X) * offset)
    assert factor.unwhitenedError(values) == pytest.approx([0.1, -0.2, 0.05, 1, 2, 3], abs=1e-12)


def test_mast_factor_agrees_with_the_native_between_factor() -> None:
    """With angles and mount fixed, the tie is a between factor; small residuals agree to second order."""
    rng = np.random.default_rng(3)
    values = mast_values(rng, 1e-5, 1e-5)
    pan_tilt, mount = values.atVector(A), values.atPose3(E)
    ours = mast_factor(UNIT6, Key(X), Key(M), Fixed(pan_tilt), Fixed(mount), Fixed(PAN_T_TILT))
    native = gtsam.BetweenFactorPose3(M, X, chain(*pan_tilt) * mount, UNIT6)
    assert list(ours.keys()) == [X, M]
    assert ours.error(values) == pytest.approx(native.error(values), rel=1e-4)


def test_rig_chain_agrees_with_the_factor() -> None:
    rng = np.random.default_rng(5)
    base = exomars_pancam()
    eyes = tuple(
        Eye(name=e.name, camera=e.camera, head_T_camera=e.head_T_camera * random_pose(rng, 0.1, 0.1))
        for e in base.eyes
    )
    rig = Rig(name="bent", pan_T_tilt=PAN_T_TILT, eyes=eyes)
    pan_tilt = rng.uniform(-1.5, 1.5, (6, 2))
    eye = np.array([0, 1, 2, 0, 1, 2])
    rotations, centres = rig.mast_T_camera(pan_tilt, eye)
    for i in range(6):
        values = gtsam.Values()
        values.insert(X, gtsam.Pose3(gtsam.Rot3(rotations[i]), centres[i]))
        mount = eyes[eye[i]].head_T_camera
        factor = mast_factor(
            UNIT6, Key(X), Fixed(gtsam.Pose3()), Fixed(pan_tilt[i]), Fixed(mount), Fixed(PAN_T_TILT)
        )
        assert factor.unwhitenedError(values) == pytest.approx(np.zeros(6), abs=1e-12)
        # and the eye's circle passes through its centre (thesis eq. 4.8)
        radius, phase, height = rig.circle(int(eye[i]), float(pan_tilt[i, 1]))
        residual, _ = circle_residual(
            (rotations[i], centres[i]),
            (np.eye(3), np.zeros(3)),
            radius,
            float(pan_tilt[i, 0]),
            CircleOffset(height_m=height, phase_rad=phase),
        )
        assert residual == pytest.approx(np.zeros(3), abs=1e-12)


@pytest.mark.parametrize(("name", "angle", "length"), STATES, ids=[s[0] for s in STATES])
def test_circle_jacobians(name: str, angle: float, length: float) -> None:
    rng = np.random.default_rng(len(name))
    offset = CircleOffset(height_m=0.06, phase_rad=0.4, radius_m=0.002)
    for _ in range(5):
        values = mast_values(rng, angle, length)
        values.insert(R, 0.15)
        check_jacobians(circle_factor(UNIT3, Key(X), Key(M), Key(R), Key(A), offset), values, tolerance=1e-6)


def test_circle_factor_matches_the_thesis_formula() -> None:
    """Thesis eq. 4.8 written out, on a circle in general position."""
    rng = np.random.default_rng(1)
    circle, camera = random_pose(rng, 1, 5), random_pose(rng, 1, 5)
    rho, phi = 0.3, 1.1
    rotation, centre = pose_arrays([circle])
    on_circle: FloatArray = rotation[0] @ np.array([rho * np.cos(phi), rho * np.sin(phi), 0]) + centre[0]
    residual, _ = circle_residual(
        (camera.rotation().matrix(), camera.translation()), (rotation[0], centre[0]), rho, phi, CircleOffset()
    )
    assert rotation[0] @ residual == pytest.approx(camera.translation() - on_circle, abs=1e-12)


@pytest.mark.parametrize("free", [(), (0, 1, 2, 3, 4, 5), (1, 4)])
def test_one_factor_of_several_images_is_the_factors_of_each(free: tuple[int, ...]) -> None:
    """Masts and mounts shared in part, one correction for eyes with mounts of their own, a pose held."""
    rng = np.random.default_rng(len(free))
    one = [mast_values(rng, 0.1, 0.1) for _ in range(4)]
    values = gtsam.Values()
    cameras, angles = ([int(gtsam.symbol(c, i)) for i in range(4)] for c in "XA")
    masts = [int(gtsam.symbol("M", i)) for i in range(2)]
    for i in range(4):
        values.insert(cameras[i], one[i].atPose3(X))
        values.insert(angles[i], one[i].atVector(A))
    for i in range(2):
        values.insert(masts[i], one[i].atPose3(M))
    mounts = [v.atPose3(E) for v in one]
    if free:
        values.insert(E, 0.1 * rng.normal(size=len(free)))
    slots = [
        (
            Fixed(one[i].atPose3(X)) if i == 3 else Key(cameras[i]),
            Key(masts[i // 2]),
            Key(angles[i]),
            Corrected(E, mounts[i // 2], free) if free else Fixed(mounts[i // 2]),
            Fixed(PAN_T_TILT),
        )
        for i in range(4)
    ]
    offset = CircleOffset(
        height_m=rng.normal(size=4), phase_rad=rng.normal(size=4), radius_m=rng.normal(size=4)
    )
    unit = gtsam.noiseModel.Unit.Create
    mast = mast_factor(unit(24), *map(list, zip(*slots, strict=True)))
    circle_slots = [(*s[:2], Fixed(0.15), s[2]) for s in slots]
    circle_arguments: list[Any] = [*map(list, zip(*circle_slots, strict=True)), offset]
    circle = circle_factor(unit(12), *circle_arguments)
    for together, apart in (
        (mast, [mast_factor(UNIT6, *s) for s in slots]),
        (
            circle,
            [
                circle_factor(
                    UNIT3,
                    *s,
                    CircleOffset(
                        height_m=offset.height_m[i],  # type: ignore[index]  # arrays here
                        phase_rad=offset.phase_rad[i],  # type: ignore[index]
                        radius_m=offset.radius_m[i],  # type: ignore[index]
                    ),
                )
                for i, s in enumerate(circle_slots)
            ],
        ),
    ):
        found = np.concatenate([f.unwhitenedError(values) for f in apart])
        assert together.unwhitenedError(values) == pytest.approx(found, abs=1e-14)
        graph, parts = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        graph.push_back(together)
        for f in apart:
            parts.push_back(f)
        jacobian, right = graph.linearize(values).jacobian()
        expected, expected_right = parts.linearize(values).jacobian()
        assert jacobian == pytest.approx(expected, abs=1e-13)
        assert right == pytest.approx(expected_right, abs=1e-13)


def test_an_exception_in_a_factor_reaches_the_caller() -> None:
    values = gtsam.Values()
    values.insert(X, gtsam.Pose3())
    factor = mast_factor(
        UNIT6, Key(X), Fixed(gtsam.Pose3()), Fixed(np.zeros(0)), Fixed(gtsam.Pose3()), Fixed(PAN_T_TILT)
    )
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    call: Callable[[gtsam.Values], float] = graph.error
    with pytest.raises(IndexError, match="out of bounds"):
        call(values)


def test_conditional_priors_one_after_the_other_are_the_joint_one() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 4)) + 2 * np.eye(4)
    rows = np.linalg.inv(np.linalg.cholesky(root @ root.T))
    values = gtsam.Values()
    values.insert(A, rng.normal(size=2))
    values.insert(A + 1, rng.normal(size=2))
    parts = [
        conditional_prior_factor(rows[:2, :2], [Key(A)]),
        conditional_prior_factor(rows[2:], [Key(A), Key(A + 1)]),
    ]
    whole = np.concatenate([values.atVector(A), values.atVector(A + 1)])
    expected = 0.5 * whole @ np.linalg.inv(root @ root.T) @ whole
    assert sum(factor.error(values) for factor in parts) == pytest.approx(expected, rel=1e-12)
    for factor in parts:
        check_jacobians(factor, values, vectors=(A, A + 1))


def test_joint_prior_of_independent_vectors_is_a_prior_of_each() -> None:
    rng = np.random.default_rng(8)
    keys, sigmas, measured = [A, A + 1, A + 2], rng.uniform(0.1, 2.0, 6), rng.standard_normal(6)
    values, apart = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for i, key in enumerate(keys):
        values.insert(key, rng.standard_normal(2))
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas[2 * i : 2 * i + 2])
        apart.push_back(gtsam.PriorFactorVector(key, measured[2 * i : 2 * i + 2], noise))
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    joint = joint_prior_factor(noise, [Key(key) for key in keys], measured)
    assert joint.error(values) == pytest.approx(apart.error(values), rel=1e-12)
    unit = joint_prior_factor(gtsam.noiseModel.Unit.Create(6), [Key(key) for key in keys], measured)
    check_jacobians(unit, values, vectors=(A, A + 1, A + 2))


def test_joint_prior_costs_what_its_covariance_says() -> None:
    rng = np.random.default_rng(9)
    root, measured, values = rng.standard_normal((4, 4)), rng.standard_normal(4), gtsam.Values()
    vectors = rng.standard_normal((2, 2))
    for i in (0, 1):
        values.insert(A + i, vectors[i])
    noise = gtsam.noiseModel.Gaussian.Covariance(root @ root.T)
    error = vectors.ravel() - measured
    joint = joint_prior_factor(noise, [Key(A), Key(A + 1)], measured)
    expected = 0.5 * error @ np.linalg.solve(root @ root.T, error)
    assert joint.error(values) == pytest.approx(expected, rel=1e-9)
