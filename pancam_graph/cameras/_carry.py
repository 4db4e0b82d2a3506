"""Carry measured pixels of a distorted camera to the pinhole of the same camera.

A solver whose projection is linear then sees the distorted camera exactly: the carried pixel lies
on the same line of sight, and the whitening turns residuals back to pixels of the image as it was taken.
"""

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras._camera import Camera

__all__ = ["carry_to_pinhole"]


def carry_to_pinhole(
    camera: Camera, uv_px: FloatArray, range_m: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Pixels (n, 2) as the camera's pinhole would have measured them, and how to turn residuals back.

    The camera is in its own frame. `range_m` (n,) is the distance from its centre to what each pixel sees; it
    matters only where the entrance pupil moves (CAHVORE); a rough value is enough there unless the point is
    near.

    Returns the pinhole's pixels (n, 2), matrices (n, 2, 2) that take small residuals of the pinhole to
    residuals of the image, and validity (n,): False outside either model's domain.
    """
    pinhole = camera.pinhole
    if camera == pinhole:
        n = len(uv_px)
        return uv_px, np.broadcast_to(np.eye(2), (n, 2, 2)).copy(), np.ones(n, dtype=bool)
    rays = camera.unproject(uv_px)
    # The range counts from the centre; the ray starts at the pupil.
    along = np.einsum("ni,ni->n", rays.origin_m, rays.direction)
    apart = np.einsum("ni,ni->n", rays.origin_m, rays.origin_m)
    reach = np.sqrt(np.maximum(range_m**2 + along**2 - apart, 1e-12)) - along
    points = rays.origin_m + reach[:, None] * rays.direction
    carried, d_pinhole, in_front = pinhole.project_with_jacobian(points)
    _, d_camera, seen = camera.project_with_jacobian(points)
    # Both derivatives vanish along the line of sight, so any right inverse of one serves the other.
    gram = d_camera @ d_camera.transpose(0, 2, 1)
    valid = rays.valid & in_front & seen & (np.abs(np.linalg.det(gram)) > 0)
    gram = np.where(valid[:, None, None], gram, np.eye(2))
    forward = d_pinhole @ d_camera.transpose(0, 2, 1) @ np.linalg.inv(gram)
    valid &= np.linalg.det(forward) > 1e-9
    forward = np.where(valid[:, None, None], forward, np.eye(2))
    return np.where(valid[:, None], carried, uv_px), np.linalg.inv(forward), valid
