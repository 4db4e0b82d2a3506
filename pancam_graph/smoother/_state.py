"""The state of a smoother, as files keep it."""

from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import Traverse
from pancam_graph.graph import Kind, kind_of, read_variable
from pancam_graph.smoother._batch import whole_traverse
from pancam_graph.smoother._map import DriveMap
from pancam_graph.smoother._smoother_options import SmootherOptions

__all__ = ["SmootherState", "state_of"]


@dataclass(frozen=True, kw_only=True, eq=False)
class SmootherState:
    """State of a drive, from which the tree of iSAM2 is rebuilt."""

    traverse: Traverse
    """All stops with all observations, in the order in which they were added."""
    options: SmootherOptions
    after: IntArray
    """(stops,) number of the stop from which odometry leads to each; -1: none"""
    fate: IntArray
    """(observations,) values of `Fate`"""
    track: IntArray
    """(landmarks,) track numbers, ascending"""
    home: IntArray
    """(landmarks,) number of the stop that names each landmark's block"""
    vector: FloatArray
    """(landmarks, 4) homogeneous coordinates about `origin_m`"""
    origin_m: FloatArray
    """(landmarks, 3) in the world"""
    key: IntArray
    """(variables,) keys as GTSAM's integers"""
    width: IntArray
    """(variables,) how many entries of `value` each has"""
    value: FloatArray
    """Numbers of all variables, one after the other; of a pose the first three rows of its matrix."""
    n_given: int = 0
    """Number of the caller's factors, which a file cannot keep."""

    @staticmethod
    def numbers(values: gtsam.Values, key: int) -> FloatArray:
        """A variable as numbers."""
        value = read_variable(values, key)
        return value.matrix()[:3].ravel() if isinstance(value, gtsam.Pose3) else np.atleast_1d(value)

    def values(self) -> gtsam.Values:
        """The variables."""
        out = gtsam.Values()
        parts = np.split(self.value, np.cumsum(self.width)[:-1])
        for key, numbers in zip(self.key.tolist(), parts, strict=True):
            if kind_of(key) is Kind.MAST:
                matrix = numbers.reshape(3, 4)
                out.insert(key, gtsam.Pose3(gtsam.Rot3(matrix[:, :3]), matrix[:, 3]))
            else:
                out.insert(key, numbers)
        return out


def state_of(drive: DriveMap, options: SmootherOptions, values: gtsam.Values) -> SmootherState:
    """The state of a drive at these values of its variables."""
    numbers = SmootherState.numbers
    blocks = [(name, block.placed) for name, block in sorted(drive.blocks.items())]
    keys = list(values.keys())
    parts = [numbers(values, key) for key in keys]
    none = np.zeros(0, dtype=np.int64)
    return SmootherState(
        traverse=whole_traverse(drive),
        options=options,
        after=np.array([s.after for s in drive.stations], dtype=np.int64),
        fate=drive.ledger.fate.astype(np.int64),
        track=np.concatenate([none, *(placed.track for _, placed in blocks)]),
        home=np.concatenate([none, *(np.full(len(placed.track), name) for name, placed in blocks)]),
        vector=np.concatenate([np.zeros((0, 4)), *(placed.landmarks.vector for _, placed in blocks)]),
        origin_m=np.concatenate([np.zeros((0, 3)), *(placed.landmarks.origin_m for _, placed in blocks)]),
        key=np.array(keys, dtype=np.int64),
        width=np.array([len(part) for part in parts], dtype=np.int64),
        value=np.concatenate([np.zeros(0), *parts]),
        n_given=len(drive.given),
    )
