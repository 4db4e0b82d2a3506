"""What of an image is not terrain, and why: the user's mask, missing and saturated pixels, sky, the rover."""

from dataclasses import dataclass
from enum import IntFlag
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.data import Traverse
from pancam_graph.images._normalise import usable_mask
from pancam_graph.images._sky import find_sky

__all__ = ["ImageMask", "Reason", "elevation_rad", "mask_image", "saturated"]

_FULL_SCALES = (255, 1023, 4095, 16383, 65535)
_NEAR_FULL = 0.98
_CLIPPED_PX = 3
_SPIKE = 8.0
_LEVELS_BELOW = 5
_MARGIN_PX = 4
_NODES = 33


class Reason(IntFlag):
    """Why a pixel is left out."""

    USER = 1
    """The user's mask is black."""
    MISSING = 2
    """No data, or within 8 pixels of where there is none."""
    SATURATED = 4
    """As bright as the sensor or the file can say, or brighter."""
    SKY = 8
    """Nothing but sky."""
    ROVER = 16
    """The rover itself. Left out between stops only, for within a stop it stands still."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageMask:
    """Which pixels of an image are left out, and why."""

    reasons: NDArray[np.uint8]
    """(height, width) sums of `Reason`; 0: to be used."""

    def usable(self, *, between_stops: bool, margin_px: int = _MARGIN_PX) -> BoolArray:
        """Which pixels (height, width) are farther than a margin from those left out; sky has no margin."""
        hard = Reason.USER | Reason.SATURATED | (Reason.ROVER if between_stops else 0)
        left_out = (self.reasons & np.uint8(hard) > 0).astype(np.uint8)
        near_it = cv2.dilate(left_out, np.ones((2 * margin_px + 1,) * 2, np.uint8))
        return np.asarray((near_it == 0) & (self.reasons & np.uint8(Reason.MISSING | Reason.SKY) == 0))

    def share(self, reason: Reason) -> float:
        """Share of the image's pixels that are left out for a reason."""
        return self.shares()[reason]

    def shares(self) -> dict[Reason, float]:
        """Share of the image's pixels that are left out, by the reason."""
        count = np.bincount(self.reasons.ravel())
        sums = np.arange(len(count))
        return {reason: float(count[sums & reason > 0].sum() / self.reasons.size) for reason in Reason}

    def with_rover(self, rover: BoolArray) -> "ImageMask":
        """This mask with the rover's pixels added."""
        return ImageMask(reasons=self.reasons | np.uint8(Reason.ROVER) * rover.astype(np.uint8))


def mask_image(
    image: NDArray[Any], user: BoolArray | None, elevation: FloatArray, *, automatic: bool
) -> ImageMask:
    """The mask of an image (height, width) by itself: everything but the rover.

    `user` is True where the user's mask is white; None: there is none. `elevation` (height, width) is each
    pixel's angle above the horizontal. Without `automatic`, only the user's mask and missing pixels count.
    """
    reasons = np.where(usable_mask(image), np.uint8(0), np.uint8(Reason.MISSING))
    if user is not None:
        reasons |= np.where(user, np.uint8(0), np.uint8(Reason.USER))
    if automatic:
        bright = saturated(image)
        reasons |= np.where(bright, np.uint8(Reason.SATURATED), np.uint8(0))
        reasons |= np.where(find_sky(image, elevation) & ~bright, np.uint8(Reason.SKY), np.uint8(0))
    return ImageMask(reasons=reasons)


def saturated(image: NDArray[Any]) -> BoolArray:
    """Which pixels lie in blocks of the highest value: that of 8, 10, 12, 14 or 16 bits, or of this image.

    An image's own highest value is taken for a limit if many more pixels have it than have the values just
    below. Images of rovers are often stretched or summed, so that their limit may be any number.
    """
    top = int(image.max())
    full = next((f for f in _FULL_SCALES if f >= top), top)
    level = top
    if top >= _NEAR_FULL * full:
        level = int(np.ceil(_NEAR_FULL * full))
    elif np.mean([np.count_nonzero(image == top - k) for k in range(1, _LEVELS_BELOW + 1)]) * _SPIKE > (
        np.count_nonzero(image == top)
    ):
        return np.zeros(image.shape, dtype=bool)
    if int(image.min()) >= level and top < _NEAR_FULL * full:
        return np.zeros(image.shape, dtype=bool)  # all pixels have one value, which is not a limit
    block = np.ones((_CLIPPED_PX, _CLIPPED_PX), np.uint8)
    return np.asarray(cv2.morphologyEx((image >= level).astype(np.uint8), cv2.MORPH_OPEN, block) > 0)


def elevation_rad(traverse: Traverse, row: int) -> FloatArray:
    """Angle of each pixel of an image (height, width) above the horizontal by telemetry, interpolated.

    -pi/2 around what the camera model does not cover.
    """
    camera = traverse.rig.eyes[int(traverse.image_eye[row])].camera
    world_R_camera, _ = traverse.camera_poses()
    height, width = camera.height_px, camera.width_px
    v, u = np.meshgrid(np.linspace(0, height - 1, _NODES), np.linspace(0, width - 1, _NODES), indexing="ij")
    rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()]))
    sine = np.where(rays.valid, rays.direction @ world_R_camera[row][2], -1.0)
    nodes = np.arcsin(np.clip(sine, -1, 1)).reshape(_NODES, _NODES).astype(np.float32)
    grid_v, grid_u = np.mgrid[:height, :width].astype(np.float32)
    at = grid_u * ((_NODES - 1) / max(width - 1, 1)), grid_v * ((_NODES - 1) / max(height - 1, 1))
    return np.asarray(cv2.remap(nodes, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
