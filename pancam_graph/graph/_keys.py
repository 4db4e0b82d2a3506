"""Keys of the variables of a graph; this module alone makes and reads them."""

from enum import Enum
from typing import Any

import gtsam

__all__ = ["Kind", "index_of", "key_of", "kind_of", "read_variable"]


class Kind(Enum):
    """Kinds of variables; the value of each is the letter that its keys have in GTSAM."""

    MAST = "M"
    """Mast pose of a stop (Pose3)."""
    ANGLES = "A"
    """Pan and tilt: of one frame (vector of 2), or stacked of all frames of a stop that are not held."""
    FLEX = "F"
    """How a head stands off the rigid mast (vector): of one frame, or stacked as angles are."""
    CAMERA = "X"
    """Camera pose of an image (Pose3)."""
    PROJECTION = "P"
    """Entries of the conditioned projection matrix of an image (vector of 12)."""
    LANDMARK = "L"
    """Terrain point (Point3)."""
    CALIBRATION = "K"
    """Free entries of a correction of a calibration (vector)."""
    MOUNT = "E"
    """Free entries of a correction of a mount, `head_T_camera` (vector)."""
    TILT_AXIS = "T"
    """Free entries of a correction of a tilt axis, `pan_T_tilt` (vector)."""
    ENCODERS = "S"
    """Free entries of the scale of pans and tilts over their readings (vector)."""
    FIELD = "D"
    """Coefficients, pixels, that the smooth distortion field of an eye has more than in the rig (vector)."""
    RADIUS = "R"
    """Radius of an eye's circle, metres (number)."""
    NATIVE_CALIBRATION = "C"
    """Calibration as GTSAM's projection factors want it (Cal3_S2)."""


_KINDS = {ord(kind.value): kind for kind in Kind}
_LETTER = 56
"""Bits of a key below its letter, as gtsam::Symbol has them."""


def key_of(kind: Kind, index: int) -> int:
    """Key of a variable, by its kind and its number among those of its kind: as gtsam.symbol has it."""
    return (ord(kind.value) << _LETTER) + int(index)


def kind_of(key: int) -> Kind:
    """Kind of the variable that a key made here names. Raises ValueError for any other key."""
    kind = _KINDS.get(key >> _LETTER)
    if kind is None:
        raise ValueError(f"key {key}: expected one of a variable made here")
    return kind


def index_of(key: int) -> int:
    """Number of the variable among those of its kind."""
    return int(gtsam.symbolIndex(key))


def read_variable(values: gtsam.Values, key: int) -> Any:
    """Value of a variable: gtsam.Pose3, vector or number; of a Cal3_S2 its five numbers (5,)."""
    kind = kind_of(key)
    if kind is Kind.MAST or kind is Kind.CAMERA:
        return values.atPose3(key)
    if kind is Kind.LANDMARK:
        return values.atPoint3(key)
    if kind is Kind.NATIVE_CALIBRATION:
        return values.atCal3_S2(key).vector()
    return values.atDouble(key) if kind is Kind.RADIUS else values.atVector(key)
