"""Projection matrices as variables: their split, conditioning, tie and elimination, each by other means."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.linalg import rq
from scipy.spatial.transform import Rotation

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import Conditioning, projection_matrix, projection_tangents, split_projections
from pancam_graph.elimination import LandmarkSystem, Linkage, Posture
from pancam_graph.factors import Fixed, Key, mast_factor, projective_factor, projective_residual
from pancam_graph.landmarks import CameraViews, LossName, loss_of
from support.elimination_reference import assert_systems_agree, dense_of, true_cost, whole
from support.landmark_scenes import measure, random_points, random_views, unit

P, X, M, A, E, T = (gtsam.symbol(c, 0) for c in "PXMAET")
UNIT12 = gtsam.noiseModel.Unit.Create(12)
PAN_T_TILT = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.02, -0.01, 0.03), np.array([0.03, -0.02, 0.05]))
K = np.array([[1222.0, 3.0, 511.5], [0.0, 1180.0, 500.0], [0.0, 0.0, 1.0]])


# --- split ---


def random_cameras(
    rng: np.random.Generator, n: int, *, angle: float, length: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """K, R, C and factors."""
    k = np.tile(K, (n, 1, 1))
    k[:, :2] *= rng.uniform(0.05, 5, (n, 2, 1))
    rotation = Rotation.from_rotvec(rng.normal(0, angle, (n, 3))).as_matrix()
    return k, rotation, rng.normal(0, length, (n, 3)), rng.uniform(0.01, 20, n)


CAMERAS = {"random": (1.0, 3.0), "near identity": (1e-7, 1e-7), "far": (2.0, 1e4)}


@pytest.mark.parametrize("name", CAMERAS)
def test_split_is_that_of_rq_and_gives_the_matrix_back(name: str) -> None:
    angle, length = CAMERAS[name]
    k, R, C, s = random_cameras(np.random.default_rng(1), 20, angle=angle, length=length)
    projections = s[:, None, None] * projection_matrix(k, R, C)
    found = split_projections(projections)
    for a, b in zip(found, (k, R, C, s), strict=True):
        assert a == pytest.approx(b, rel=1e-11, abs=1e-10 * max(1.0, np.abs(b).max() * 1e-3))
    for p, k_found, R_found in zip(projections, found[0], found[1], strict=True):
        upper, turn = rq(p[:, :3])
        sign = np.diag(np.sign(np.diag(upper)))
        assert turn.T @ sign == pytest.approx(R_found.T, abs=1e-12)
        assert upper @ sign / abs(upper[2, 2]) == pytest.approx(k_found, rel=1e-11, abs=1e-9)
        assert R_found @ R_found.T == pytest.approx(np.eye(3), abs=1e-14)


def test_split_keeps_what_is_in_front_there_and_tells_a_mirror() -> None:
    k, R, C, _ = random_cameras(np.random.default_rng(0), 5, angle=1.0, length=3.0)
    mirrored = projection_matrix(k @ np.diag([-1.0, 1.0, 1.0]), R, C)
    found = split_projections(mirrored)
    assert np.all(found[0][:, 0, 0] < 0)
    assert found[3] == pytest.approx(np.ones(5))
    assert np.linalg.det(found[1]) == pytest.approx(np.ones(5))
    assert found[3][:, None, None] * projection_matrix(*found[:3]) == pytest.approx(mirrored, rel=1e-9)


def test_what_is_no_camera_is_not_finite_and_raises_nothing() -> None:
    zero_row, along = (projection_matrix(np.eye(3), np.eye(3), np.zeros(3)) for _ in range(2))
    zero_row[2] = 0.0
    along[1] = 2 * along[2]
    for part in split_projections(np.array([zero_row, along]))[:3]:
        assert not np.isfinite(part).all(axis=tuple(range(1, part.ndim))).any()


def moved_by(before: tuple[FloatArray, ...], after: tuple[FloatArray, ...]) -> FloatArray:
    """(n, 12) what `projection_tangents` has rows for, between two splits."""
    (k, R, C, s), (k2, R2, C2, s2) = before, after
    turn = Rotation.from_matrix(R @ R2.transpose(0, 2, 1)).as_rotvec()
    shift = np.einsum("nij,nj->ni", R, C2 - C)
    numbers = (k2 - k)[:, [0, 1, 0, 0, 1], [0, 1, 1, 2, 2]]
    return np.column_stack([turn, shift, numbers, np.log(s2 / s)])


@pytest.mark.parametrize("name", CAMERAS)
def test_tangents_of_the_split_against_differences(name: str) -> None:
    """Each entry moved by a millionth of its row: pixels, and the third row, differ by a thousand."""
    angle, length = CAMERAS[name]
    cameras = random_cameras(np.random.default_rng(2), 20, angle=angle, length=length)
    projections = cameras[3][:, None, None] * projection_matrix(*cameras[:3])
    base = split_projections(projections)
    tangents = projection_tangents(*base)
    assert tangents.shape == (20, 12, 12)
    for entry in range(12):
        row = entry // 4
        h = 1e-6 * np.linalg.norm(projections[:, row, :3], axis=1)
        if entry % 4 == 3:
            h *= max(1.0, length)
        step = np.zeros((20, 3, 4))
        step.reshape(20, 12)[:, entry] = h
        there, back = (moved_by(base, split_projections(projections + sign * step)) for sign in (1.0, -1.0))
        numeric = (there - back) / (2 * h)[:, None]
        size = np.abs(tangents).max(axis=2)
        assert np.abs(tangents[:, :, entry] - numeric) / size == pytest.approx(np.zeros((20, 12)), abs=1e-7)


# --- conditioning ---


def random_conditioning(rng: np.random.Generator, n: int) -> Conditioning:
    return Conditioning(
        centre_px=rng.normal(500, 100, (n, 2)),
        extent_px=rng.uniform(100, 600, n),
        origin_m=rng.normal(0, 100, (n, 3)),
        extent_m=rng.uniform(1, 20, n),
    )


def test_conditioning_is_thesis_5_2_and_undone_exactly() -> None:
    rng = np.random.default_rng(0)
    n = 6
    c = random_conditioning(rng, n)
    projections = rng.normal(size=(n, 3, 4)) * np.array([1000.0, 1000.0, 1.0])[:, None]
    entries = c.condition(projections)
    for i in range(n):
        s, (u, v), length = 1 / c.extent_px[i], c.centre_px[i], c.extent_m[i]
        T = np.array([[s, 0, -s * u], [0, s, -s * v], [0, 0, 1]])
        # The matrices are about the origin already: of U only the unit of length is left.
        U = np.diag([1 / length] * 3 + [1])
        expected = T @ projections[i] @ np.linalg.inv(U) / length
        assert entries[i].reshape(3, 4) == pytest.approx(expected, rel=1e-12, abs=1e-12)
        one = c.of(np.array([i]))
        assert np.array_equal(one.condition(projections[i : i + 1])[0], entries[i])
        assert np.array_equal(one.d_undo[0], c.d_undo[i])
    assert c.undo(entries) == pytest.approx(projections, rel=1e-12, abs=1e-12)
    assert np.einsum("nij,nj->ni", c.d_undo, entries) == pytest.approx(
        projections.reshape(n, 12), rel=1e-12, abs=1e-11
    )
    plain = Conditioning.none(n)
    assert np.array_equal(plain.condition(projections), projections.reshape(n, 12))
    assert np.array_equal(plain.undo(plain.condition(projections)), projections)


# --- the tie ---

STATES = {"random": (0.5, 1.0), "near identity": (1e-7, 1e-7), "on the chain": (0.0, 0.0), "far": (1.0, 1e3)}


def random_pose(rng: np.random.Generator, angle: float, length: float) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, angle, 3)), rng.normal(0, length, 3))


def chain(pan: float, tilt: float) -> gtsam.Pose3:
    zero = np.zeros(3)
    return gtsam.Pose3(gtsam.Rot3.Rz(pan), zero) * PAN_T_TILT * gtsam.Pose3(gtsam.Rot3.Ry(-tilt), zero)


def tied(
    rng: np.random.Generator, angle: float, length: float
) -> tuple[gtsam.Values, gtsam.CustomFactor, FloatArray, float]:
    """A mast anywhere, a camera off the chain by a pose of the given size; its K and the factor of P."""
    values = gtsam.Values()
    mast, mount = random_pose(rng, 1.0, 50.0), random_pose(rng, 1.0, 0.3)
    angles = rng.uniform(-1.5, 1.5, 2)
    camera = mast * chain(*angles) * mount * random_pose(rng, angle, length)
    numbers = K + np.triu(rng.normal(0, 30, (3, 3))) * np.array([[1.0], [1.0], [0.0]])
    conditioning = replace(random_conditioning(rng, 1), origin_m=mast.translation()[None] + 1.0)
    factor = float(rng.uniform(0.5, 2))
    p = factor * projection_matrix(
        numbers, camera.rotation().matrix().T, camera.translation() - conditioning.origin_m[0]
    )
    values.insert(P, conditioning.condition(p[None])[0])
    values.insert(X, camera)
    values.insert(M, mast)
    values.insert(A, angles)
    values.insert(E, mount)
    values.insert(T, PAN_T_TILT)
    return (
        values,
        projective_factor(UNIT12, Key(P), Key(M), Key(A), Key(E), Key(T), K, conditioning),
        (numbers),
        factor,
    )


@pytest.mark.parametrize("name", STATES)
def test_tie_is_that_of_poses_with_calibration_and_factor_beside_it(name: str) -> None:
    rng = np.random.default_rng(len(name))
    pose = mast_factor(gtsam.noiseModel.Unit.Create(6), Key(X), Key(M), Key(A), Key(E), Key(T))
    for _ in range(5):
        values, factor, numbers, s = tied(rng, *STATES[name])
        found = factor.unwhitenedError(values)
        size = max(1.0, STATES[name][1])
        assert found[:6] == pytest.approx(pose.unwhitenedError(values), abs=1e-9 * size)
        assert found[6:11] == pytest.approx((numbers - K)[[0, 1, 0, 0, 1], [0, 1, 1, 2, 2]], abs=1e-8)
        assert found[11] == pytest.approx(np.log(s), abs=1e-12)


@pytest.mark.parametrize("name", STATES)
def test_jacobians_of_the_tie(name: str) -> None:
    """Row by row: pixels, radians and metres differ by much."""
    rng = np.random.default_rng(len(name))
    for _ in range(5):
        values, factor, _, _ = tied(rng, *STATES[name])
        jacobian = factor.linearize(values).jacobian()[0]
        column = 0
        for key, dim in zip(factor.keys(), (12, 6, 2, 6, 6), strict=True):
            for i in range(dim):
                errors = []
                for h in (1e-6, -1e-6):
                    delta = gtsam.VectorValues()
                    delta.insert(key, np.eye(dim)[i] * h)
                    errors.append(factor.unwhitenedError(values.retract(delta)))
                numeric = (errors[0] - errors[1]) / 2e-6
                size = np.abs(jacobian).max(axis=1).clip(1.0)
                assert np.abs(jacobian[:, column] - numeric) / size == pytest.approx(np.zeros(12), abs=1e-6)
                column += 1
        assert column == jacobian.shape[1]


def test_a_matrix_without_a_camera_costs_much_and_raises_nothing() -> None:
    """And leaves a camera beside it alone."""
    pose = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    projections = np.stack([np.zeros((3, 4)), K @ np.eye(3, 4)])
    calibration = np.stack([K, K])
    residual, jacobians = projective_residual(projections, pose, np.zeros((2, 2)), pose, pose, calibration)
    assert np.all(residual[0] >= 1e6)
    assert residual[1] == pytest.approx(np.zeros(12), abs=1e-9)
    assert [j.shape for j in jacobians] == [(2, 12, k) for k in (12, 6, 2, 6, 6)]
    assert not any(j[0].any() for j in jacobians)
    assert all(j[1].any() for j in jacobians)


def test_slots_that_are_fixed_are_no_variables() -> None:
    rng = np.random.default_rng(0)
    values, _, _, _ = tied(rng, 0.1, 0.1)
    factor = projective_factor(
        UNIT12,
        Key(P),
        Fixed(values.atPose3(M)),
        Fixed(values.atVector(A)),
        Fixed(values.atPose3(E)),
        Fixed(PAN_T_TILT),
        K,
        Conditioning.none(1),
    )
    assert list(factor.keys()) == [P]


# --- elimination ---


class Matrices:
    """Cameras of which each hangs on the 12 entries of its matrix, conditioned or not; two groups."""

    def __init__(self, *, normalised: bool, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.n = n = 5
        self.views = random_views(rng, n)
        points = random_points(rng, 12)
        images = [np.sort(rng.choice(n, int(rng.integers(2, n + 1)), replace=False)) for _ in points]
        self.m = measure(self.views, points, images, noise=rng)
        turn = rng.normal(0, 0.3, (len(self.m.image), 2, 2)) + np.eye(2)
        self.m = replace(self.m, whitening=turn @ self.m.whitening)
        self.landmarks = unit(points, rng.normal(0, 1, (len(points), 3)))
        self.conditioning = Conditioning(
            centre_px=np.full((n, 2), 450.0),
            extent_px=np.full(n, 400.0),
            origin_m=rng.normal(0, 1, (n, 3)),
            extent_m=np.full(n, 10.0),
        )
        if not normalised:
            self.conditioning = Conditioning.none(n)
        R, centre = self.views.world_R_camera, self.views.world_t_camera - self.conditioning.origin_m
        self.entries = self.conditioning.condition(
            1.3 * projection_matrix(self.views.calibration, R.transpose(0, 2, 1), centre)
        )
        self.linkage = Linkage(
            key=tuple(gtsam.symbol("P", i) for i in range(n)),
            dim=np.full(n, 12),
            group=np.array([0, 0, 0, 1, 1]),
            image_unit=np.arange(n),
            segment_begin=np.arange(n + 1),
            segment_variable=np.arange(n),
            segment_column=np.zeros(n, dtype=np.int64),
            segment_width=np.full(n, 12),
            segment_plain=np.zeros(n, dtype=bool),
        )

    def after(self, step: FloatArray) -> CameraViews:
        """The step is in units of the entries' rows, so that one step serves all kinds of entries."""
        entries = self.entries + step.reshape(self.n, 12)
        k, R, centre, _ = split_projections(self.conditioning.undo(entries))
        return CameraViews(
            world_R_camera=R.transpose(0, 2, 1),
            world_t_camera=centre + self.conditioning.origin_m,
            calibration=k,
        )

    def posture(self, views: CameraViews | None = None) -> Posture:
        split = split_projections(self.conditioning.undo(self.entries))
        here = views or self.after(np.zeros(12 * self.n))
        return Posture(
            views=here,
            unit_R=here.world_R_camera,
            unit_t=here.world_t_camera,
            chain=(projection_tangents(*split) @ self.conditioning.d_undo)[:, :11],
        )


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("normalised", [True, False])
def test_matrices_eliminate_as_dense_ones(normalised: bool, loss: LossName) -> None:
    """Their columns too: `dense_of` differentiates pixels by all 12 entries, the surplus factor included."""
    matrices, chosen = Matrices(normalised=normalised), loss_of(loss)
    system = LandmarkSystem(matrices.linkage, matrices.m, matrices.landmarks, chosen)
    S, s = whole(system.linearise(matrices.posture()))
    expected = dense_of(matrices.after, 12 * matrices.n, matrices.m, matrices.landmarks, chosen)
    assert_systems_agree(S, s, expected, tolerance=3e-8)
    # What no image sees: each matrix times a factor.
    factor = matrices.entries.ravel()
    size = np.linalg.norm(expected.A, axis=0) @ np.abs(factor)
    assert abs(factor @ S @ factor) < 1e-12 * size**2
    assert system.block_costs().sum() == pytest.approx(
        true_cost(matrices.landmarks, matrices.m, matrices.after(0 * factor), chosen), rel=1e-10
    )


def test_landmarks_follow_a_step_of_matrices_or_go_where_they_fit_best() -> None:
    matrices, loss = Matrices(normalised=True), loss_of("none")
    n = 12 * matrices.n
    step = 1e-5 * np.random.default_rng(3).standard_normal(n)
    views = matrices.after(step)
    followed = dense_of(matrices.after, n, matrices.m, matrices.landmarks, loss).followed(step)
    costs, vectors = [], []
    for refined in (False, True):
        system = LandmarkSystem(matrices.linkage, matrices.m, matrices.landmarks, loss, refined=refined)
        system.linearise(matrices.posture())
        costs.append(system.try_step(matrices.posture(views), step).sum())
        system.adopt()
        vectors.append(system.landmarks())
    assert costs[0] == pytest.approx(true_cost(followed, matrices.m, views, loss), rel=1e-8)
    assert vectors[0].vector == pytest.approx(followed.vector, abs=1e-7)  # noise makes strays of some
    assert costs[1] == pytest.approx(true_cost(vectors[1], matrices.m, views, loss), rel=1e-12)
    assert costs[1] < costs[0]
    # At their best: no cost falls by a small move of theirs.
    posture = matrices.posture(views)
    at_best = LandmarkSystem(matrices.linkage, matrices.m, vectors[1], loss)
    at_best.linearise(posture)
    assert np.abs(at_best.reduced.gamma).max() < 1e-3 < np.abs(system_of(matrices, views).reduced.gamma).max()


def system_of(matrices: Matrices, views: CameraViews) -> LandmarkSystem:
    system = LandmarkSystem(matrices.linkage, matrices.m, matrices.landmarks)
    system.linearise(matrices.posture(views))
    return system
