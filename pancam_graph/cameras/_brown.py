"""Pinhole with Brown distortion."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pancam_graph.base.compiled import uncounted
from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras._camera import PINHOLE_FIELDS, Pinhole, require_finite
from pancam_graph.cameras._lens import Distorted, Distortion, Lens, LensField, linear_vectors

__all__ = ["BROWN_LENS", "Brown"]

_BROWN_STEPS = 50
_BROWN_TOLERANCE = 1e-14
_MIN_DEPTH = 1e-12
"""Least depth of a ray (d, w) of about unit length that counts as in front."""


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

    @cached_property
    def fold_r2(self) -> float:
        """Squared normalised radius where the radial distortion folds back; infinite where it never does."""
        k1, k2, _, _, k3 = self.distortion
        slope = np.array([7 * k3, 5 * k2, 3 * k1, 1.0])  # of the distorted radius, a polynomial in r2
        roots = np.roots(slope)
        real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
        return float(real.min(initial=np.inf))

    def in_domain(self, xy: FloatArray, d_distort: FloatArray) -> BoolArray:
        """Whether points are before the fold; see `Pinhole.in_domain`."""
        return np.asarray((np.sum(xy**2, axis=1) < self.fold_r2) & (np.linalg.det(d_distort) > 0))

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
        return xy, (error < 1e-10) & self.in_domain(xy, d)


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


@uncounted.part
def _distort(p: FloatArray, row: int, d0: float, d1: float, d2: float, w: float) -> Distorted:
    """`Brown.distort` for compiled loops; see `Distortion`. Beyond the fold nothing is in the domain."""
    ahead = d2 > _MIN_DEPTH
    per_depth = 1.0 / (d2 if ahead else 1.0)
    x, y = d0 * per_depth, d1 * per_depth
    k1, k2, p1, p2, k3 = p[row, 0], p[row, 1], p[row, 2], p[row, 3], p[row, 4]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    by_r2 = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    xx = radial + 2.0 * x * x * by_r2 + 2.0 * p1 * y + 6.0 * p2 * x
    xy = 2.0 * x * y * by_r2 + 2.0 * p1 * x + 2.0 * p2 * y
    yy = radial + 2.0 * y * y * by_r2 + 6.0 * p1 * y + 2.0 * p2 * x
    distorted = (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        1.0,
    )
    by_ray = (
        (xx * per_depth, xy * per_depth, -(xx * x + xy * y) * per_depth),
        (xy * per_depth, yy * per_depth, -(xy * x + yy * y) * per_depth),
        (0.0, 0.0, 0.0),
    )
    within = r2 < p[row, 5] and xx * yy - xy * xy > 0.0
    return ahead and within, distorted, by_ray, (0.0, 0.0, 0.0)


def _parameters(camera: Brown) -> FloatArray:
    return np.array([*camera.distortion, camera.fold_r2])


BROWN_LENS = Lens(
    name="brown",
    camera=Brown,
    fields=(*PINHOLE_FIELDS, LensField(key="distortion", attribute="distortion", kind="vector", length=5)),
    cahv_vectors=_cahv_vectors,
    distortion=Distortion(length=6, parameters=_parameters, distort=_distort),
)
