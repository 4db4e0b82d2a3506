"""CAHVOR: CAHV with radial distortion. Source: Gennery 2001; docs/method.md, section "CAHV family"."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras._cahv import CAHV, CAHV_FIELDS, MIN_DEPTH, NEWTON_STEPS, own_vectors
from pancam_graph.cameras._lens import Lens, LensField

__all__ = ["CAHVOR", "CAHVOR_FIELDS", "CAHVOR_LENS"]


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
CAHVOR_LENS = Lens(name="cahvor", camera=CAHVOR, fields=CAHVOR_FIELDS, cahv_vectors=own_vectors)
