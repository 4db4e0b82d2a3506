"""Landmarks one by one in plain NumPy, from the definitions; the compiled loops must equal them.

Nothing here calls the package but for its data classes. Every function takes one landmark: a vector (4,), its
origin (3,), the images (m,) that see it, its pixels (m, 2) and whitenings (m, 2, 2).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, norm

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.landmarks import CameraViews, Landmarks, Measurements


@dataclass(frozen=True)
class Track:
    """All observations of one landmark."""

    views: CameraViews
    image: IntArray
    uv_px: FloatArray
    whitening: FloatArray

    def only(self, rows: BoolArray) -> "Track":
        return replace(self, image=self.image[rows], uv_px=self.uv_px[rows], whitening=self.whitening[rows])


def tracks(m: Measurements, views: CameraViews) -> list[Track]:
    rows = [np.flatnonzero(m.landmark == k) for k in range(m.landmark[-1] + 1)]
    return [Track(views, m.image[r], m.uv_px[r], m.whitening[r]) for r in rows]


def tangents(vector: FloatArray) -> FloatArray:
    """(4, 3) the images of the last three axes in the reflection I - 2 a a' / a'a, a = vector + sign e0."""
    a = vector + (1.0 if vector[0] >= 0 else -1.0) * np.eye(4)[0]
    return np.asarray((np.eye(4) - 2 * np.outer(a, a) / (a @ a))[:, 1:])


def seen(track: Track, vector: FloatArray, origin: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Whitened residuals (m, 2), their derivatives (m, 2, 3) by the tangents, and what is in front (m,)."""
    residual, b, front = [], [], []
    for image, uv, whitening in zip(track.image, track.uv_px, track.whitening, strict=True):
        R, t, K = (
            x[image]
            for x in (track.views.world_R_camera, track.views.world_t_camera, track.views.calibration)
        )
        P = (
            K @ R.T @ np.column_stack([np.eye(3), origin - t])
        )  # [P | ..] (X, w): world ray X - w (t - origin)
        h = P @ vector
        projected = h[:2] / h[2]
        d_vector = (P[:2] - np.outer(projected, P[2])) / h[2]
        residual.append(whitening @ (projected - uv))
        b.append(whitening @ d_vector @ tangents(vector))
        front.append(h[2] > 1e-12)
    return np.array(residual), np.array(b), np.array(front)


def loss_cost(name: str, width: float, squared: FloatArray) -> FloatArray:
    length = np.sqrt(squared)
    if name == "huber":
        return np.where(length <= width, squared / 2, width * length - width**2 / 2)
    return width**2 / 2 * np.log1p(squared / width**2) if name == "cauchy" else squared / 2


def loss_weight(name: str, width: float, squared: FloatArray) -> FloatArray:
    if name == "huber":
        return np.minimum(1.0, width / np.sqrt(np.maximum(squared, 1e-300)))
    return 1 / (1 + squared / width**2) if name == "cauchy" else np.ones_like(squared)


def ray(track: Track) -> tuple[FloatArray, FloatArray]:
    """Centres and unit directions (m, 3)."""
    views, image = track.views, track.image
    pixels = np.column_stack([track.uv_px, np.ones(len(image))])
    direction = np.array(
        [
            views.world_R_camera[i] @ np.linalg.solve(views.calibration[i], p)
            for i, p in zip(image, pixels, strict=True)
        ]
    )
    return views.world_t_camera[image], direction / np.linalg.norm(direction, axis=1, keepdims=True)


def triangulated(
    centre: FloatArray, direction: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Vector and origin: least of the weighted |(I - d d')(X - w c)|^2, twice, w in units of the baseline."""
    weight = weight if weight.sum() > 0 else np.ones_like(weight)
    origin = weight @ centre / weight.sum()
    across = [np.eye(3) - np.outer(d, d) for d in direction]
    arm = np.array([a @ (c - origin) for a, c in zip(across, centre, strict=True)])
    baseline = np.sqrt(weight @ (arm**2).sum(1) / weight.sum())
    if baseline > 1e-9:
        rows = [np.column_stack([a, -x / baseline]) for a, x in zip(across, arm, strict=True)]
        forms = np.array([r.T @ r for r in rows])
    else:
        baseline = 1.0
        forms = np.array([np.block([[a, np.zeros((3, 1))], [np.zeros((1, 3)), np.eye(1)]]) for a in across])
    ray_weight = weight
    for _ in range(2):
        vector = np.linalg.eigh(np.tensordot(ray_weight, forms, 1))[1][:, 0] / [1, 1, 1, baseline]
        vector /= np.linalg.norm(vector)
        towards = vector[:3] - vector[3] * (centre - origin)
        ray_weight = weight / np.maximum((towards**2).sum(1), 1e-12)
    if weight @ np.sign((towards * direction).sum(1)) < 0:
        vector = -vector
    return vector, origin


def refined(
    track: Track,
    vector: FloatArray,
    origin: FloatArray,
    weight: FloatArray,
    name: str = "none",
    width: float = np.inf,
    *,
    beyond_infinity: bool = False,
    held: bool = False,
) -> FloatArray:
    """Levenberg-Marquardt for one landmark, fifteen steps at most."""
    track, weight = track.only(weight > 0), weight[weight > 0]

    def normal(v: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        residual, b, front = seen(track, v, origin)
        if held:
            along = tangents(v)[3]
            b = b - (b @ along)[:, :, None] * along
        squared = (residual**2).sum(1)
        cost = float(weight @ (loss_cost(name, width, squared) + np.where(front, 0.0, 1e12)))
        share = weight * loss_weight(name, width, squared)
        curvature: FloatArray = np.einsum("n,nip,niq->pq", share, b, b)
        gradient: FloatArray = np.einsum("n,nip,ni->p", share, b, residual)
        return cost, curvature, gradient

    if len(weight) == 0:
        return vector
    damping = 1e-6
    for _ in range(15):
        cost, V, g = normal(vector)
        values, turn = np.linalg.eigh(V)
        known = values > 1e-13 * values[-1] + 1e-300
        step = -turn[:, known] @ ((turn.T @ g)[known] / values[known]) / (1 + damping)
        step *= min(1.0, 0.5 / max(float(np.linalg.norm(step)), 1e-300))
        trial = vector + tangents(vector) @ step
        if held:
            trial[3] = 0.0
        trial /= np.linalg.norm(trial)
        better = normal(trial)[0] < cost
        vector = trial if better else vector
        damping *= 0.1 if better else 100.0
        if -0.5 * step @ g <= 1e-9 * cost + 1e-12 or (not better and damping > 1e6):
            break
    flat = vector * [1, 1, 1, 0]
    if held or beyond_infinity or vector[3] >= 0 or np.linalg.norm(flat) <= 1e-9:
        return vector
    return refined(track, flat / np.linalg.norm(flat), origin, weight, name, width, held=True)


def cofactor(b: FloatArray, weight: FloatArray) -> FloatArray:
    """(m, 2, 2) I - w B V^-1 B' of what takes part, I + B V^-1 B' of the others."""
    values, turn = np.linalg.eigh(np.einsum("n,nip,niq->pq", weight, b, b))
    half = b @ (turn / np.sqrt(np.maximum(values, 1e-14 * values[-1] + 1e-100)))
    sign = np.where(weight > 0, weight, -1.0)[:, None, None]
    return np.asarray(np.eye(2) - sign * (half @ half.transpose(0, 2, 1)))


def screened(
    start: Landmarks,
    m: Measurements,
    views: CameraViews,
    accepted: BoolArray,
    cutoff_sigma: float,
    scale: float,
) -> tuple[FloatArray, BoolArray]:
    """Vectors and accepted measurements for a known noise scale; every landmark anew in every sweep."""
    rows = [np.flatnonzero(m.landmark == k) for k in range(m.landmark[-1] + 1)]
    vector, origin, accepted = start.vector.copy(), start.origin_m.copy(), accepted.copy()
    limit = np.append(np.inf, chi2.isf(2 * norm.sf(cutoff_sigma), [1, 2]))
    anew = []
    for k, r in enumerate(rows):
        if accepted[r].sum() < 2:
            accepted[r] = True
        if accepted[r].all():
            anew.append(k)
    everything = tracks(m, views)
    for sweep in range(12):
        verdicts, lost, changed = [], [], False
        for k in anew:
            if accepted[rows[k]].any():
                vector[k], origin[k] = triangulated(*ray(everything[k]), accepted[rows[k]].astype(float))
        for k, r in enumerate(rows):
            weight = accepted[r].astype(float)
            vector[k] = refined(everything[k], vector[k], origin[k], weight)
            residual, b, front = seen(everything[k], vector[k], origin[k])
            if vector[k, 3] == 0:
                along = tangents(vector[k])[3]
                b = b - (b @ along)[:, :, None] * along
            values, turn = np.linalg.eigh(cofactor(b, weight))
            shown = values > 0.02
            along = np.einsum("nij,ni->nj", turn, residual) ** 2
            test = np.sum(np.where(shown, along, 0.0) / np.where(shown, values, 1.0), axis=1)
            verdicts.append((test, shown.sum(1), (residual**2).sum(1), front))
        for k, (test, freedom, squared, front) in enumerate(verdicts):
            before = accepted[rows[k]]
            excess = test / scale**2 - limit[freedom]
            excess[before] = np.maximum(excess, squared / scale**2 - limit[2])[before]
            excess[~front] = np.inf
            goes = before & (excess > 0)
            if before.sum() > 2:
                goes &= excess == excess[before].max()
            comes = ~before & (excess < 0) & (freedom > 0)
            if sweep > 0 or (before & ~goes).sum() < 2:
                comes[:] = False
            if goes.any():
                lost.append(k)
            changed |= bool(goes.any() or comes.any())
            accepted[rows[k]] = (before & ~goes) | comes
        anew = lost
        if not changed:
            break
    return vector, accepted
