"""Pinhole with Brown distortion."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras._camera import PINHOLE_FIELDS, Pinhole, require_finite
from pancam_graph.cameras._lens import Lens, LensField, linear_vectors

__all__ = ["BROWN_LENS", "Brown"]

_BROWN_STEPS = 50
_BROWN_TOLERANCE = 1e-14


@dataclass(frozen=True, kw_only=True)
class Brown(Pinhole):
    """Pinhole with Brown-Conrady distortion k1, k2, p1, p2, k3, in OpenCV's order and sense.

    Source: Brown, Close-range camera calibration, 1971; OpenCV's `projectPoints`.
    """

    distortion: tuple[float, float, float, float, float]
    """k1, k2 (radial), p1, p2 (tangential), k3 (radial), in normalised coordinates."""

    def __post_init__(self) -> None:
        """Check the coefficients."""
        super().__post_init__()
        if len(self.distortion) != 5:
            raise CameraError(
                f"distortion: expected k1, k2, p1, p2, k3, found {len(self.distortion)} numbers"
            )
        require_finite("brown", distortion=np.array(self.distortion))

    def distort(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distorted normalised coordinates (n, 2) and their derivative (n, 2, 2)."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        d_radial = k1 + r2 * (2 * k2 + r2 * 3 * k3)  # by r2
        out = np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )
        d = np.empty((len(xy), 2, 2))
        d[:, 0, 0] = radial + 2 * x * x * d_radial + 2 * p1 * y + 6 * p2 * x
        d[:, 0, 1] = d[:, 1, 0] = 2 * x * y * d_radial + 2 * p1 * x + 2 * p2 * y
        d[:, 1, 1] = radial + 2 * y * y * d_radial + 6 * p1 * y + 2 * p2 * x
        return out, d

    def undistort(self, xy_distorted: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Inverse of `distort` by Newton's method, and where it converged to the undistorted side.

        Beyond the radius where the distortion folds back, no inverse exists and the point is invalid.
        """
        xy = xy_distorted.copy()
        for _ in range(_BROWN_STEPS):
            value, d = self.distort(xy)
            det = np.linalg.det(d)
            d = np.where((np.abs(det) < 1e-6)[:, None, None], np.eye(2), d)
            step = np.linalg.solve(d, (xy_distorted - value)[..., None])[..., 0]
            limit = np.maximum(1.0, np.linalg.norm(xy, axis=1))
            length = np.linalg.norm(step, axis=1)
            step *= np.minimum(1.0, limit / np.maximum(length, 1e-300))[:, None]
            xy = xy + step
            if np.all(length <= _BROWN_TOLERANCE * limit):
                break
        value, d = self.distort(xy)
        error = np.linalg.norm(value - xy_distorted, axis=1)
        return xy, (error < 1e-10) & (np.linalg.det(d) > 0)


def _cahv_vectors(camera: Brown) -> dict[str, FloatArray]:
    """The same lens as CAHVOR: O = A and R = (0, k1, k2). Without distortion CAHV.

    With w = z, CAHVOR's t is the squared radius of Brown 1971, and d' differs from d in x and y alone.
    Raises CameraError for p1, p2 or k3, of which CAHVOR has no equal.
    """
    linear = linear_vectors(camera.calibration_matrix)
    if not any(camera.distortion):
        return linear
    k1, k2, p1, p2, k3 = camera.distortion
    if p1 or p2 or k3:
        raise CameraError(
            f"distortion: expected k1 and k2 alone, all that CAHVOR can say, found p1 {p1:g}, p2 {p2:g}, "
            f"k3 {k3:g}"
        )
    return linear | {"O": linear["A"], "R": np.array([0.0, k1, k2])}


BROWN_LENS = Lens(
    name="brown",
    camera=Brown,
    fields=(*PINHOLE_FIELDS, LensField(key="distortion", attribute="distortion", kind="vector", length=5)),
    cahv_vectors=_cahv_vectors,
)
