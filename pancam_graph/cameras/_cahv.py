"""CAHV, CAHVOR and CAHVORE: the camera models of planetary rovers, as vectors in one frame.

Sources: Yakimovsky and Cunningham 1978 (CAHV); Gennery 2001 and 2006 (CAHVOR, CAHVORE). The
formulas, with d = P - C, are those of docs/method.md, section "CAHV family".
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import rq

from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras._camera import Camera, Pinhole, Rays, require_finite

__all__ = ["CAHV", "CAHVOR", "CAHVORE", "cahv_of_vectors"]

_NEWTON_STEPS = 100
_MIN_DEPTH = 1e-9
_MIN_RANGE_M = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class CAHV(Camera):
    """Linear camera given by its centre C, axis A, and the vectors H and V.

    u = d.H / d.A and v = d.V / d.A with d = P - C. All vectors are in one frame, which is the
    camera's own only if C = 0 and A, H, V have been turned there (see `split`).
    """

    C: FloatArray
    """(3,) centre of projection, metres."""
    A: FloatArray
    """(3,) unit axis, normal to the image plane."""
    H: FloatArray
    """(3,) horizontal vector, pixels: fx times the image's x axis plus cx A."""
    V: FloatArray
    """(3,) vertical vector, pixels: fy times the image's y axis plus cy A."""

    def __post_init__(self) -> None:
        """Turn the vectors to arrays and check them."""
        super().__post_init__()
        for name in self._vector_names():
            value = np.array(getattr(self, name), dtype=float)
            if value.shape != (3,):
                raise CameraError(f"{name}: expected 3 numbers, found {value.tolist()}")
            value.flags.writeable = False
            object.__setattr__(self, name, value)
            require_finite(type(self).__name__, **{name: value})
        if np.linalg.norm(self.A) < 1e-9:
            raise CameraError(f"A: expected a vector of length 1, found {self.A.tolist()}")
        for name, vector in (("H", self.H), ("V", self.V)):
            if np.linalg.norm(np.cross(self.A, vector)) < 1e-6:
                raise CameraError(
                    f"focal length: expected |A x {name}| above 0, found {name} = {vector.tolist()}"
                )
        if self.A @ np.cross(self.H, self.V) <= 0:
            raise CameraError(
                "A, H, V: expected a right-handed camera, A.(H x V) above 0; found a mirrored one"
            )

    @classmethod
    def _vector_names(cls) -> tuple[str, ...]:
        return ("C", "A", "H", "V")

    @property
    def fx_px(self) -> float:
        """Focal length in columns, |A x H|."""
        return float(np.linalg.norm(np.cross(self.A, self.H)))

    @property
    def fy_px(self) -> float:
        """Focal length in rows, |A x V|."""
        return float(np.linalg.norm(np.cross(self.A, self.V)))

    @property
    def cx_px(self) -> float:
        """Column of the principal point, A.H."""
        return float(self.A @ self.H)

    @property
    def cy_px(self) -> float:
        """Row of the principal point, A.V."""
        return float(self.A @ self.V)

    def _split_axes(self) -> tuple[FloatArray, FloatArray]:
        # [H; V; A] = K R exactly; the five numbers of K take up that A, H, V are never quite orthogonal.
        k, camera_R_frame = rq(np.array([self.H, self.V, self.A]))
        sign = np.diag(np.sign(np.diag(k)))
        k, camera_R_frame = k @ sign, sign @ camera_R_frame
        return k / k[2, 2], camera_R_frame

    @property
    def pinhole(self) -> Pinhole:
        """The pinhole of the same A, H, V; its five numbers represent them exactly (RQ decomposition)."""
        k, _ = self._split_axes()
        return Pinhole(
            width_px=self.width_px,
            height_px=self.height_px,
            fx_px=float(k[0, 0]),
            fy_px=float(k[1, 1]),
            cx_px=float(k[0, 2]),
            cy_px=float(k[1, 2]),
            skew_px=float(k[0, 1]),
        )

    def with_calibration(self, calibration: FloatArray) -> "CAHV":
        """The same camera with another K; see `Camera.with_calibration`. Distortion stays about O."""
        if not (calibration[0, 0] > 0 and calibration[1, 1] > 0):
            found = f"{calibration[0, 0]} and {calibration[1, 1]}"
            raise CameraError(f"focal length: expected fx_px and fy_px above 0, found {found}")
        _, camera_R_frame = self._split_axes()
        H, V = float(np.linalg.norm(self.A)) * calibration[:2] @ camera_R_frame
        return replace(self, H=H, V=V)

    def split(self) -> tuple["CAHV", gtsam.Pose3]:
        """This camera in its own camera frame, and `frame_T_camera` which brings it back.

        The camera frame has its origin at C, z along A and y orthogonal to A in the plane of A and V.
        """
        _, camera_R_frame = self._split_axes()
        frame_T_camera = gtsam.Pose3(gtsam.Rot3(camera_R_frame.T), self.C)
        return self.transformed(frame_T_camera.inverse()), frame_T_camera

    def transformed(self, to_T_frame: gtsam.Pose3) -> "CAHV":
        """The same camera with its vectors in another frame."""
        rotation, translation = to_T_frame.rotation().matrix(), to_T_frame.translation()
        turned = {n: rotation @ getattr(self, n) for n in self._vector_names() if n not in "CRE"}
        return replace(self, C=rotation @ self.C + translation, **turned)

    def _undistort_direction(self, ray: FloatArray) -> tuple[FloatArray, BoolArray]:
        return ray, np.ones(len(ray), dtype=bool)

    def _distort_with_jacobian(self, d: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        return d, np.broadcast_to(np.eye(3), (len(d), 3, 3)), np.ones(len(d), dtype=bool)

    def project_with_jacobian(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Pixels, derivatives and validity; see `Camera.project_with_jacobian`."""
        d, d_distort, valid = self._distort_with_jacobian(points_m - self.C)
        depth = d @ self.A
        valid = valid & (depth > _MIN_DEPTH)
        depth = np.where(valid, depth, 1.0)
        uv = np.stack([d @ self.H, d @ self.V], axis=1) / depth[:, None]
        d_uv = (np.stack([self.H, self.V]) - uv[:, :, None] * self.A) / depth[:, None, None]
        return uv, d_uv @ d_distort, valid

    def _linear_ray(self, uv_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Ray of the linear part, scaled to unit depth along A, and its derivative (n, 3, 2)."""
        h = self.H - uv_px[:, :1] * self.A
        v = self.V - uv_px[:, 1:] * self.A
        scale = float(
            self.A @ np.cross(self.H, self.V)
        )  # (H - uA) x (V - vA) . A is the same for every pixel
        ray = np.cross(h, v) / scale
        d_ray = np.stack([np.cross(-self.A, v), np.cross(h, np.broadcast_to(-self.A, h.shape))], -1) / scale
        return ray, d_ray

    def unproject_with_jacobian(self, uv_px: FloatArray) -> tuple[Rays, FloatArray, FloatArray]:
        """Rays and their derivatives; see `Camera.unproject_with_jacobian`."""
        linear, d_linear = self._linear_ray(uv_px)
        ray, valid = self._undistort_direction(linear)
        # The distortion commutes with scaling, so its inverse's derivative follows from the forward one.
        _, d_distort, forward_valid = self._distort_with_jacobian(ray)
        d_ray = np.linalg.solve(d_distort, d_linear)
        norm = np.linalg.norm(ray, axis=1)
        direction = ray / norm[:, None]
        along = np.einsum("ni,nij->nj", direction, d_ray)
        d_direction = (d_ray - direction[:, :, None] * along[:, None, :]) / norm[:, None, None]
        origin = np.broadcast_to(self.C, direction.shape).copy()
        rays = Rays(origin_m=origin, direction=direction, valid=valid & forward_valid)
        return rays, np.zeros_like(d_direction), d_direction


@dataclass(frozen=True, kw_only=True, eq=False)
class CAHVOR(CAHV):
    """CAHV with radial distortion R about the optical axis O (which need not be A).

    w = d.O, l = d - w O, t = |l|^2 / w^2, d' = d + (r0 + r1 t + r2 t^2) l, then CAHV with d'.
    """

    O: FloatArray  # noqa: E741  the literature's name of the optical axis
    """(3,) unit optical axis; printed digits leave it 1e-7 off unit length, and it is used as it stands."""
    R: FloatArray
    """(3,) radial coefficients r0, r1, r2."""

    def __post_init__(self) -> None:
        """Check the optical axis."""
        super().__post_init__()
        if abs(float(np.linalg.norm(self.O)) - 1) > 1e-3:
            raise CameraError(f"O: expected a vector of length 1, found {self.O.tolist()}")

    @classmethod
    def _vector_names(cls) -> tuple[str, ...]:
        return ("C", "A", "H", "V", "O", "R")

    def _distort_with_jacobian(self, d: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        r0, r1, r2 = self.R
        w = d @ self.O
        valid = w > _MIN_DEPTH
        w = np.where(valid, w, 1.0)
        lateral = d - (d @ self.O)[:, None] * self.O
        t = np.where(valid, np.einsum("ni,ni->n", lateral, lateral) / w**2, 0.0)
        m = r0 + t * (r1 + t * r2)
        d_m = r1 + 2 * t * r2
        across = np.eye(3) - np.outer(self.O, self.O)
        d_t = 2 * (lateral @ across / w[:, None] - t[:, None] * self.O) / w[:, None]
        jacobian = (
            np.eye(3) + m[:, None, None] * across + lateral[:, :, None] * (d_m[:, None] * d_t)[:, None, :]
        )
        # Past the turning point of the radial polynomial a second, false image appears: not valid there.
        growing = 1 + m + 2 * t * d_m > 0
        return d + m[:, None] * lateral, jacobian, valid & growing

    def _undistort_direction(self, ray: FloatArray) -> tuple[FloatArray, BoolArray]:
        r0, r1, r2 = self.R
        w = ray @ self.O
        lateral = ray - w[:, None] * self.O
        valid = w > _MIN_DEPTH
        t = np.einsum("ni,ni->n", lateral, lateral) / np.where(valid, w, 1.0) ** 2
        u = np.full(len(ray), 1 / (1 + r0))
        for _ in range(_NEWTON_STEPS):
            value = r2 * t**2 * u**5 + r1 * t * u**3 + (1 + r0) * u - 1
            slope = 5 * r2 * t**2 * u**4 + 3 * r1 * t * u**2 + 1 + r0
            step = value / np.where(np.abs(slope) < 1e-12, 1.0, slope)
            u = u - step
            if np.all(np.abs(step) < 1e-15):
                break
        value = r2 * t**2 * u**5 + r1 * t * u**3 + (1 + r0) * u - 1
        found = ray - (1 - u)[:, None] * lateral
        # The polynomial takes O for a unit vector; one Newton step on the model itself takes it as it is.
        again, jacobian, _ = self._distort_with_jacobian(found)
        found = found - np.linalg.solve(jacobian, (again - ray)[..., None])[..., 0]
        return found, valid & (np.abs(value) < 1e-10) & (u > 0)


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
        for _ in range(_NEWTON_STEPS):
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
        # The pupil's shift grows without bound to the side; points nearer to C than it are outside the model.
        converged &= sin * length + cos * z > np.abs(s) + _MIN_RANGE_M
        slope = np.where(np.abs(slope) < 1e-300, 1.0, slope)
        x, d_x, inside = self._radius_of(theta)
        r0, r1, r2 = self.R
        k = x * (1 + r0 + x**2 * (r1 + x**2 * r2))
        d_k = (1 + r0 + x**2 * (3 * r1 + x**2 * 5 * r2)) * d_x  # by theta

        # On the axis the lateral direction is undefined, and so is nothing else: k / |l| has a limit.
        on_axis = length < 1e-12 * distance
        unit = lateral / np.where(on_axis, 1.0, length)[:, None]
        ray = axis + k[:, None] * unit
        d_theta = -(cos[:, None] * unit - sin[:, None] * axis) / slope[:, None]
        across = np.eye(3) - np.outer(axis, axis)
        gain = np.where(on_axis, d_k * -cos / slope, k / np.where(on_axis, 1.0, length))
        turn = across - unit[:, :, None] * unit[:, None, :]
        d_ray = unit[:, :, None] * (d_k[:, None] * d_theta)[:, None, :] + gain[:, None, None] * turn
        depth = ray @ self.A
        valid = converged & inside & (depth > _MIN_DEPTH) & (d_k > 0)
        depth = np.where(valid, depth, 1.0)
        uv = np.stack([ray @ self.H, ray @ self.V], axis=1) / depth[:, None]
        d_uv = (np.stack([self.H, self.V]) - uv[:, :, None] * self.A) / depth[:, None, None]
        return uv, d_uv @ d_ray, valid

    def unproject_with_jacobian(self, uv_px: FloatArray) -> tuple[Rays, FloatArray, FloatArray]:
        """Rays and their derivatives; see `Camera.unproject_with_jacobian`."""
        axis = self._unit_axis
        linear, d_linear = self._linear_ray(uv_px)
        z = linear @ axis
        valid = z > _MIN_DEPTH
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
        for _ in range(_NEWTON_STEPS):
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

    # The pupil moves: directions alone do not describe this camera, and nothing may use these by mistake.
    def _undistort_direction(self, ray: FloatArray) -> tuple[FloatArray, BoolArray]:
        raise AssertionError("CAHVORE is not central")

    def _distort_with_jacobian(self, d: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        raise AssertionError("CAHVORE is not central")


def cahv_of_vectors(
    width_px: int, height_px: int, vectors: Mapping[str, FloatArray], linearity: float = 1.0
) -> CAHV:
    """The model whose vectors, each (3,), these are by letter: CAHV, with O and R CAHVOR, with E CAHVORE.

    `linearity` is CAHVORE's. Raises CameraError for vectors that make no camera.
    """
    own = dict(vectors)
    if "E" in own:
        return CAHVORE(width_px=width_px, height_px=height_px, linearity=linearity, **own)
    return (CAHVOR if "R" in own else CAHV)(width_px=width_px, height_px=height_px, **own)
