"""Observations through every lens in compiled loops: against the cameras and against differences."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHV, CAHVORE, Camera
from pancam_graph.landmarks import CameraViews, Landmarks, Measurements, lines_of_sight, residuals
from pancam_graph.landmarks._landmarks import evaluate
from support.lenses import ALL, CAHVORE_CAMERA, CENTRAL, pixels
from support.published_cameras import MODEL_A, MODEL_B, MODEL_C, PIXEL_B, PIXELS_C, POINT_B, POINTS_C

LINEARITIES = {"cahvore": 0.37, "perspective": 1.0, "fish-eye": 0.0, "beyond": -0.6}
assert isinstance(CAHVORE_CAMERA, CAHVORE)
WIDE = {f"{name} pupil": replace(CAHVORE_CAMERA, linearity=k) for name, k in LINEARITIES.items()}
LENSES: dict[str, Camera] = {**CENTRAL, **WIDE}


def measured(n: int, uv_px: FloatArray | None = None) -> Measurements:
    """Observations (n) of a landmark each, all in image 0; at pixel 0 and of unit noise unless told."""
    return Measurements(
        row=np.arange(n),
        image=np.zeros(n, dtype=np.int64),
        landmark=np.arange(n),
        uv_px=np.zeros((n, 2)) if uv_px is None else uv_px,
        whitening=np.tile(np.eye(2), (n, 1, 1)),
    )


def turned(camera: Camera, seed: int = 0) -> CameraViews:
    """One image of a camera, somewhere in the world."""
    rng = np.random.default_rng(seed)
    view = CameraViews.of([camera])
    return view.after(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(0, 3, 3))


def seen(
    views: CameraViews, points: Sequence[Sequence[float]] | FloatArray, w: FloatArray | float = 1.0
) -> Landmarks:
    """Landmarks at points (n, 3), metres in the camera's frame, or in the direction of these where w is 0."""
    points = np.asarray(points, dtype=float)
    x = points @ views.world_R_camera[0].T + np.reshape(w, (-1, 1)) * views.world_t_camera[0]
    vector = np.column_stack([x, np.broadcast_to(w, len(points))])
    return Landmarks(
        vector=vector / np.linalg.norm(vector, axis=1, keepdims=True), origin_m=np.zeros((len(points), 3))
    )


def some_points(camera: Camera, state: str) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) that a camera sees, and their w (n,)."""
    rng = np.random.default_rng(7)
    rays = camera.unproject(pixels(60))
    assert rays.valid.all()
    if state == "random":
        return rays.origin_m + rng.uniform(1, 20, 60)[:, None] * rays.direction, np.ones(60)
    if state == "far":
        return rays.direction, rng.choice([0.0, 1e-9, -1e-4, 1e-4], 60)
    axis = np.asarray(getattr(camera, "O", [0.0, 0.0, 1.0]))
    off = rng.normal(size=(60, 3)) * (10.0 ** rng.uniform(-14, -2, 60))[:, None]
    off[0] = 0.0
    return 5.0 * axis / np.linalg.norm(axis) + off, np.ones(60)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("state", ["random", "near axis"])
def test_a_landmark_is_seen_where_the_camera_projects_it(name: str, state: str) -> None:
    camera = LENSES[name]
    points, w = some_points(camera, state)
    expected, valid = camera.project(points)
    views = turned(camera)
    found, in_front = residuals(seen(views, points, w), measured(len(points)), views)
    assert valid.all()
    assert in_front.all()
    assert found == pytest.approx(expected, abs=2e-8)


@pytest.mark.parametrize("name", LENSES)
def test_a_landmark_at_infinity_is_seen_in_its_direction(name: str) -> None:
    camera, uv = LENSES[name], pixels(30)
    views = turned(camera)
    direction = camera.unproject(uv).direction
    for w in (0.0, 1e-12, -1e-12):
        found, in_front = residuals(seen(views, direction, w), measured(len(uv)), views)
        assert in_front.all()
        assert found == pytest.approx(uv, abs=1e-7)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("state", ["random", "near axis", "far"])
def test_derivatives_by_the_landmark_are_those_of_differences(name: str, state: str) -> None:
    camera = LENSES[name]
    points, w = some_points(camera, state)
    views, m = turned(camera), measured(len(points))
    landmarks = seen(views, points, w)
    _, b, in_front = evaluate(landmarks, m, views)
    assert in_front.all()
    normal = landmarks.vector.copy()
    normal[:, 0] += np.where(normal[:, 0] >= 0, 1.0, -1.0)
    square = np.sum(normal**2, axis=1)
    tangents = np.eye(4)[:, 1:] - (2 / square)[:, None, None] * normal[:, :, None] * normal[:, None, 1:]
    small = 1e-6
    for k in range(3):
        ends = []
        for sign in (1, -1):
            moved = landmarks.vector + sign * small * tangents[:, :, k]
            ends.append(residuals(replace(landmarks, vector=moved), m, views)[0])
        scale = np.abs(b).max()
        assert (ends[0] - ends[1]) / (2 * small) == pytest.approx(b[:, :, k], abs=2e-6 * scale)


@pytest.mark.parametrize("name", LENSES)
def test_lines_of_sight_are_those_of_the_camera(name: str) -> None:
    """The same lines; where a pupil moves, they may begin elsewhere on them."""
    camera, uv = LENSES[name], pixels(200)
    rays = camera.unproject(uv)
    centre, direction, valid = lines_of_sight(np.zeros(200, dtype=np.int64), uv, CameraViews.of([camera]))
    assert valid.all()
    assert direction == pytest.approx(rays.direction, abs=1e-12)
    apart = np.cross(rays.origin_m - centre, direction)
    assert apart == pytest.approx(np.zeros((200, 3)), abs=1e-12)
    assert np.linalg.norm(centre, axis=1).max() < 0.05


@pytest.mark.parametrize("name", ["brown", "cahvor"])
def test_beyond_the_fold_nothing_is_seen(name: str) -> None:
    """A barrel that folds back shows a second, false image of what is far off its axis."""
    camera = ALL[name]
    change = {"distortion": (-0.5, 0.0, 0.0, 0.0, 0.0)} if name == "brown" else {"R": np.array([0, -0.5, 0])}
    folding = replace(camera, **change)
    views = CameraViews.of([folding])
    points = np.array([[0.5, 0.0, 1.0], [0.9, 0.0, 1.0], [3.0, 0.0, 1.0]])
    _, in_front = residuals(seen(views, points), measured(3), views)
    assert in_front.tolist() == [True, False, False] == folding.project(points)[1].tolist()
    uv = np.array([[321.0, 237.0], [821.0, 237.0], [-2000.0, 237.0]])
    _, direction, valid = lines_of_sight(np.zeros(3, dtype=np.int64), uv, views)
    assert valid.tolist() == [True, False, False] == folding.unproject(uv).valid.tolist()
    assert np.isfinite(direction).all()


def test_behind_a_lens_nothing_is_seen() -> None:
    for camera in LENSES.values():
        views = CameraViews.of([camera])
        residual, in_front = residuals(seen(views, [[0.1, 0.2, -5.0]]), measured(1), views)
        assert not in_front.any()
        assert np.isfinite(residual).all()


@pytest.mark.parametrize(
    ("model", "point", "pixel"),
    [
        (MODEL_A, (-0.593194, 0.294442, 0.545509), (599.66607394, 131.22968783)),
        (MODEL_B, POINT_B, PIXEL_B),
        *((MODEL_C, point, pixel) for point, pixel in zip(POINTS_C, PIXELS_C, strict=True)),
    ],
)
def test_published_points_have_their_pixels(
    model: CAHV, point: tuple[float, ...], pixel: tuple[float, ...]
) -> None:
    camera, frame_T_camera = model.split()
    views = CameraViews.of([camera])
    inside = frame_T_camera.transformTo(np.array(point))
    found, in_front = residuals(seen(views, inside[None]), measured(1), views)
    assert in_front.all()
    assert found[0] == pytest.approx(pixel, abs=2e-6)
