"""SIFT features with descriptors turned to the vertical that the pointing predicts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.cameras import Camera
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._normalise import normalise, usable_mask

__all__ = ["DESCRIPTOR_NORM", "Features", "describe", "find_features", "strongest"]

DESCRIPTOR_NORM = 255.0
"""Length of a stored descriptor."""

_CELLS = 16
_LEAST_SHARE = 0.1
_MOST_FEATURES = 20_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """Features of one image, sorted by row, column and size."""

    uv_px: FloatArray
    """(n, 2) sub-pixel positions, centre of the top-left pixel at (0, 0)."""
    size_px: FloatArray
    """(n,) diameters."""
    descriptor: NDArray[np.uint8]
    """(n, 128) square-rooted SIFT descriptors (Arandjelovic and Zisserman 2012) of length 255, rounded:
    their dot products are exact in float32, so that no order of summation can change a match."""

    @staticmethod
    def none() -> "Features":
        """No features."""
        return Features(
            uv_px=np.empty((0, 2)), size_px=np.empty(0), descriptor=np.empty((0, 128), dtype=np.uint8)
        )

    def __len__(self) -> int:
        """Number of features."""
        return len(self.uv_px)

    def select(self, rows: BoolArray | IntArray) -> "Features":
        """Some of the features."""
        return Features(uv_px=self.uv_px[rows], size_px=self.size_px[rows], descriptor=self.descriptor[rows])


def find_features(
    image: NDArray[Any],
    wanted: BoolArray,
    camera: Camera,
    camera_up: FloatArray,
    options: FrontEndOptions,
    *,
    usable: BoolArray | None = None,
) -> Features:
    """Features of an image (height, width) that `camera` took, in the pieces of it that are `wanted`.

    `wanted` is a grid over the image, by row and column; `usable` (height, width) leaves out pixels, by
    default those without data. `camera_up` is the world's vertical as a unit vector (3,) in the camera frame.
    Descriptors are turned to the image of the vertical instead of the local gradient's direction: since a
    mast does not roll, descriptors of the same point then agree, and one unknown less can go wrong. Returns
    no features, never an error, for an image without texture.
    """
    grey = normalise(image, options.tile_px, options.max_contrast_gain)
    # Without precise upscaling OpenCV's positions are 0.25 px off to the lower right, measured on spots.
    sift: Any = cv2.SIFT.create(
        nfeatures=0, contrastThreshold=options.contrast_threshold, enable_precise_upscale=True
    )
    wanted_mask = cv2.resize(wanted.astype(np.uint8), grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    usable = (usable_mask(image) if usable is None else usable) & (wanted_mask > 0)
    keypoints = sift.detect(grey, None)
    table = np.array([(k.pt[1], k.pt[0], k.size, k.response) for k in keypoints]).reshape(-1, 4)
    # Where only a share of the image overlaps others, that share gets more features per area. The share is
    # squared because the uncertainty of telemetry makes an overlap look wider than it is.
    share = max(float(np.mean(wanted)), _LEAST_SHARE)
    limit = min(options.max_features / share**2, max(_MOST_FEATURES, options.max_features))
    rows = strongest(table, usable, round(limit))
    chosen = [keypoints[i] for i in rows]
    angles = _vertical_angle_deg(camera, camera_up, table[rows][:, [1, 0]])
    for keypoint, angle in zip(chosen, angles, strict=True):
        keypoint.angle = float(angle)
    kept, descriptor = describe(sift, grey, chosen)
    uv_px = np.array([k.pt for k in kept], dtype=float).reshape(-1, 2)
    return Features(uv_px=uv_px, size_px=np.array([k.size for k in kept], dtype=float), descriptor=descriptor)


def strongest(table: FloatArray, usable: NDArray[np.bool_], max_features: int) -> IntArray:
    """Rows of distinct, usable features (v, u, size, response), the strongest of each cell, sorted."""
    if not len(table):
        return np.empty(0, dtype=np.int64)
    # SIFT lists a feature once for each of its gradient directions, which the vertical replaces.
    _, first = np.unique(table[:, :3], axis=0, return_index=True)
    height, width = usable.shape
    v = np.clip(np.rint(table[first, 0]).astype(np.int64), 0, height - 1)
    u = np.clip(np.rint(table[first, 1]).astype(np.int64), 0, width - 1)
    first, v, u = (x[usable[v, u]] for x in (first, v, u))
    if len(first) <= max_features:
        return np.asarray(first, dtype=np.int64)
    cell = (v * _CELLS // height) * _CELLS + u * _CELLS // width
    order = np.lexsort((np.arange(len(first)), -table[first, 3], cell))
    starts = np.searchsorted(cell[order], np.arange(_CELLS**2))
    rank = np.arange(len(first)) - starts[cell[order]]
    # The strongest feature of every cell comes before the second strongest of any.
    chosen = order[np.lexsort((np.arange(len(first)), rank))][:max_features]
    return np.asarray(first[np.sort(chosen)], dtype=np.int64)


def _vertical_angle_deg(camera: Camera, camera_up: FloatArray, uv_px: FloatArray) -> FloatArray:
    rays = camera.unproject(uv_px)
    _, d_uv, _ = camera.project_with_jacobian(rays.origin_m + rays.direction)
    du, dv = (d_uv @ camera_up).T
    return np.asarray(np.rad2deg(np.arctan2(dv, du)) % 360.0)


def describe(
    sift: Any, grey: NDArray[np.uint8], keypoints: Sequence[Any]
) -> tuple[Sequence[Any], NDArray[np.uint8]]:
    """The keypoints that have a descriptor, and their square-rooted descriptors of length 255, rounded."""
    if not keypoints:
        return [], np.empty((0, 128), dtype=np.uint8)
    kept, raw = sift.compute(grey, list(keypoints))
    total = np.maximum(raw.sum(axis=1, keepdims=True), 1.0)
    return kept, np.rint(DESCRIPTOR_NORM * np.sqrt(raw / total)).astype(np.uint8)
