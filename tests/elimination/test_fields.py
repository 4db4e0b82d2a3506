"""Smooth distortion fields in the elimination against dense linear algebra."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import FIELD_COEFFICIENTS, FIELD_SHAPE, Fields
from pancam_graph.elimination import FieldColumns, LandmarkSystem, Linkage, Posture
from pancam_graph.landmarks import CameraViews, Landmarks, LossName, Measurements, loss_of, residuals
from support.elimination_reference import Dense, dense_of, true_cost, whole
from support.landmark_scenes import measure, random_points, random_views, unit
from support.parameters import slow_but_for

N = 4
BEGIN = np.array([0, 11, 22, 33, 44])
COLUMNS = 44 + 2 * FIELD_COEFFICIENTS


class Fielded:
    """Free cameras, each with its K, in two groups; in a third the fields of two eyes."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.coefficients = rng.normal(0, 2.0, (2, *FIELD_SHAPE))
        self.plain = random_views(rng, N)
        points = random_points(rng, 10)
        images = [np.sort(rng.choice(N, int(rng.integers(2, N + 1)), replace=False)) for _ in points]
        self.m: Measurements = measure(self.plain, points, images, noise=rng)
        turn = rng.normal(0, 0.3, (len(self.m.image), 2, 2)) + np.eye(2)
        self.m = replace(self.m, whitening=turn @ self.m.whitening)
        self.landmarks: Landmarks = unit(points, rng.normal(0, 1, (len(points), 3)))
        kinds = [gtsam.symbol(letter, i) for i in range(N) for letter in "XK"]
        self.linkage = Linkage(
            key=(*kinds, gtsam.symbol("D", 0), gtsam.symbol("D", 1)),
            dim=np.array([6, 5] * N + [FIELD_COEFFICIENTS] * 2),
            group=np.array([0, 0, 0, 0, 1, 1, 1, 1, 2, 2]),
            image_unit=np.arange(N),
            segment_begin=np.arange(0, 2 * N + 1, 2),
            segment_variable=np.arange(2 * N),
            segment_column=np.zeros(2 * N, dtype=np.int64),
            segment_width=np.tile([6, 5], N),
            segment_plain=np.tile([True, False], N),
            fields=FieldColumns(
                group=2,
                first=0,
                n=2 * FIELD_COEFFICIENTS,
                image_column=FIELD_COEFFICIENTS * (np.arange(N) % 2),
            ),
        )

    def after(self, step: FloatArray) -> CameraViews:
        R, t, K = (
            x.copy() for x in (self.plain.world_R_camera, self.plain.world_t_camera, self.plain.calibration)
        )
        for i, at in enumerate(BEGIN[:-1]):
            moved = gtsam.Pose3(gtsam.Rot3(R[i]), t[i]).retract(step[at : at + 6])
            R[i], t[i] = moved.rotation().matrix(), moved.translation()
            fx, fy, skew, cx, cy = step[at + 6 : at + 11]
            K[i] += [[fx, skew, cx], [0, fy, cy], [0, 0, 0]]
        fields = Fields(
            coefficients_px=self.coefficients + step[44:].reshape(2, *FIELD_SHAPE),
            row=np.arange(N) % 2,
            size_px=np.full((N, 2), 1000.0),
        )
        return CameraViews(world_R_camera=R, world_t_camera=t, calibration=K, fields=fields)

    def posture(self, views: CameraViews) -> Posture:
        chain = np.zeros((2 * N, 11, 6))
        chain[::2, :6] = np.eye(6)
        chain[1::2, 6:, :5] = np.eye(5)
        return Posture(views=views, unit_R=views.world_R_camera, unit_t=views.world_t_camera, chain=chain)

    def dense(self, loss: LossName) -> Dense:
        """By differences of residuals that know nothing of the kernel."""
        return dense_of(self.after, COLUMNS, self.m, self.landmarks, loss_of(loss))


@pytest.mark.parametrize("loss", slow_but_for("none", ["none", "cauchy"]))
def test_fields_eliminate_as_dense_ones(loss: LossName) -> None:
    fielded = Fielded()
    system = LandmarkSystem(fielded.linkage, fielded.m, fielded.landmarks, loss_of(loss))
    views = fielded.after(np.zeros(COLUMNS))
    S, s = whole(system.linearise(fielded.posture(views)))
    expected = fielded.dense(loss)
    diagonal = np.diag(expected.reduced[0])
    assert 60 < np.count_nonzero(diagonal[44:] > 1e-3) < 2 * FIELD_COEFFICIENTS  # some are seen, some are not
    d = np.sqrt(np.maximum(diagonal, 1e-3))
    assert S / np.outer(d, d) == pytest.approx(expected.reduced[0] / np.outer(d, d), abs=1e-7)
    assert s / d == pytest.approx(expected.reduced[1] / d, abs=1e-7 * float(np.linalg.norm(expected.r)))
    cost = true_cost(fielded.landmarks, fielded.m, views, loss_of(loss))
    assert system.block_costs().sum() == pytest.approx(cost, rel=1e-12)
    assert system.cost_at(fielded.posture(views)) == pytest.approx(cost, rel=1e-12)


def test_landmarks_follow_a_step_of_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pancam_graph.elimination._strays._STRAY", np.inf)  # nothing is refined after it
    fielded = Fielded()
    system = LandmarkSystem(fielded.linkage, fielded.m, fielded.landmarks)
    system.linearise(fielded.posture(fielded.after(np.zeros(COLUMNS))))
    wide = np.concatenate([np.tile([1.0] * 6 + [1e3] * 5, N), np.full(2 * FIELD_COEFFICIENTS, 1e3)])
    step = 1e-5 * wide * np.random.default_rng(2).standard_normal(COLUMNS)
    views = fielded.after(step)
    costs = system.try_step(fielded.posture(views), step)
    followed = fielded.dense("none").followed(step)
    assert costs.sum() == pytest.approx(true_cost(followed, fielded.m, views, loss_of("none")), rel=1e-7)
    system.adopt()
    assert system.landmarks().vector == pytest.approx(followed.vector, abs=1e-9)


def test_residuals_are_those_of_pixels_without_the_field() -> None:
    fielded = Fielded()
    views = fielded.after(np.zeros(COLUMNS))
    found, _ = residuals(fielded.landmarks, fielded.m, views)
    plain, _ = residuals(fielded.landmarks, fielded.m, fielded.plain)
    assert views.fields is not None
    at = views.fields.at(fielded.m.image, fielded.m.uv_px)
    assert found - plain == pytest.approx(np.einsum("nij,nj->ni", fielded.m.whitening, at), abs=1e-9)
