"""How heads of frames stand off the rigid mast, as variables of a template."""

from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import ENTRIES, Freedom, RigCorrection, Traverse
from pancam_graph.factors import Corrected, Fixed, PoseSlot

__all__ = ["HeadFlex"]

_COLUMNS = np.array([0, 3, 4, 5])
"""Components of a head's correction, a turn and a shift, that the entries of its flex are."""


class HeadFlex:
    """Free entries of the flex of each frame's head, with their priors; false where the mast is rigid.

    A frame whose pan and tilt telemetry holds does not flex.
    """

    def __init__(self, freedom: Freedom) -> None:
        """`freedom` of the quantity `flex`."""
        self.entries = freedom.entries("flex")
        self.columns: IntArray = _COLUMNS[[ENTRIES["flex"].index(e) for e in self.entries]]
        """(entries,) among the components of a correction of the head."""
        self.sigma = np.array([freedom.sigma_of(e) for e in self.entries])
        """(entries,) of the priors."""

    def __bool__(self) -> bool:
        """Whether heads flex."""
        return bool(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def widened(self, sigmas_rad: FloatArray) -> FloatArray:
        """Sigmas (frames, 2) of pan and tilt, where heads turn as far about these axes as about their own.

        Held ones, 0, stay 0.
        """
        twist = self.sigma[0] if "twist_rad" in self.entries else 0.0
        return np.where(sigmas_rad > 0, np.hypot(sigmas_rad, twist), 0.0)

    def prior(self, key: int, n_frames: int) -> gtsam.NonlinearFactor:
        """The prior of a variable that has the flex of so many frames, one after the other."""
        sigmas = np.tile(self.sigma, n_frames)
        return gtsam.PriorFactorVector(key, np.zeros(len(sigmas)), gtsam.noiseModel.Diagonal.Sigmas(sigmas))

    def start(self, rig: RigCorrection | None, n_frames: int) -> FloatArray:
        """(frames, entries) of a correction of the rig; 0 where it has none."""
        flex = np.zeros((n_frames, 6))
        if rig is not None and rig.flex is not None:
            flex[:, _COLUMNS] = rig.flex
        return flex[:, self.columns]

    def slot(self, key: int | None) -> PoseSlot | None:
        """Slot of a frame's `tilted_T_head`: its variable, or fixed without a key; None: no head flexes."""
        if not self:
            return None
        identity = gtsam.Pose3()
        return Fixed(identity) if key is None else Corrected(key, identity, tuple(self.columns.tolist()))

    def with_flex(
        self, found: RigCorrection | None, flex: FloatArray | None, traverse: Traverse
    ) -> RigCorrection | None:
        """A correction of a rig with that of all heads (frames, 6) beside it."""
        if flex is None:
            return found
        found = found or RigCorrection.to_calibrations(traverse, traverse.calibration)
        return replace(found, flex=flex[:, _COLUMNS])
