"""Cameras and tracks for the tests of landmarks and of their screening."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray, IntArray
from pancam_graph.landmarks import CameraViews, Landmarks, Measurements

FOCAL_PX = 1000.0


def views_at(
    centres_m: FloatArray | Sequence[Sequence[float]], rotvec: FloatArray | None = None
) -> CameraViews:
    """Cameras that look along the world's x axis, turned by rotation vectors (n, 3) in the world."""
    centres = np.asarray(centres_m, dtype=float)
    turn = np.zeros_like(centres) if rotvec is None else rotvec
    k = np.array([[FOCAL_PX, 1.0, 500.0], [0.0, 1.01 * FOCAL_PX, 400.0], [0.0, 0.0, 1.0]])
    return CameraViews(
        world_R_camera=Rotation.from_rotvec(turn).as_matrix() @ HEAD_R_FORWARD_CAMERA,
        world_t_camera=centres,
        calibration=np.tile(k, (len(centres), 1, 1)),
    )


def random_views(rng: np.random.Generator, n: int, spread_m: float = 2.0) -> CameraViews:
    """Cameras spread around the origin that look more or less along x."""
    return views_at(rng.uniform(-spread_m, spread_m, (n, 3)), rng.normal(0, 0.1, (n, 3)))


def random_points(rng: np.random.Generator, n: int, near_m: float = 8.0, far_m: float = 60.0) -> FloatArray:
    """Homogeneous points (n, 4) in front of `random_views`, their distances even in the logarithm."""
    x = np.exp(rng.uniform(np.log(near_m), np.log(far_m), n))
    return np.column_stack([x, *(x * rng.uniform(-0.3, 0.3, (2, n))), np.ones(n)])


def pixels_of(views: CameraViews, image: Sequence[int] | IntArray, points: FloatArray) -> FloatArray:
    """Pixels (n, 2) of homogeneous points (n, 4) or (4,) in images (n,), row by row."""
    index = np.asarray(image)
    points = np.broadcast_to(points, (len(index), 4))
    ray = points[:, :3] - points[:, 3:] * views.world_t_camera[index]
    to_pixel = views.calibration[index] @ views.world_R_camera[index].transpose(0, 2, 1)
    p = np.einsum("nij,nj->ni", to_pixel, ray)
    return np.asarray(p[:, :2] / p[:, 2:])


def measure(
    views: CameraViews,
    points: FloatArray,
    images: Sequence[Sequence[int] | IntArray] | None = None,
    *,
    sigma_px: float = 0.3,
    noise: np.random.Generator | None = None,
) -> Measurements:
    """What `images` (by default all) see of each homogeneous point (n, 4); with noise if given a source."""
    seen = [range(len(views.world_t_camera))] * len(points) if images is None else images
    image = np.concatenate([np.asarray(s, dtype=np.int64) for s in seen])
    landmark = np.repeat(np.arange(len(points)), [len(s) for s in seen])
    uv = pixels_of(views, image, points[landmark])
    if noise is not None:
        uv = uv + sigma_px * noise.standard_normal(uv.shape)
    return Measurements(
        row=np.arange(len(image)),
        image=image,
        landmark=landmark,
        uv_px=uv,
        whitening=np.tile(np.eye(2) / sigma_px, (len(image), 1, 1)),
    )


def unit(points: FloatArray, origin_m: FloatArray | None = None) -> Landmarks:
    """Landmarks of homogeneous points (n, 4), of either sign of w, relative to origins (n, 3), default 0."""
    origin = np.zeros((len(points), 3)) if origin_m is None else origin_m
    vector = np.column_stack([points[:, :3] - points[:, 3:] * origin, points[:, 3]])
    return Landmarks(vector=vector / np.linalg.norm(vector, axis=1, keepdims=True), origin_m=origin)


def homogeneous(landmarks: Landmarks) -> FloatArray:
    """Unit homogeneous world points (n, 4); inverse of `unit`."""
    x, w = landmarks.vector[:, :3], landmarks.vector[:, 3:]
    points = np.column_stack([x + w * landmarks.origin_m, w])
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))
