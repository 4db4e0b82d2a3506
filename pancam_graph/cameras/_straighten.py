"""The pinhole that images of a distorted camera are resampled to, and where its pixels lie on them."""

from dataclasses import replace

import numpy as np
import scipy

from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.cameras._camera import Camera, Pinhole

__all__ = ["straight_pixels", "straightened", "straightening_map"]

_ROUNDING_PX = 1e-6
_AGAIN_PX = 1e-3
_GRID_PX = 8
_CHUNK_PX = 1 << 18
_MOST_GROWTH = 0.5
"""Largest growth of an image on each side, as a share of its width or height."""


def straightened(camera: Camera, range_m: float) -> Pinhole:
    """The pinhole without skew that holds an image of this camera, of the same centre and axes.

    Focal lengths are those of the camera's pinhole. Size and principal point are such that the centres of all
    pixels are within, grown or cropped to whole pixels; but no side moves out by more than half of the
    image's own size, and what a very wide lens sees beyond is lost. A pinhole without skew is returned as it
    is.

    `range_m` is the distance of what the images show; it matters only where the entrance pupil moves. Raises
    CameraError where no pixel has a line of sight in front of the pinhole.
    """
    pinhole = camera.pinhole
    if camera == pinhole and not pinhole.skew_px:
        return pinhole
    w, h = camera.width_px, camera.height_px
    columns, rows = np.arange(w, dtype=float), np.arange(h, dtype=float)
    edges = [np.column_stack([columns, np.full(w, y)]) for y in (0.0, h - 1.0)]
    edges += [np.column_stack([np.full(h, x), rows]) for x in (0.0, w - 1.0)]
    # Inner pixels too: the corners of a wide lens may see nothing that a pinhole can show.
    inner = np.meshgrid(np.linspace(0, w - 1, 65), np.linspace(0, h - 1, 65))
    uv = np.concatenate([*edges, np.column_stack([i.ravel() for i in inner])])
    plain = replace(pinhole, skew_px=0.0)
    seen, _, valid = straight_pixels(camera, plain, uv, np.full(len(uv), range_m))
    if not valid.any():
        raise CameraError("camera: expected a pixel with a line of sight that a pinhole can show, found none")
    size = np.array([w, h])
    low = np.floor(seen[valid].min(axis=0) + _ROUNDING_PX).clip(-_MOST_GROWTH * size, None)
    high = np.ceil(seen[valid].max(axis=0) - _ROUNDING_PX).clip(None, (1 + _MOST_GROWTH) * size - 1)
    left, top = (int(x) for x in low)
    width_px, height_px = (int(x) for x in high - low + 1)
    cx_px, cy_px = plain.cx_px - left, plain.cy_px - top
    return replace(plain, width_px=width_px, height_px=height_px, cx_px=cx_px, cy_px=cy_px)


def straight_pixels(
    camera: Camera, straight: Pinhole, uv_px: FloatArray, range_m: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Pixels (n, 2) of a camera as its straightened pinhole would have measured them.

    The camera is in its own frame. `range_m` (n,) is the distance from its centre to what each pixel sees; it
    matters only where the entrance pupil moves (CAHVORE); a rough value is enough there unless the point is
    near.

    Returns the pixels, matrices (n, 2, 2) that take small residuals of the camera's image to the straightened
    image, and validity (n,): False outside either model's domain.
    """
    carried, forward, valid = _at_pinhole(camera, uv_px, range_m)
    # From the camera's pinhole, with its skew and its place of the first pixel, to the other: a shear.
    shear = straight.calibration_matrix @ np.linalg.inv(camera.pinhole.calibration_matrix)
    return carried @ shear[:2, :2].T + shear[:2, 2], shear[:2, :2] @ forward, valid


def _at_pinhole(
    camera: Camera, uv_px: FloatArray, range_m: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """`straight_pixels` for the pinhole of the camera itself, with its skew and principal point."""
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
    return np.where(valid[:, None], carried, uv_px), forward, valid


def straightening_map(
    camera: Camera, straight: Pinhole, range_m: float, camera_R_straight: FloatArray | None = None
) -> FloatArray | None:
    """Where the centres of a straightened image's pixels lie on the camera's own image.

    `camera_R_straight` (3, 3) turns the pinhole against the camera, as rectification does; None: not turned.
    Pixels (height, width, 2) of the camera's image, NaN where it has none; None where all are where they
    were, within a millionth of a pixel: nothing to resample. Between every eighth pixel a cubic spline.
    """
    w, h = straight.width_px, straight.height_px
    turn = np.eye(3) if camera_R_straight is None else camera_R_straight
    if camera == straight and np.array_equal(turn, np.eye(3)):
        return None
    columns, rows = (np.unique(np.append(np.arange(0, n, _GRID_PX), n - 1)) for n in (w, h))
    coarse = _looked_up(camera, straight, columns, rows, range_m, turn)
    if np.isfinite(coarse).all() and len(columns) > 3 and len(rows) > 3:
        out = np.empty((h, w, 2))
        for axis in (0, 1):
            out[..., axis] = scipy.interpolate.RectBivariateSpline(rows, columns, coarse[..., axis])(
                np.arange(h), np.arange(w)
            )
    else:  # no spline across the edge of the model's domain
        out = _looked_up(camera, straight, np.arange(w), np.arange(h), range_m, turn)
    same = (w, h) == (camera.width_px, camera.height_px) and bool(
        np.all(np.abs(out - _grid(np.arange(w), np.arange(h))) < _ROUNDING_PX)
    )
    return None if same else out


def _grid(columns: IntArray, rows: IntArray) -> FloatArray:
    return np.stack(np.meshgrid(columns.astype(float), rows.astype(float)), axis=-1)


def _looked_up(
    camera: Camera,
    straight: Pinhole,
    columns: IntArray,
    rows: IntArray,
    range_m: float,
    camera_R_straight: FloatArray,
) -> FloatArray:
    """Pixels (rows, columns, 2) of the camera's image where the pinhole sees points at a range; NaN: none."""
    out = np.empty((len(rows), len(columns), 2))
    step = max(1, _CHUNK_PX // len(columns))
    for begin in range(0, len(rows), step):
        grid = _grid(columns, rows[begin : begin + step])
        uv = grid.reshape(-1, 2)
        points = range_m * straight.unproject(uv).direction @ camera_R_straight.T
        pixels, valid = camera.project(points)
        # Where a lens folds back, a direction may get a pixel whose own line of sight is another.
        rays = camera.unproject(pixels)
        off = np.cross(points - rays.origin_m, rays.direction)
        valid &= rays.valid & (np.linalg.norm(off, axis=1) * straight.fx_px < _AGAIN_PX * range_m)
        out[begin : begin + step] = np.where(valid[:, None], pixels, np.nan).reshape(grid.shape)
    return out
