"""Slots of a custom factor: a variable of the graph, a fixed value, or a known pose with a correction.

A held stop, a calibrated mount or a known radius is a fixed value, not a variable: it stays the same to the
last bit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray, corrected_poses, correction_twists, pose_arrays

__all__ = ["Corrected", "Fixed", "Key", "PoseSlot", "Slot", "custom_factor"]


@dataclass(frozen=True)
class Key:
    """A slot with a variable of the graph."""

    key: int


@dataclass(frozen=True)
class Fixed:
    """A slot with a constant value."""

    value: Any


@dataclass(frozen=True)
class Corrected:
    """A pose slot of which the graph estimates a correction (geometry.corrected_poses): a vector variable."""

    key: int
    nominal: gtsam.Pose3
    free: tuple[int, ...]
    """Indices of the entries of the correction (6) that the variable has; the others are 0."""

    def pose(self, values: gtsam.Values) -> tuple[gtsam.Pose3, FloatArray]:
        """The pose at the values, and its body-frame twist by the variable (6, n)."""
        correction, free = np.zeros(6), list(self.free)
        correction[free] = values.atVector(self.key)
        nominal = self.nominal.rotation().matrix(), self.nominal.translation()
        rotation, translation = corrected_poses(*nominal, correction)
        return gtsam.Pose3(gtsam.Rot3(rotation), translation), correction_twists(correction)[:, free]


Slot = Key | Fixed
PoseSlot = Key | Fixed | Corrected
Kind = Literal["pose", "vector", "point", "number", "calibration"]
"""What a slot holds: a gtsam.Pose3, a vector, a Point3, a number, a Cal3_S2."""

Residual = Callable[..., tuple[FloatArray, tuple[FloatArray, ...]]]
"""Takes the values of each slot at n sites (poses as rotations (n, 3, 3) and translations (n, 3), vectors
(n, k), numbers (n,), calibrations as fx, fy, skew, cx, cy (n, 5)); returns residuals (n, m) and one Jacobian
(n, m, tangent) per slot."""


def custom_factor(
    noise: gtsam.noiseModel.Base,
    slots: Sequence[tuple[PoseSlot | Sequence[PoseSlot], Kind]],
    residual: Residual,
) -> gtsam.CustomFactor:
    """A GTSAM factor from a pure residual, over those of its slots that are variables.

    Each slot comes with the kind of value that it holds. One factor may serve many sites (the images of a
    stop): each slot is then a sequence with one entry a site, all sites are evaluated at once, and the rows
    of the factor are those of one site after the other. An exception in the residual reaches the caller of
    the optimiser with its own type and message.
    """
    readers = [
        _Reader([slot] if isinstance(slot, Key | Fixed | Corrected) else slot, kind) for slot, kind in slots
    ]
    # By key: reader, distinct slot of the reader, and the sites that have this slot.
    places: dict[int, list[tuple[int, int, IntArray]]] = {}
    for i, reader in enumerate(readers):
        for j, slot in enumerate(reader.distinct):
            if not isinstance(slot, Fixed):
                places.setdefault(slot.key, []).append((i, j, np.flatnonzero(reader.place == j)))

    def evaluate(
        _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        error, derivatives = residual(*(reader.read(values) for reader in readers))
        if jacobians is not None:
            for k, uses in enumerate(places.values()):
                block: FloatArray | None = None
                for i, j, sites in uses:
                    part = derivatives[i][sites]
                    if (twist := readers[i].twist(j)) is not None:
                        part = part @ twist
                    if block is None:
                        block = np.zeros((*error.shape, part.shape[2]))
                    block[sites] += part
                assert block is not None
                jacobians[k] = np.asfortranarray(block.reshape(error.size, -1))
        return np.asarray(error).ravel()

    return gtsam.CustomFactor(noise, list(places), evaluate)


def _calibration(values: gtsam.Values, key: int) -> FloatArray:
    """fx, fy, skew, cx and cy of a variable of GTSAM's type Cal3_S2."""
    return np.asarray(values.atCal3_S2(key).vector())


class _Reader:
    """Reads the values of one slot at all sites; a variable that several sites share is read once."""

    def __init__(self, slots: Sequence[PoseSlot], kind: Kind) -> None:
        index: dict[tuple[int, int], int] = {}
        self.distinct: list[PoseSlot] = []
        place = []
        for slot in slots:
            name = (-1, id(slot.value)) if isinstance(slot, Fixed) else (slot.key, 0)
            if isinstance(slot, Corrected):
                name = slot.key, id(slot.nominal)  # eyes that share a correction have mounts of their own
            if name not in index:
                index[name] = len(self.distinct)
                self.distinct.append(slot)
            place.append(index[name])
        self.place = np.array(place, dtype=np.int64)
        self._read = {
            "pose": gtsam.Values.atPose3,
            "vector": gtsam.Values.atVector,
            "point": gtsam.Values.atPoint3,
            "number": gtsam.Values.atDouble,
            "calibration": _calibration,
        }[kind]
        self._is_pose = kind == "pose"
        self._twist: dict[int, FloatArray] = {}

    def read(self, values: gtsam.Values) -> Any:
        """Rotations and translations, or vectors, or numbers, of all sites."""
        values_read: list[Any] = []
        for j, slot in enumerate(self.distinct):
            if isinstance(slot, Corrected):
                pose, self._twist[j] = slot.pose(values)
                values_read.append(pose)
            else:
                values_read.append(self._read(values, slot.key) if isinstance(slot, Key) else slot.value)
        if not self._is_pose:
            return np.array(values_read)[self.place]
        rotations, translations = pose_arrays(values_read)
        return rotations[self.place], translations[self.place]

    def twist(self, distinct: int) -> FloatArray | None:
        """Body-frame twist (6, n) of a corrected pose by its variable, at the values read last; else None."""
        return self._twist.get(distinct)
