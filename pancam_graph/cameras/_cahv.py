"""CAHV: the linear camera model of planetary rovers, as vectors in one frame.

Source: Yakimovsky and Cunningham 1978. The formulas, with d = P - C, are those of docs/method.md,
section "CAHV family".
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import scipy

from pancam_graph.base.arrays import float_array
from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras._camera import Camera, Pinhole, Rays, require_finite
from pancam_graph.cameras._lens import Lens, LensField

__all__ = ["CAHV", "CAHV_FIELDS", "CAHV_LENS", "MIN_DEPTH", "NEWTON_STEPS", "own_vectors"]

NEWTON_STEPS = 100
"""Most iterations of an inverse of the distortion."""
MIN_DEPTH = 1e-9
"""Least component along an axis, metres, of a point that counts as in front."""


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
            value = float_array(name, getattr(self, name), CameraError).copy()
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
        k, camera_R_frame = scipy.linalg.rq(np.array([self.H, self.V, self.A]))
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
        valid = valid & (depth > MIN_DEPTH)
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


def own_vectors(camera: CAHV) -> dict[str, FloatArray]:
    """The vectors of a camera of the family by their letters."""
    return {name: getattr(camera, name) for name in camera._vector_names()}


CAHV_FIELDS = (
    LensField(key="C_m", attribute="C", kind="vector", length=3),
    LensField(key="A", attribute="A", kind="vector", length=3),
    LensField(key="H_px", attribute="H", kind="vector", length=3),
    LensField(key="V_px", attribute="V", kind="vector", length=3),
)
CAHV_LENS = Lens(name="cahv", camera=CAHV, fields=CAHV_FIELDS, cahv_vectors=own_vectors, distortion=None)
