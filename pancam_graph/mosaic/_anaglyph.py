"""Stereo panoramas for red and cyan glasses, from the panoramas of two eyes."""

from dataclasses import dataclass

import cv2
import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.charts import Picture, framed
from pancam_graph.data import Solution
from pancam_graph.mosaic._draw import EMPTY, around_axes
from pancam_graph.mosaic._make import Mosaic
from pancam_graph.mosaic._placed import Pointing
from pancam_graph.mosaic._projections import Cylinder
from pancam_graph.mosaic._resampled import Resampled
from pancam_graph.mosaic._surface import Surface, directions

__all__ = ["EyePair", "anaglyph", "eye_pairs", "with_parallax"]

_WIDTH_PX = 4096
_MOST_UNLIKE = 1.3
"""How many times the field of one eye may be the other's."""
_LEAST_SIDEWAYS = 0.8
"""Share of the distance of two eyes that must be along the rows of their images."""
_STEP_PX = 16


@dataclass(frozen=True, kw_only=True)
class EyePair:
    """Two eyes of a rig that people can look through: side by side, with fields of about one size."""

    left: int
    right: int
    """Rows of the eyes in the rig."""
    baseline_m: float


def eye_pairs(solution: Solution, stop: int) -> tuple[EyePair, ...]:
    """The pairs of eyes that took frames together at a stop, by the refined places of their cameras."""
    traverse, final = solution.traverse, solution.final
    rows = np.flatnonzero(traverse.image_stop == stop)
    frame, eye = traverse.image_frame[rows], traverse.image_eye[rows]
    eyes = np.unique(eye).tolist()
    pairs = []
    for a in eyes:
        for b in eyes:
            shared = np.intersect1d(frame[eye == a], frame[eye == b]) if a != b else np.empty(0, dtype=int)
            if not len(shared):
                continue
            first, second = (rows[(frame == shared[0]) & (eye == e)][0] for e in (a, b))
            apart = final.world_t_camera[second] - final.world_t_camera[first]
            to_right = apart @ final.world_R_camera[first]
            baseline = float(np.linalg.norm(apart))
            if to_right[0] < _LEAST_SIDEWAYS * baseline or not baseline > 0:
                continue
            fields = [_field_rad(solution, row) for row in (first, second)]
            if max(fields) <= _MOST_UNLIKE * min(fields):
                pairs.append(EyePair(left=a, right=b, baseline_m=baseline))
    return tuple(pairs)


def _field_rad(solution: Solution, row: int) -> float:
    camera = solution.image_cameras[row]
    middle = 0.5 * (camera.height_px - 1)
    ray = camera.unproject(np.array([[0.0, middle], [camera.width_px - 1.0, middle]])).direction
    return float(np.arccos(np.clip(ray[0] @ ray[1], -1.0, 1.0)))


def _cylinder(panorama: Mosaic) -> Cylinder:
    assert isinstance(panorama.projection, Cylinder)  # only panoramas are looked at in stereo
    return panorama.projection


def anaglyph(
    left: Mosaic,
    right: Mosaic,
    surface: Surface,
    baseline_m: float,
    pointing: Pointing,
    title: str,
    *,
    width_px: int = _WIDTH_PX,
    north_deg: float | None,
) -> Picture:
    """Two panoramas as one picture (blue, green, red) for glasses: red before the left eye, cyan the right.

    See `with_parallax`. It is grey where one of the eyes shows nothing.
    """
    cylinder = _cylinder(left)
    scale = min(1.0, width_px / cylinder.width_px)
    seen, there = with_parallax(left, right, surface, baseline_m, pointing, scale)
    shown = np.where(there, np.clip(np.rint(seen), 1, 255), EMPTY).astype(np.uint8)
    picture: Picture = np.ascontiguousarray(np.stack([shown[1], shown[1], shown[0]], axis=-1))
    across, down, names = around_axes(cylinder, picture.shape[1] / cylinder.width_px, north_deg)
    return framed(picture, across, down, names, title)


def with_parallax(
    left: Mosaic,
    right: Mosaic,
    surface: Surface,
    baseline_m: float,
    pointing: Pointing,
    scale: float,
) -> tuple[FloatArray, BoolArray]:
    """Grey (2, rows, columns) of the left and the right eye, and where both show something (rows, columns).

    Panoramas stand on the surface that the landmarks span, where the eyes see every place in one direction.
    Each is moved sideways by half the parallax that its eye has there, baseline over range, so that the eyes
    see depth without a break between frames. What lies as far away as the median of the picture stays put:
    it is in the plane of the screen, nearer ground before it. The rows and columns are those of the left
    panorama drawn `scale` times its size.
    """
    cylinder = _cylinder(left)
    width, height = (max(2, round(n * scale)) for n in (cylinder.width_px, cylinder.height_px))
    column = (np.arange(width) + 0.5) * cylinder.width_px / width - 0.5
    row = (np.arange(height) + 0.5) * cylinder.height_px / height - 0.5
    azimuth = np.broadcast_to(cylinder.azimuth_deg(column), (height, width))
    elevation = np.broadcast_to(cylinder.elevation_deg(row)[:, None], (height, width))
    parallax_deg = np.rad2deg(baseline_m * _inverse_range(surface, azimuth, elevation))
    px_per_degree = cylinder.px_per_degree * width / cylinder.width_px
    eyes = [Resampled(_cylinder(m), m.pictures[pointing], px_per_degree) for m in (left, right)]
    _, known = eyes[0].at(azimuth, elevation)
    parallax_deg -= np.median(parallax_deg[known]) if known.any() else 0.0
    # Azimuth falls to the right: the left eye sees what is near farther to the right.
    seen = [
        eye.at(azimuth + side * parallax_deg, elevation) for eye, side in zip(eyes, (0.5, -0.5), strict=True)
    ]
    return np.stack([grey for grey, _ in seen]), seen[0][1] & seen[1][1]


def _inverse_range(surface: Surface, azimuth_deg: FloatArray, elevation_deg: FloatArray) -> FloatArray:
    """Inverse ranges (rows, columns) per metre; the surface is smooth, so every 16th pixel is asked."""
    rows, columns = azimuth_deg.shape
    coarse = [a[::_STEP_PX, ::_STEP_PX] for a in (azimuth_deg, elevation_deg)]
    ray = directions(np.deg2rad(coarse[0].ravel()), np.deg2rad(coarse[1].ravel()))
    asked = surface.inverse_range(ray).reshape(coarse[0].shape).astype(np.float32)
    u, v = np.meshgrid(
        np.arange(columns, dtype=np.float32) / _STEP_PX, np.arange(rows, dtype=np.float32) / _STEP_PX
    )
    return np.asarray(cv2.remap(asked, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float64)
