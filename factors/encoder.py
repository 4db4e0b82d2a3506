"""Encoder factor: pans and tilts are their readings, up to a scale (one row for each of their components).

    angle = reading (1 + s)

The residual is the angles less the scaled readings. Its sigma is that of a reading.
"""

from collections.abc import Sequence

import gtsam

from pancam_graph.base.geometry import FloatArray
from pancam_graph.factors._slots import Key, Kind, Slot, custom_factor
from pancam_graph.factors.joint_prior import joint_prior_residual

__all__ = ["encoder_factor", "encoder_residual"]


def encoder_residual(
    reading: FloatArray, by_scale: FloatArray, scale: FloatArray, *angles: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Residuals (1, n), radians, and Jacobians (1, n, k) by the scale (1, k) and by each vector of angles.

    `reading` (n,) are those of all angles, one vector after the other; `by_scale` (n, k) is by how much the
    entries of the scale move them: a reading in the column of its own joint, 0 in the others.
    """
    residual, by_angles = joint_prior_residual(reading, *angles)
    return residual - scale @ by_scale.T, (-by_scale[None], *by_angles)


def encoder_factor(
    noise: gtsam.noiseModel.Base,
    scale: Slot,
    angles: Sequence[Key],
    *,
    reading: FloatArray,
    by_scale: FloatArray,
) -> gtsam.CustomFactor:
    """The factor of `encoder_residual` on variables that are vectors; the noise has a row a reading."""

    def residual(scale: FloatArray, *vectors: FloatArray) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        return encoder_residual(reading, by_scale, scale, *vectors)

    slots: list[tuple[Slot, Kind]] = [(scale, "vector"), *((key, "vector") for key in angles)]
    return custom_factor(noise, slots, residual)
