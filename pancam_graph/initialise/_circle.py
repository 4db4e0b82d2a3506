"""A circle in space fitted to camera centres: the pan axis of a mast when only camera matrices are known."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.arrays import float_array
from pancam_graph.base.errors import GeometryError
from pancam_graph.base.geometry import FloatArray

__all__ = ["CircleFit", "fit_circle"]

_SHORT_ARC_RAD = np.pi / 2
_LINE = 1e5
"""Radius over spread of the centres above which a circle counts as a line: its arc bends by less than a
millionth of the spread."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CircleFit:
    """A circle in space, thesis eq. 4.8: points R [rho cos(phi), rho sin(phi), 0] + C."""

    centre_m: FloatArray
    """(3,) in the frame of the points."""
    rotation: FloatArray
    """(3, 3) R; its z axis is the circle's normal, its x axis points to the first centre."""
    radius_m: float
    """rho, the radius of the circle."""
    angle_rad: FloatArray
    """(n,) phi of each point; the first is 0."""
    residual_m: FloatArray
    """(n, 2) from the circle to each point: radially outwards, and along the normal."""
    arc_rad: float
    """Extent of the points along the circle."""
    centre_sigma_m: float
    """Formal standard deviation of the centre's worst coordinate in the plane; NaN for three points."""

    @property
    def short_arc(self) -> bool:
        """Whether the arc is less than a quarter circle: centre and radius are then hardly separable."""
        return self.arc_rad < _SHORT_ARC_RAD


def fit_circle(centres_m: FloatArray, up: FloatArray | None = None) -> CircleFit:
    """Least-squares circle through n centres (n, 3): plane first, then the circle in it.

    `up` (3,) chooses the normal's sign; default: the sense in which the points follow each other is
    anticlockwise. Geometric fit (Gauss-Newton from the algebraic one, Gander et al. 1994).

    Raises GeometryError for fewer than three centres, for centres that coincide, and for collinear ones or
    those that a line fits as well as any circle, where no circle is determined.
    """
    points = float_array("circle", centres_m, GeometryError)
    n = len(points)
    if points.shape != (n, 3) or n < 3:
        raise GeometryError(f"circle: expected at least 3 centres, found {n}")
    if not np.all(np.isfinite(points)):
        raise GeometryError("circle: expected finite centres")
    mean = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - mean, full_matrices=False)
    if spread[0] < 1e-9:
        raise GeometryError(
            f"circle: the {n} centres coincide within {spread[0]:.1e} m; no circle is determined"
        )
    if spread[1] < 1e-6 * spread[0]:
        raise GeometryError(
            f"circle: the {n} centres are collinear within {spread[1]:.1e} m; no circle is determined"
        )
    normal = axes[2] if len(axes) == 3 else np.cross(axes[0], axes[1])
    flat = (points - mean) @ axes[:2].T

    # Algebraic fit, |p|^2 = 2 p.c + (rho^2 - |c|^2); Gauss-Newton on the geometric distances follows.
    design = np.column_stack([2 * flat, np.ones(n)])
    solution, *_ = np.linalg.lstsq(design, np.sum(flat**2, axis=1), rcond=None)
    centre, radius = solution[:2], float(np.sqrt(max(solution[2] + solution[:2] @ solution[:2], 1e-300)))
    jacobian = np.empty((n, 3))
    for _ in range(50):
        arm = flat - centre
        distance = np.linalg.norm(arm, axis=1).clip(1e-12)
        jacobian = np.column_stack([-arm / distance[:, None], -np.ones(n)])
        step, *_ = np.linalg.lstsq(jacobian, -(distance - radius), rcond=None)
        centre, radius = centre + step[:2], radius + float(step[2])
        if np.linalg.norm(step) < 1e-14 * (1 + radius) or radius > _LINE * spread[0]:
            break
    if radius > _LINE * spread[0]:
        raise GeometryError(
            f"circle: a line fits the {n} centres as well as any circle; no circle is determined"
        )
    arm = flat - centre
    distance = np.linalg.norm(arm, axis=1)
    phi = np.unwrap(np.arctan2(arm[:, 1], arm[:, 0]))
    turn = np.sign(phi[-1] - phi[0]) or 1.0
    z = normal * np.sign(np.linalg.det(np.vstack([axes[:2], normal])))
    z_wanted = z * (turn if up is None else np.sign(z @ up) or 1.0)
    if z_wanted @ z < 0:
        phi = -phi
    x = (points[0] - mean) @ axes[:2].T - centre
    x_axis = x @ axes[:2] / np.linalg.norm(x)
    residual = np.column_stack([distance - radius, (points - mean) @ z_wanted])
    sigma = np.nan
    if n > 3:
        variance = float(np.sum(residual[:, 0] ** 2) / (n - 3))
        covariance = variance * np.linalg.inv(jacobian.T @ jacobian)
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    return CircleFit(
        centre_m=mean + centre @ axes[:2],
        rotation=np.column_stack([x_axis, np.cross(z_wanted, x_axis), z_wanted]),
        radius_m=radius,
        angle_rad=phi - phi[0],
        residual_m=residual,
        arc_rad=_arc(phi),
        centre_sigma_m=sigma,
    )


def _arc(phi: FloatArray) -> float:
    """Smallest arc that holds all angles: the full turn less the largest gap."""
    sorted_phi = np.sort(np.mod(phi, 2 * np.pi))
    gaps = np.diff(np.append(sorted_phi, sorted_phi[0] + 2 * np.pi))
    return float(2 * np.pi - gaps.max())
