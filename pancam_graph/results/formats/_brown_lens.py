"""A camera as a pinhole with Brown's distortion, the lens that other programs know."""

from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHVOR, Brown, Camera, Pinhole, without_field

__all__ = ["BrownLens", "brown_lens"]

_ACROSS = 33
_EXACT_PX = 1e-8
"""Largest difference of a lens that counts as the same."""
_EVALUATIONS = 200


@dataclass(frozen=True, kw_only=True)
class BrownLens:
    """A lens of Brown's and how far it is from the camera that it stands for."""

    lens: Brown
    max_px: float
    """Largest distance of its pixels from the camera's, over the image."""
    rms_px: float
    range_m: float
    """Range at which the two were compared; it matters only where the entrance pupil moves."""


def brown_lens(camera: Camera, range_m: float, *, skew: bool) -> BrownLens:
    """The lens of Brown's, about the camera's own axes, that is nearest to a camera over its image.

    A pinhole, a Brown lens, a CAHV and a CAHVOR whose optical axis is its A have an equal (where `skew`
    allows). For others, and for smooth fields, focal lengths, principal point, skew and the five
    coefficients are fitted to lines of sight of 33 x 33 pixels at `range_m`, metres; what is left is in the
    result. Pixels without a line of sight do not count.
    """
    uv, points = _sight(camera, range_m)
    start = _candidate(camera)
    if not skew and start.skew_px:
        start = replace(start, skew_px=0.0)
    off = _off(start, uv, points)
    if not off.max(initial=0.0) <= _EXACT_PX:
        start = _fitted(start, uv, points, skew=skew)
        off = _off(start, uv, points)
    return BrownLens(
        lens=start,
        max_px=float(off.max(initial=0.0)),
        rms_px=float(np.sqrt(np.mean(off**2))) if len(off) else 0.0,
        range_m=range_m,
    )


def _sight(camera: Camera, range_m: float) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) over the image, and points (n, 3) on their lines of sight."""
    u, v = (np.linspace(0, n - 1, _ACROSS) for n in (camera.width_px, camera.height_px))
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = camera.unproject(uv)
    points = rays.origin_m + range_m * rays.direction
    seen, valid = camera.project(points)
    valid &= rays.valid & (points[:, 2] > 0) & (np.linalg.norm(seen - uv, axis=1) < _EXACT_PX)
    return uv[valid], points[valid]


def _candidate(camera: Camera) -> Brown:
    """The lens that is the camera's equal if there is one, else near it."""
    lens = without_field(camera)
    if isinstance(lens, Brown):
        return lens
    pinhole: Pinhole = lens.pinhole
    k = (0.0, 0.0, 0.0, 0.0, 0.0)
    if isinstance(lens, CAHVOR):
        # About O = A, CAHVOR's t is Brown's r^2; r0 only changes the focal lengths.
        r0, r1, r2 = lens.R.tolist()
        k = (r1 / (1 + r0), r2 / (1 + r0), 0.0, 0.0, 0.0)
        pinhole = replace(
            pinhole,
            fx_px=pinhole.fx_px * (1 + r0),
            fy_px=pinhole.fy_px * (1 + r0),
            skew_px=pinhole.skew_px * (1 + r0),
        )
    return Brown(
        width_px=camera.width_px,
        height_px=camera.height_px,
        fx_px=pinhole.fx_px,
        fy_px=pinhole.fy_px,
        cx_px=pinhole.cx_px,
        cy_px=pinhole.cy_px,
        skew_px=pinhole.skew_px,
        distortion=k,
    )


def _off(lens: Brown, uv: FloatArray, points: FloatArray) -> FloatArray:
    seen, valid = lens.project(points)
    return np.where(valid, np.linalg.norm(seen - uv, axis=1), np.inf)


def _fitted(start: Brown, uv: FloatArray, points: FloatArray, *, skew: bool) -> Brown:
    """The lens nearest to pixels (n, 2) of points (n, 3).

    Pixels are linear in all but the product of focal length and distortion, so that a few steps suffice.
    """
    xy = points[:, :2] / points[:, 2:]
    scale = start.fx_px

    def lens_of(p: FloatArray) -> Brown:
        return replace(
            start,
            fx_px=float(scale * p[0]),
            fy_px=float(scale * p[1]),
            cx_px=float(scale * p[2]),
            cy_px=float(scale * p[3]),
            distortion=(float(p[4]), float(p[5]), float(p[6]), float(p[7]), float(p[8])),
            skew_px=float(scale * p[9]) if skew else 0.0,
        )

    def residual(p: FloatArray) -> FloatArray:
        lens = lens_of(p)
        k = lens.calibration_matrix
        return np.asarray((lens.distort(xy)[0] @ k[:2, :2].T + k[:2, 2] - uv).ravel())

    first = np.array(
        [
            1.0,
            start.fy_px / scale,
            start.cx_px / scale,
            start.cy_px / scale,
            *start.distortion,
            *([start.skew_px / scale] if skew else []),
        ]
    )
    found = scipy.optimize.least_squares(
        residual, first, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=_EVALUATIONS
    )
    return lens_of(found.x)
