"""Which pictures are the same: alike in every sample, or one taken for two by all but its encoding."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Traverse
from pancam_graph.io._image_files import GreyImage, ImageContent

__all__ = ["Look", "look_of", "same_looks", "samples_digest"]

_SIDE = 64
"""Cells of a thumbnail along each side: noise and encoding average out in them."""
_BLUR_CELLS = 3.0
"""Standard deviation of the blur whose result is subtracted: shading and sky are alike in many pictures."""
_ALIKE = 0.98
"""Correlation of thumbnails from which pictures show the same; two views of one scene stay below 0.5."""
_LEAST_CELLS = _SIDE**2 // 4
"""Cells that two pictures must both have."""
_AT_ONCE = 512
"""Pictures of which all pairs are compared at a time: memory does not grow with all pairs of a drive."""
_SAME_POINTING_PX = 10.0
"""How far apart two pointings may be for pictures that are alike to be two exposures of one view."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """What is kept of a picture to tell it from others."""

    digest: bytes
    """Digest of all samples, see `samples_digest`."""
    shape: tuple[int, ...]
    """Rows and columns."""
    colour: bool
    """Whether its file has bands that differ."""
    blank: bool
    """Whether it is of a single grey: such a picture is the same as no other."""
    thumbnail: NDArray[np.float32]
    """(64, 64) small picture without its shading; 0 where there is no data."""
    valid: NDArray[np.bool]
    """(64, 64) cells all of whose pixels have data."""


def look_of(content: ImageContent) -> Look:
    """The look of a picture."""
    samples = content.samples
    blank = bool(samples.min() == samples.max())
    nothing = np.zeros((_SIDE, _SIDE))
    thumbnail, valid = (nothing.astype(np.float32), nothing.astype(bool)) if blank else _thumbnail(samples)
    return Look(
        digest=samples_digest(samples),
        shape=samples.shape,
        colour=content.colour,
        blank=blank,
        thumbnail=thumbnail,
        valid=valid,
    )


def samples_digest(samples: GreyImage) -> bytes:
    """A digest of the samples of a picture (rows, columns), of their type and of its shape."""
    running = hashlib.sha256(f"{samples.dtype.str} {samples.shape} ".encode())
    running.update(np.ascontiguousarray(samples).data)
    return running.digest()


def _thumbnail(samples: GreyImage) -> tuple[NDArray[np.float32], NDArray[np.bool]]:
    import cv2  # noqa: PLC0415  only pictures need OpenCV

    def small(picture: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.resize(picture, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA), dtype=np.float32)

    def blurred(picture: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.GaussianBlur(picture, (0, 0), _BLUR_CELLS), dtype=np.float32)

    valid = small((samples == 0).astype(np.float32)) == 0
    weight = valid.astype(np.float32)
    picture = small(samples.astype(np.float32)) * weight
    shading = blurred(picture) / np.maximum(blurred(weight), np.float32(1e-6))
    return (picture - shading) * weight, valid


def same_looks(traverse: Traverse, looks: Mapping[int, Look]) -> dict[int, int]:
    """Rows of images whose picture is the same as that of an image before, and the first such row.

    `looks` are those of the rows that have a picture. Pictures are the same if they have one size and depth
    and are alike in every sample; or if they show the same to the pixel though telemetry has them look apart,
    as a file that was encoded anew and taken for another image does. Two exposures of one pointing also show
    the same; they are two pictures, which differ by their noise.
    """
    first: dict[bytes, int] = {}
    same: dict[int, int] = {}
    for row, look in sorted(looks.items()):
        if not look.blank and first.setdefault(look.digest, row) != row:
            same[row] = first[look.digest]
    rows = [row for row, look in sorted(looks.items()) if not look.blank and row not in same]
    for one, other in _alike([looks[row] for row in rows]):
        a, b = rows[one], rows[other]
        if a not in same and b not in same and _look_apart(traverse, a, b):
            same[b] = a
    return same


def _alike(looks: Sequence[Look]) -> list[tuple[int, int]]:
    """Pairs of looks that show the same, the first before the second, sorted; some of them at a time."""
    pairs: list[tuple[int, int]] = []
    for top in range(0, len(looks), _AT_ONCE):
        for left in range(top, len(looks), _AT_ONCE):
            correlation = _correlation(looks[top : top + _AT_ONCE], looks[left : left + _AT_ONCE])
            close = np.argwhere(correlation > _ALIKE) + np.array([top, left])
            pairs += [(one, other) for one, other in close.tolist() if one < other]
    return sorted(pairs)


def _correlation(first: Sequence[Look], second: Sequence[Look]) -> FloatArray:
    """(n, m) correlations of thumbnails over the cells that both have; 0 where these are too few."""
    (x, v), (y, w) = (_columns(looks) for looks in (first, second))
    n = np.maximum(v @ w.T, 1.0)
    mean_x, mean_y = (x @ w.T) / n, (v @ y.T) / n  # of each picture over the cells of the other
    variance_x, variance_y = (x**2 @ w.T) / n - mean_x**2, (v @ (y**2).T) / n - mean_y**2
    covariance = (x @ y.T) / n - mean_x * mean_y
    scale = np.sqrt(np.maximum(variance_x * variance_y, 0.0))
    told = (n >= _LEAST_CELLS) & (scale > 0)
    return np.where(told, covariance / np.where(told, scale, 1.0), 0.0)


def _columns(looks: Sequence[Look]) -> tuple[FloatArray, FloatArray]:
    """Thumbnails (n, 4096), and 1 where they have data."""
    thumbnails, valid = ([getattr(look, name).ravel() for look in looks] for name in ("thumbnail", "valid"))
    return np.array(thumbnails, dtype=float), np.array(valid, dtype=float)


def _look_apart(traverse: Traverse, a: int, b: int) -> bool:
    """Whether telemetry turns two images of one size by more than two exposures of one view are turned."""
    cameras = [traverse.rig.eyes[int(traverse.image_eye[row])].camera for row in (a, b)]
    if (cameras[0].width_px, cameras[0].height_px) != (cameras[1].width_px, cameras[1].height_px):
        return False
    world_R_camera, _ = traverse.camera_poses()
    turn = world_R_camera[a].T @ world_R_camera[b]
    angle_rad = float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0)))
    focal_px = float(traverse.calibration[a, 0, 0])
    return angle_rad * focal_px > _SAME_POINTING_PX
