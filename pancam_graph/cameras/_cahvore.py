"""CAHVORE: CAHVOR with an entrance pupil that moves, for wide angles and fish-eyes.

Source: Gennery 2006; docs/method.md, section "CAHV family".
"""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.compiled import uncounted
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras._cahv import MIN_DEPTH, NEWTON_STEPS, own_vectors
from pancam_graph.cameras._cahvor import CAHVOR, CAHVOR_FIELDS
from pancam_graph.cameras._camera import Rays, require_finite
from pancam_graph.cameras._lens import Distorted, Distortion, Lens, LensField

__all__ = ["CAHVORE", "CAHVORE_LENS"]

_MIN_RANGE_M = 1e-6
_STEPS = 20
"""Most steps of Newton's method to the field angle of a ray in compiled loops; most need two."""
_NEXT_IS_EXACT = 1e-8
"""Step of Newton's method, radians, after which what is left is the square of it: below rounding."""
_LEAST_L = 1e-12
"""Linearity below which, by its size, it counts as 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CAHVORE(CAHVOR):
    """CAHVOR with an entrance pupil that moves along O (E), for wide angles and fish-eyes."""

    E: FloatArray
    """(3,) entrance pupil coefficients e0, e1, e2, metres."""
    linearity: float
    """L: 1 perspective, 0 fish-eye (equidistant), and anything between; negative beyond."""

    def __post_init__(self) -> None:
        """Check the linearity."""
        super().__post_init__()
        require_finite("CAHVORE", linearity=self.linearity)

    @classmethod
    def _vector_names(cls) -> tuple[str, ...]:
        return ("C", "A", "H", "V", "O", "R", "E")

    @property
    def _unit_axis(self) -> FloatArray:
        return np.asarray(self.O / np.linalg.norm(self.O))

    def _angle_of(self, x: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Field angle of the linearised radius x, its derivative, and where it exists."""
        k = self.linearity
        if k > 1e-12:
            return np.arctan(k * x) / k, 1 / (1 + (k * x) ** 2), np.ones(len(x), dtype=bool)
        if k < -1e-12:
            inside = np.abs(k * x) < 1
            y = np.where(inside, k * x, 0.0)
            return np.arcsin(y) / k, 1 / np.sqrt(1 - y**2), inside
        return x, np.ones_like(x), np.ones(len(x), dtype=bool)

    def _radius_of(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Inverse of `_angle_of`, its derivative, and where it exists."""
        k = self.linearity
        inside = np.abs(k * theta) < np.pi / 2 - 1e-9
        y = np.where(inside, k * theta, 0.0)
        if k > 1e-12:
            return np.tan(y) / k, 1 / np.cos(y) ** 2, inside
        if k < -1e-12:
            return np.sin(y) / k, np.cos(y), inside
        return theta, np.ones_like(theta), np.ones(len(theta), dtype=bool)

    @property
    def pupil_moves(self) -> bool:
        """True: where a ray starts depends on its angle."""
        return True

    def _pupil(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Shift of the entrance pupil along O, metres, and its derivative by the field angle."""
        e0, e1, e2 = self.E
        t2 = theta**2
        small = np.abs(theta) < 1e-3
        safe = np.where(small, 1.0, theta)
        sin, cos = np.sin(safe), np.cos(safe)
        ratio = np.where(small, t2 / 6 + 7 * t2**2 / 360, safe / sin - 1)
        d_ratio = np.where(small, theta / 3 + 7 * theta**3 / 90, (sin - safe * cos) / sin**2)
        e = e0 + t2 * (e1 + t2 * e2)
        d_e = theta * (2 * e1 + 4 * e2 * t2)
        return ratio * e, d_ratio * e + ratio * d_e

    def project_with_jacobian(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Pixels, derivatives and validity; see `Camera.project_with_jacobian`.

        Newton's method finds the field angle: cos(th) |l| = sin(th) (z - s(th)).
        """
        axis = self._unit_axis
        d = points_m - self.C
        z = d @ axis
        lateral = d - z[:, None] * axis
        length = np.linalg.norm(lateral, axis=1)
        theta = np.arctan2(length, z)
        for _ in range(NEWTON_STEPS):
            s, d_s = self._pupil(theta)
            sin, cos = np.sin(theta), np.cos(theta)
            value = cos * length - sin * (z - s)
            slope = -sin * length - cos * (z - s) + sin * d_s
            step = value / np.where(np.abs(slope) < 1e-300, 1.0, slope)
            theta = theta - np.clip(step, -0.3, 0.3)
            if np.all(np.abs(step) < 1e-15 * (1 + np.abs(theta))):
                break
        s, d_s = self._pupil(theta)
        sin, cos = np.sin(theta), np.cos(theta)
        value = cos * length - sin * (z - s)
        slope = -sin * length - cos * (z - s) + sin * d_s
        distance = np.maximum(np.hypot(length, z), 1e-300)
        converged = (np.abs(value) < 1e-12 * (1 + distance)) & (theta >= -1e-12) & (theta < np.pi)
        # The shift of the pupil grows without bound with the angle; points nearer to C than it are not valid.
        converged &= sin * length + cos * z > np.abs(s) + _MIN_RANGE_M
        slope = np.where(np.abs(slope) < 1e-300, 1.0, slope)
        x, d_x, inside = self._radius_of(theta)
        r0, r1, r2 = self.R
        k = x * (1 + r0 + x**2 * (r1 + x**2 * r2))
        d_k = (1 + r0 + x**2 * (3 * r1 + x**2 * 5 * r2)) * d_x  # by theta

        # On the axis only the lateral direction is undefined: k / |l| has a limit.
        on_axis = length < 1e-12 * distance
        unit = lateral / np.where(on_axis, 1.0, length)[:, None]
        ray = axis + k[:, None] * unit
        d_theta = -(cos[:, None] * unit - sin[:, None] * axis) / slope[:, None]
        across = np.eye(3) - np.outer(axis, axis)
        gain = np.where(on_axis, d_k * -cos / slope, k / np.where(on_axis, 1.0, length))
        turn = across - unit[:, :, None] * unit[:, None, :]
        d_ray = unit[:, :, None] * (d_k[:, None] * d_theta)[:, None, :] + gain[:, None, None] * turn
        depth = ray @ self.A
        valid = converged & inside & (depth > MIN_DEPTH) & (d_k > 0)
        depth = np.where(valid, depth, 1.0)
        uv = np.stack([ray @ self.H, ray @ self.V], axis=1) / depth[:, None]
        d_uv = (np.stack([self.H, self.V]) - uv[:, :, None] * self.A) / depth[:, None, None]
        return uv, d_uv @ d_ray, valid

    def unproject_with_jacobian(self, uv_px: FloatArray) -> tuple[Rays, FloatArray, FloatArray]:
        """Rays and their derivatives; see `Camera.unproject_with_jacobian`."""
        axis = self._unit_axis
        linear, d_linear = self._linear_ray(uv_px)
        z = linear @ axis
        valid = z > MIN_DEPTH
        z = np.where(valid, z, 1.0)
        flat = linear / z[:, None]
        d_flat = (d_linear - flat[:, :, None] * np.einsum("i,nij->nj", axis, d_linear)[:, None, :]) / z[
            :, None, None
        ]
        lateral = flat - axis
        k = np.linalg.norm(lateral, axis=1)
        on_axis = k < 1e-12
        unit = lateral / np.where(on_axis, 1.0, k)[:, None]
        r0, r1, r2 = self.R
        x = k / (1 + r0)
        for _ in range(NEWTON_STEPS):
            value = x * (1 + r0 + x**2 * (r1 + x**2 * r2)) - k
            slope = 1 + r0 + x**2 * (3 * r1 + x**2 * 5 * r2)
            step = value / np.where(np.abs(slope) < 1e-12, 1.0, slope)
            x = x - step
            if np.all(np.abs(step) < 1e-15):
                break
        value = x * (1 + r0 + x**2 * (r1 + x**2 * r2)) - k
        slope = 1 + r0 + x**2 * (3 * r1 + x**2 * 5 * r2)
        theta, d_theta_x, inside = self._angle_of(x)
        valid = valid & inside & (np.abs(value) < 1e-10) & (slope > 0) & (theta < np.pi)
        d_theta = d_theta_x / np.where(np.abs(slope) < 1e-12, 1.0, slope)  # by k
        s, d_s = self._pupil(theta)
        sin, cos = np.sin(theta), np.cos(theta)
        direction = sin[:, None] * unit + cos[:, None] * axis
        origin = self.C + s[:, None] * axis

        d_k = np.einsum("ni,nij->nj", unit, d_flat)
        gain = np.where(on_axis, d_theta, sin / np.where(on_axis, 1.0, k))
        across = d_flat - unit[:, :, None] * d_k[:, None, :]
        along = cos[:, None] * unit - sin[:, None] * axis
        d_direction = along[:, :, None] * (d_theta[:, None] * d_k)[:, None, :] + gain[:, None, None] * across
        d_origin = axis[None, :, None] * ((d_s * d_theta)[:, None] * d_k)[:, None, :]
        return Rays(origin_m=origin, direction=direction, valid=valid), d_origin, d_direction

    # Directions alone do not describe a camera whose pupil moves: these two must not be inherited.
    def _undistort_direction(self, ray: FloatArray) -> tuple[FloatArray, BoolArray]:
        raise AssertionError("CAHVORE is not central")

    def _distort_with_jacobian(self, d: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        raise AssertionError("CAHVORE is not central")


@uncounted.part
def _pupil(p: FloatArray, row: int, angle: float, sin: float, cos: float) -> tuple[float, float]:
    """`CAHVORE._pupil` for compiled loops: the pupil's shift, metres, and its derivative by the angle."""
    square = angle * angle
    if abs(angle) < 1e-3:
        ratio, by_angle = square * (1 / 6 + 7 / 360 * square), angle * (1 / 3 + 7 / 90 * square)
    else:
        per_sin = 1.0 / sin
        ratio, by_angle = angle * per_sin - 1.0, (sin - angle * cos) * per_sin * per_sin
    e0, e1, e2 = p[row, 6], p[row, 7], p[row, 8]
    e = e0 + square * (e1 + square * e2)
    return ratio * e, by_angle * e + ratio * angle * (2.0 * e1 + 4.0 * e2 * square)


@uncounted.part
def _radius(linearity: float, angle: float) -> tuple[bool, float, float]:
    """Whether the linearised radius of a field angle exists; the radius, and its derivative by the angle."""
    y = linearity * angle
    inside = abs(y) < np.pi / 2 - 1e-9
    if abs(linearity) < _LEAST_L:
        return inside, angle, 1.0
    y = y if inside else 0.0
    sin, cos = np.sin(y), np.cos(y)
    if linearity > 0.0:
        return inside, sin / (cos * linearity), 1.0 / (cos * cos)
    return inside, sin / linearity, cos


@uncounted.part
def _distort(p: FloatArray, row: int, d0: float, d1: float, d2: float, w: float) -> Distorted:
    """The distortion of CAHVORE for compiled loops; see `Distortion`.

    The point d / w is seen at the field angle th with cos(th) |l| = sin(th) (z - w s(th)), for d = l + z O.
    The distorted ray is O + k(th) l / |l|; the derivatives of th follow from the equation's.
    """
    o0, o1, o2 = p[row, 0], p[row, 1], p[row, 2]
    z = d0 * o0 + d1 * o1 + d2 * o2
    l0, l1, l2 = d0 - z * o0, d1 - z * o1, d2 - z * o2
    length = np.sqrt(l0 * l0 + l1 * l1 + l2 * l2)
    distance = np.sqrt(length * length + z * z)
    angle = np.arctan2(length, z)
    found = distance > 0.0
    for _ in range(_STEPS):
        sin, cos = np.sin(angle), np.cos(angle)
        s, by_angle = _pupil(p, row, angle, sin, cos)
        slope = w * sin * by_angle - sin * length - cos * (z - w * s)
        found = found and slope < 0.0
        if not found:
            break
        step = (cos * length - sin * (z - w * s)) / slope
        angle -= min(max(step, -0.3), 0.3)
        if abs(step) < _NEXT_IS_EXACT:
            break
    sin, cos = np.sin(angle), np.cos(angle)
    s, by_angle = _pupil(p, row, angle, sin, cos)
    slope = w * sin * by_angle - sin * length - cos * (z - w * s)
    found = found and slope < 0.0 and abs(cos * length - sin * (z - w * s)) < 1e-12 * distance
    # The shift of the pupil grows without bound with the angle: no point nearer than it is in the domain.
    reach = sin * length + cos * z
    found = found and -1e-12 <= angle < np.pi and reach > abs(w) * (abs(s) + _MIN_RANGE_M)
    inside, x, by_x = _radius(p[row, 9], angle)
    if not (found and inside):
        return False, (o0, o1, o2), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0)
    r0, r1, r2, xx = p[row, 3], p[row, 4], p[row, 5], x * x
    k = x * (1.0 + r0 + xx * (r1 + xx * r2))
    by_k = (1.0 + r0 + xx * (3.0 * r1 + xx * 5.0 * r2)) * by_x
    per_slope = 1.0 / slope
    # On the axis l / |l| has no direction, but k / |l| has a limit.
    on_axis = length < 1e-12 * distance
    per_length = 0.0 if on_axis else 1.0 / length
    u0, u1, u2 = l0 * per_length, l1 * per_length, l2 * per_length
    gain = -by_k * cos * per_slope if on_axis else k * per_length
    along, across = -by_k * cos * per_slope, by_k * sin * per_slope
    # By the ray: gain (I - O O' - u u') + u (along u' + across O').
    g = along - gain
    h0, h1, h2 = g * u0 + across * o0, g * u1 + across * o1, g * u2 + across * o2
    by_ray = (
        (gain - gain * o0 * o0 + u0 * h0, u0 * h1 - gain * o0 * o1, u0 * h2 - gain * o0 * o2),
        (u1 * h0 - gain * o1 * o0, gain - gain * o1 * o1 + u1 * h1, u1 * h2 - gain * o1 * o2),
        (u2 * h0 - gain * o2 * o0, u2 * h1 - gain * o2 * o1, gain - gain * o2 * o2 + u2 * h2),
    )
    by_w = -across * s
    distorted = (o0 + k * u0, o1 + k * u1, o2 + k * u2)
    return by_k > 0.0, distorted, by_ray, (u0 * by_w, u1 * by_w, u2 * by_w)


def _parameters(camera: CAHVORE) -> FloatArray:
    return np.array([*camera._unit_axis, *camera.R, *camera.E, camera.linearity])


CAHVORE_LENS = Lens(
    name="cahvore",
    camera=CAHVORE,
    fields=(
        *CAHVOR_FIELDS,
        LensField(key="E", attribute="E", kind="vector", length=3),
        LensField(key="linearity", attribute="linearity"),
    ),
    cahv_vectors=lambda camera: own_vectors(camera) | {"linearity": camera.linearity},
    distortion=Distortion(length=10, parameters=_parameters, distort=_distort),
)
