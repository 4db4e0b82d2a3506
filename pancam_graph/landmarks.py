"""Landmarks as unit 4-vectors: linear triangulation, refinement with cameras held, redundancy.

A landmark is (X, w) on the sphere S^3 (thesis eq. 4.1, without its surplus scale), relative to an origin
of its own near the cameras that see it: the point is origin + X / w. Projection is linear in (X, w) but
for its division, so a ridge on the horizon (w near 0) is an ordinary landmark, and one that starts beyond
infinity (w below 0) can come back.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pancam_graph.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.losses import SQUARED, Loss

_BEHIND_COST = 1e12
_REFINE_STEPS = 15
_NO_BASELINE_M = 1e-9

__all__ = [
    "CameraViews",
    "Landmarks",
    "Measurements",
    "evaluate",
    "free_derivatives",
    "point_sigma_m",
    "refine",
    "residual_cofactor",
    "triangulate",
]


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraViews:
    """Pinhole cameras of all images."""

    world_R_camera: FloatArray
    """(images, 3, 3)"""
    world_t_camera: FloatArray
    """(images, 3) metres"""
    calibration: FloatArray
    """(images, 3, 3) upper-triangular K"""

    @cached_property
    def to_pixel(self) -> FloatArray:
        """(images, 3, 3) K camera_R_world: takes world directions to homogeneous pixels."""
        return np.asarray(self.calibration @ self.world_R_camera.transpose(0, 2, 1))


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurements:
    """Observations as pinhole pixels, sorted by landmark; n rows."""

    row: IntArray
    """(n,) row in the traverse's observations"""
    image: IntArray
    """(n,)"""
    landmark: IntArray
    """(n,) landmark row, ascending, without gaps"""
    uv_px: FloatArray
    """(n, 2) pixels of the pinhole of the same camera"""
    whitening: FloatArray
    """(n, 2, 2) takes a residual of the pinhole to raw pixels divided by sigma"""

    @property
    def n_landmarks(self) -> int:
        """Number of landmarks."""
        return int(self.landmark[-1]) + 1 if len(self.landmark) else 0

    @property
    def starts(self) -> IntArray:
        """(landmarks,) first row of each landmark."""
        return np.searchsorted(self.landmark, np.arange(self.n_landmarks))

    def part(self, rows: IntArray) -> "Measurements":
        """Rows of whole landmarks, these numbered anew without gaps."""
        return replace(
            self,
            row=self.row[rows],
            image=self.image[rows],
            landmark=np.unique(self.landmark[rows], return_inverse=True)[1],
            uv_px=self.uv_px[rows],
            whitening=self.whitening[rows],
        )

    def scaled(self, factor: FloatArray | float) -> "Measurements":
        """The same with every sigma multiplied by a factor, one for all or (n,)."""
        return replace(self, whitening=self.whitening / np.reshape(factor, (-1, 1, 1)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Landmarks:
    """Unit 4-vectors with their origins."""

    vector: FloatArray
    """(landmarks, 4) (X, w) of unit length, its sign such that most cameras have it in front"""
    origin_m: FloatArray
    """(landmarks, 3) world point that X / w is relative to"""

    def points_m(self, furthest_m: FloatArray) -> FloatArray:
        """World points (landmarks, 3); those further than `furthest_m` (landmarks,) are brought to it.

        A landmark beyond infinity is placed at that distance too; one without a direction at its origin.
        """
        x, w = self.vector[:, :3], self.vector[:, 3]
        depth = np.maximum(w, np.linalg.norm(x, axis=1) / furthest_m).clip(1e-300)
        return np.asarray(self.origin_m + x / depth[:, None])

    def moved_to(self, points_m: FloatArray) -> "Landmarks":
        """Landmarks of the same origins at world points (landmarks, 3)."""
        vector = np.column_stack([points_m - self.origin_m, np.ones(len(points_m))])
        return replace(self, vector=vector / np.linalg.norm(vector, axis=1, keepdims=True))


def triangulate(
    centre_m: FloatArray, direction: FloatArray, landmark: IntArray, weight: FloatArray
) -> Landmarks:
    """Linear triangulation in homogeneous coordinates from n rays sorted by landmark.

    Ray centres (n, 3), unit directions (n, 3), landmark rows (n,) ascending without gaps, weights (n,).
    Minimises the weighted squared distances |(I - d d')(X - w c)|^2 over unit (X, w), w in units of the
    baseline across the rays so that the answer is the same in any unit of length; then once more with
    weights divided by the squared ranges so that angles count, not metres. One ray alone, or rays along
    one line, show no parallax: the landmark then lies on them at infinity. Where all weights of a landmark
    are 0, all its rays count alike.
    """
    starts = np.searchsorted(landmark, np.arange(landmark[-1] + 1))
    weight = np.where((np.add.reduceat(weight, starts) > 0)[landmark], weight, 1.0)
    total = np.add.reduceat(weight, starts)
    origin = np.add.reduceat(weight[:, None] * centre_m, starts) / total[:, None]
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    arm = np.einsum("nij,nj->ni", across, centre_m - origin[landmark])
    baseline = np.sqrt(np.add.reduceat(weight * np.einsum("ni,ni->n", arm, arm), starts) / total)
    parallax = baseline > _NO_BASELINE_M
    baseline = np.where(parallax, baseline, 1.0)
    arm = np.where(parallax[landmark, None], arm / baseline[landmark, None], 0.0)
    form = np.empty((len(landmark), 4, 4))
    form[:, :3, :3] = across
    form[:, :3, 3] = form[:, 3, :3] = -arm
    form[:, 3, 3] = np.where(parallax[landmark], np.einsum("ni,ni->n", arm, arm), 1.0)
    vector = np.empty((len(origin), 4))
    ray_weight = weight
    for _ in range(2):
        _, vectors = np.linalg.eigh(np.add.reduceat(ray_weight[:, None, None] * form, starts))
        vector = vectors[:, :, 0]
        vector[:, 3] /= baseline
        vector /= np.linalg.norm(vector, axis=1, keepdims=True)
        towards = vector[landmark, :3] - vector[landmark, 3:] * (centre_m - origin[landmark])
        ray_weight = weight / np.maximum(np.einsum("ni,ni->n", towards, towards), 1e-12)
    sight = np.add.reduceat(weight * np.sign(np.einsum("ni,ni->n", towards, direction)), starts)
    vector = vector * np.where(sight < 0, -1.0, 1.0)[:, None]
    return Landmarks(vector=vector, origin_m=origin)


def evaluate(
    landmarks: Landmarks, measurements: Measurements, views: CameraViews
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Whitened residuals (n, 2), their derivatives (n, 2, 3) by the tangents of S^3, and what is in front.

    Residuals of landmarks behind a camera are those of the mirrored point and mean nothing.
    """
    k, image = measurements.landmark, measurements.image
    offset = views.world_t_camera[image] - landmarks.origin_m[k]
    vector = landmarks.vector[k]
    world_ray = vector[:, :3] - vector[:, 3:] * offset
    to_pixel = views.to_pixel[image]
    p = np.einsum("nij,nj->ni", to_pixel, world_ray)
    in_front = p[:, 2] > 1e-12
    depth = np.where(np.abs(p[:, 2]) > 1e-12, p[:, 2], 1e-12)
    uv = p[:, :2] / depth[:, None]
    residual = np.einsum("nij,nj->ni", measurements.whitening, uv - measurements.uv_px)
    d_uv = (to_pixel[:, :2] - uv[:, :, None] * to_pixel[:, 2:]) / depth[:, None, None]
    d_ray = measurements.whitening @ d_uv
    d_vector = np.concatenate([d_ray, -np.einsum("nij,nj->ni", d_ray, offset)[:, :, None]], axis=2)
    return residual, d_vector @ _tangent_basis(landmarks.vector)[k], in_front


def free_derivatives(b: FloatArray, landmarks: Landmarks, measurements: Measurements) -> FloatArray:
    """`evaluate`'s derivatives (n, 2, 3) along those directions that `refine` leaves free.

    A landmark that `refine` holds at infinity (w is 0) does not follow its observations beyond it: its
    derivatives lose their part along w.
    """
    at_infinity = landmarks.vector[:, 3] == 0
    along_w = np.where(at_infinity[:, None], _tangent_basis(landmarks.vector)[:, 3, :], 0.0)
    along_w = along_w[measurements.landmark]
    return np.asarray(b - np.einsum("nij,nj->ni", b, along_w)[:, :, None] * along_w[:, None, :])


def _tangent_basis(vector: FloatArray) -> FloatArray:
    """Orthonormal bases (landmarks, 4, 3) of the tangent spaces, by Householder reflections."""
    v = vector.copy()
    v[:, 0] += np.where(v[:, 0] >= 0, 1.0, -1.0)
    reflection = np.eye(4) - 2 * v[:, :, None] * v[:, None, :] / np.einsum("li,li->l", v, v)[:, None, None]
    return np.asarray(reflection[:, :, 1:])


def refine(
    landmarks: Landmarks,
    measurements: Measurements,
    views: CameraViews,
    weight: FloatArray,
    loss: Loss = SQUARED,
    *,
    beyond_infinity: bool = False,
) -> Landmarks:
    """Best landmarks with all cameras held: Levenberg-Marquardt for each on its own.

    `weight` (n,) multiplies each observation's cost; 0 leaves it out. A step that would raise a landmark's
    cost or move it behind a camera is not taken; directions that its rays leave free are not moved along.
    Landmarks whose rays diverge end at infinity, or beyond it where that is allowed.
    """
    free = _refine(landmarks, measurements, views, weight, loss, held_at_infinity=False)
    # One whose vector is its origin alone has no direction in which infinity could be.
    is_beyond = (free.vector[:, 3] < 0) & (np.linalg.norm(free.vector[:, :3], axis=1) > 1e-9)
    beyond = np.flatnonzero(is_beyond)
    if beyond_infinity or len(beyond) == 0:
        return free
    rows = np.flatnonzero(is_beyond[measurements.landmark])
    flat = free.vector[beyond] * [1.0, 1.0, 1.0, 0.0]
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    bound = _refine(
        Landmarks(vector=flat, origin_m=free.origin_m[beyond]),
        measurements.part(rows),
        views,
        weight[rows],
        loss,
        held_at_infinity=True,
    )
    vector = free.vector.copy()
    vector[beyond] = bound.vector
    return replace(free, vector=vector)


def _refine(
    landmarks: Landmarks,
    measurements: Measurements,
    views: CameraViews,
    weight: FloatArray,
    loss: Loss,
    *,
    held_at_infinity: bool,
) -> Landmarks:
    vector = landmarks.vector.copy()
    damping = np.full(len(vector), 1e-6)
    active = np.arange(len(vector))
    rows = np.arange(len(measurements.row))
    for _ in range(_REFINE_STEPS):
        part, own = measurements.part(rows), weight[rows]
        now = replace(landmarks, vector=vector[active], origin_m=landmarks.origin_m[active])
        residual, b, in_front = evaluate(now, part, views)
        cost = _landmark_cost(residual, in_front, own, part.starts, loss)
        if held_at_infinity:
            b = free_derivatives(b, now, part)
        wb = (own * loss.weight(residual))[:, None, None] * b
        v = np.add.reduceat(b.transpose(0, 2, 1) @ wb, part.starts)
        g = np.add.reduceat(np.einsum("nij,ni->nj", wb, residual), part.starts)
        values, vectors = np.linalg.eigh(v)
        floor = 1e-13 * values[:, -1:] + 1e-300
        along = np.einsum("lij,li->lj", vectors, g) * (values > floor)
        step = -np.einsum("lij,lj->li", vectors, along / (values.clip(floor) * (1 + damping[active, None])))
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))[:, None]
        moved = now.vector + np.einsum("lij,lj->li", _tangent_basis(now.vector), step)
        if held_at_infinity:
            moved[:, 3] = 0.0
        trial = replace(now, vector=moved / np.linalg.norm(moved, axis=1, keepdims=True))
        trial_residual, _, trial_front = evaluate(trial, part, views)
        trial_cost = _landmark_cost(trial_residual, trial_front, own, part.starts, loss)
        better = trial_cost < cost
        vector[active[better]] = trial.vector[better]
        damping[active] = np.where(better, damping[active] * 0.1, damping[active] * 100.0).clip(1e-12, 1e9)
        # A landmark stays where a step promises next to nothing, or where no damping makes one gain.
        promised = -0.5 * np.einsum("li,li->l", step, g)
        settled = (promised <= 1e-9 * cost + 1e-12) | (~better & (damping[active] > 1e6))
        keep = np.zeros(len(vector), dtype=bool)
        keep[active[~settled]] = True
        rows, active = np.flatnonzero(keep[measurements.landmark]), np.flatnonzero(keep)
        if len(active) == 0:
            break
    return replace(landmarks, vector=vector)


def _landmark_cost(
    residual: FloatArray, in_front: BoolArray, weight: FloatArray, starts: IntArray, loss: Loss
) -> FloatArray:
    cost = loss.cost(residual) + np.where(in_front, 0.0, _BEHIND_COST)
    return np.asarray(np.add.reduceat(weight * cost, starts))


def residual_cofactor(b: FloatArray, measurements: Measurements, weight: FloatArray) -> FloatArray:
    """Covariance (n, 2, 2) of whitened residuals, cameras taken as known: what noise alone makes of them.

    For observations that take part (weight above 0) it is I - B V^-1 B', since the landmark follows them;
    for the others I + B V^-1 B'. `b` (n, 2, 3) are `evaluate`'s derivatives. Source: Baarda, A testing
    procedure for use in geodetic networks, 1968.
    """
    v = np.add.reduceat(b.transpose(0, 2, 1) @ (weight[:, None, None] * b), measurements.starts)
    values, vectors = np.linalg.eigh(v)
    # Directions that the accepted rays leave free: their observations determine them, whatever they say.
    inverse = 1 / np.maximum(values, 1e-14 * values[:, -1:] + 1e-100)
    half = b @ (vectors * np.sqrt(inverse)[:, None, :])[measurements.landmark]
    leverage = half @ half.transpose(0, 2, 1)
    sign = np.where(weight > 0, -weight, 1.0)
    return np.asarray(np.eye(2) + sign[:, None, None] * leverage)


def point_sigma_m(
    points_m: FloatArray, measurements: Measurements, views: CameraViews, accepted: BoolArray
) -> FloatArray:
    """Standard deviation (landmarks,) of world points (landmarks, 3) in their worst direction, cameras held.

    That direction is the line of sight but for points between their cameras. Infinite for landmarks that
    fewer than two accepted observations see.
    """
    image, k = measurements.image, measurements.landmark
    to_pixel = views.to_pixel[image]
    p = np.einsum("nij,nj->ni", to_pixel, points_m[k] - views.world_t_camera[image])
    depth = np.where(np.abs(p[:, 2]) > 1e-12, p[:, 2], 1e-12)
    uv = p[:, :2] / depth[:, None]
    d_point = (
        measurements.whitening @ (to_pixel[:, :2] - uv[:, :, None] * to_pixel[:, 2:]) / depth[:, None, None]
    )
    d_point = np.where(accepted[:, None, None], d_point, 0.0)
    information = np.add.reduceat(d_point.transpose(0, 2, 1) @ d_point, measurements.starts)
    smallest = np.linalg.eigvalsh(information)[:, 0]
    few = np.bincount(k, accepted, minlength=len(points_m)) < 2
    return np.where(few | (smallest <= 0), np.inf, 1 / np.sqrt(smallest.clip(1e-300)))
