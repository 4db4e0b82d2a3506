"""Pan and tilt of rotations that are known but for a common turn."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray

__all__ = ["Levelled", "levelled"]

_LEAST_SPREAD = 0.03
"""Share of the tilt axes' directions that must lie across their mean one, to tell the pan axis."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Levelled:
    """Pans and tilts, and how well they fit."""

    pan_rad: FloatArray
    """(n,) that of the first is 0."""
    tilt_rad: FloatArray
    """(n,)"""
    off_rad: FloatArray
    """(n,) how far each head is turned from what pan and tilt can do."""
    told: bool
    """Whether the pictures tell the pan axis; else the mean tilt is taken as 0."""


def levelled(world_R_head: FloatArray) -> Levelled:
    """Pans and tilts of heads (n, 3, 3), in a world that may be turned in any way.

    The tilt axis of a head, its y axis, stays level whatever pan and tilt are. So the pan axis is the
    direction across the tilt axes of all; where these are nearly one, it is that across it which is the mean
    up of the heads.
    """
    across = world_R_head[:, :, 1]
    mean_up = world_R_head[:, :, 2].mean(axis=0)
    spread, direction = np.linalg.eigh(across.T @ across / len(across))
    told = bool(spread[1] > _LEAST_SPREAD)
    if told:
        up = direction[:, 0] * (1.0 if direction[:, 0] @ mean_up >= 0 else -1.0)
    else:
        axis = direction[:, 2]
        up = mean_up - axis * (axis @ mean_up)
        up = up / np.linalg.norm(up)
    forward = world_R_head[:, :, 0]
    tilt = np.arcsin(np.clip(forward @ up, -1.0, 1.0))
    # The tilt axis, a quarter turn left of the pan, is level also where the head looks up or down.
    east = across[0] - up * (across[0] @ up)
    east = east / np.linalg.norm(east)
    pan = np.arctan2(across @ np.cross(up, east), across @ east)
    # Upside down: a tilt beyond a quarter turn.
    tilt = np.where(world_R_head[:, :, 2] @ up >= 0, tilt, np.copysign(np.pi, tilt) - tilt)
    return Levelled(
        pan_rad=pan, tilt_rad=tilt, off_rad=np.abs(np.arcsin(np.clip(across @ up, -1, 1))), told=told
    )
