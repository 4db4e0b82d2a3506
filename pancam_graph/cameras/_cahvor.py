"""CAHVOR: CAHV with radial distortion. Source: Gennery 2001; docs/method.md, section "CAHV family"."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.compiled import uncounted
from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras._cahv import CAHV, CAHV_FIELDS, MIN_DEPTH, NEWTON_STEPS, own_vectors
from pancam_graph.cameras._lens import Distorted, Distortion, Lens, LensField

__all__ = ["CAHVOR", "CAHVOR_FIELDS", "CAHVOR_LENS"]

_MIN_ALONG = 1e-12
"""Least component along O of a ray (d, w) of about unit length that counts as in front."""


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
        valid = w > MIN_DEPTH
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
        valid = w > MIN_DEPTH
        t = np.einsum("ni,ni->n", lateral, lateral) / np.where(valid, w, 1.0) ** 2
        u = np.full(len(ray), 1 / (1 + r0))
        for _ in range(NEWTON_STEPS):
            value = r2 * t**2 * u**5 + r1 * t * u**3 + (1 + r0) * u - 1
            slope = 5 * r2 * t**2 * u**4 + 3 * r1 * t * u**2 + 1 + r0
            step = value / np.where(np.abs(slope) < 1e-12, 1.0, slope)
            u = u - step
            if np.all(np.abs(step) < 1e-15):
                break
        value = r2 * t**2 * u**5 + r1 * t * u**3 + (1 + r0) * u - 1
        undistorted = ray - (1 - u)[:, None] * lateral
        # The polynomial assumes that O is a unit vector; one Newton step on the model itself does not.
        again, jacobian, _ = self._distort_with_jacobian(undistorted)
        undistorted = undistorted - np.linalg.solve(jacobian, (again - ray)[..., None])[..., 0]
        return undistorted, valid & (np.abs(value) < 1e-10) & (u > 0)


CAHVOR_FIELDS = (
    *CAHV_FIELDS,
    LensField(key="O", attribute="O", kind="vector", length=3),
    LensField(key="R", attribute="R", kind="vector", length=3),
)


@uncounted.part
def _distort(p: FloatArray, row: int, d0: float, d1: float, d2: float, w: float) -> Distorted:
    """The distortion of CAHVOR for compiled loops; see `Distortion`. Its pupil does not move with w."""
    o0, o1, o2, r0, r1, r2 = p[row, 0], p[row, 1], p[row, 2], p[row, 3], p[row, 4], p[row, 5]
    along = d0 * o0 + d1 * o1 + d2 * o2
    ahead = along > _MIN_ALONG
    per_along = 1.0 / (along if ahead else 1.0)
    l0, l1, l2 = d0 - along * o0, d1 - along * o1, d2 - along * o2
    # The tangent of the angle to O, in front; l and O are orthogonal as far as O is a unit vector.
    a0, a1, a2 = l0 * per_along, l1 * per_along, l2 * per_along
    t = a0 * a0 + a1 * a1 + a2 * a2
    t = t if ahead else 0.0
    m = r0 + t * (r1 + t * r2)
    by_t = r1 + 2.0 * t * r2
    aslant = a0 * o0 + a1 * o1 + a2 * o2 + t
    g = 2.0 * by_t * per_along
    g0, g1, g2 = g * (a0 - aslant * o0), g * (a1 - aslant * o1), g * (a2 - aslant * o2)
    by_ray = (
        (1.0 + m - m * o0 * o0 + l0 * g0, l0 * g1 - m * o0 * o1, l0 * g2 - m * o0 * o2),
        (l1 * g0 - m * o1 * o0, 1.0 + m - m * o1 * o1 + l1 * g1, l1 * g2 - m * o1 * o2),
        (l2 * g0 - m * o2 * o0, l2 * g1 - m * o2 * o1, 1.0 + m - m * o2 * o2 + l2 * g2),
    )
    growing = 1.0 + m + 2.0 * t * by_t > 0.0
    return ahead and growing, (d0 + m * l0, d1 + m * l1, d2 + m * l2), by_ray, (0.0, 0.0, 0.0)


CAHVOR_LENS = Lens(
    name="cahvor",
    camera=CAHVOR,
    fields=CAHVOR_FIELDS,
    cahv_vectors=own_vectors,
    distortion=Distortion(length=6, parameters=lambda camera: [*camera.O, *camera.R], distort=_distort),
)
