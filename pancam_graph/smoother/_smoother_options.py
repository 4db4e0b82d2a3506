"""Options of a smoother, and the results of its updates."""

from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import FIXED, Sharing, sharing_for
from pancam_graph.rigs import Rig

__all__ = ["Closure", "Estimate", "SmootherOptions", "Update"]


@dataclass(frozen=True, kw_only=True)
class SmootherOptions:
    """Options of a smoother. Raises InputError naming an option that is out of its range."""

    telemetry: Literal["absolute", "odometry"] = "absolute"
    """Meaning of the stops' poses and sigmas: "absolute": each is a prior on its mast pose, as in `solve`;
    "odometry": after the first stop a pose counts only by the motion from the stop before, and the sigmas are
    those of that motion, in the body frame of the later stop."""
    rig: Literal["estimated", "held"] = "estimated"
    """What becomes of the rig's uncertainty, as for `solve`, which alone has "considered" too."""
    sharing: Sharing | None = None
    """Free entries of the rig and who shares them, as for `solve` with the model `mast`, in place of those
    that `rig` makes free."""
    relinearise_rad: float = 1e-3
    """Change of an angle, or of the rotation between two masts of a block, radians, beyond which the block is
    linearised again."""
    relinearise_m: float = 1e-2
    """The same for the translation between two masts of a block, metres."""
    relinearise_rig: float = 1e-3
    """The same for free entries of the rig: radians, metres, or shares of a focal length; a hundred times as
    much for entries in pixels."""
    outlier_sigma: float | None = 4.0
    """Cutoff of the test for outliers, in sigmas of a Gaussian of equal probability; None: no observation is
    rejected."""
    closure_probability: float = 1e-6
    """Significance level of the test of loop closures: one is rejected where a right closure would contradict
    the drive as much with a smaller probability."""
    max_rounds: int = 8
    """Largest number of rounds of iSAM2 in an update; after these, or where a step raises the cost,
    Levenberg-Marquardt solves the whole drive, as `solve` does."""

    def __post_init__(self) -> None:
        """Check the choices."""
        if self.telemetry not in {"absolute", "odometry"}:
            raise InputError(f"telemetry: expected one of absolute, odometry; found {self.telemetry!r}")
        if self.rig not in {"estimated", "held"}:
            raise InputError(f"rig: expected one of estimated, held; found {self.rig!r}")
        for name in ("relinearise_rad", "relinearise_m", "relinearise_rig", "outlier_sigma"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"{name}: expected a number above 0, found {value}")
        if not 0 < self.closure_probability < 1:
            raise InputError(
                f"closure_probability: expected a number between 0 and 1, found {self.closure_probability}"
            )
        if self.max_rounds < 1:
            raise InputError(f"max_rounds: expected 1 or more, found {self.max_rounds}")
        if self.sharing is not None:
            self.sharing.for_model("mast")

    def sharing_of(self, rig: Rig) -> Sharing:
        """Free entries of a drive's rig, as `Sharing.for_model` returns them; fields of eyes are held."""
        return replace(sharing_for(rig, "mast", self.rig, self.sharing), field=FIXED)


@dataclass(frozen=True, kw_only=True)
class Closure:
    """A loop closure: observations of a stop that join it to a part of the drive far off."""

    stop: str
    """Id of the stop that observes."""
    other: str
    """Id of the stop of that part which shares most of the tracks."""
    observations: int
    """Number of the observations that close the loop."""
    inliers: float
    """Share of the observations that agree on one pose of the stop."""
    sigmas: float
    """Deviation of that pose from the drive, in sigmas of a Gaussian of equal probability."""
    shift_m: float
    """Distance of that pose from the drive's estimate, metres."""
    accepted: bool
    """Whether the observations take part."""


@dataclass(frozen=True, kw_only=True)
class Update:
    """Summary of an update."""

    stop: str | None
    """Id of the stop that `add_stop` added; None for other updates."""
    observations: int
    """Number of observations added or removed."""
    rejected: int
    """Number of observations rejected by this update, old ones included."""
    blocks: int
    """Number of landmark blocks added, or removed and added again."""
    rounds: int
    """Number of updates of iSAM2."""
    relinearised: int
    """Number of variables linearised again; one in two rounds counts twice."""
    cost: float
    """Total cost after the update: half the sum of squared whitened residuals. Blocks far from the changes
    count by their linear model."""
    seconds: float
    """Wall-clock time."""
    fell_back: bool
    """Whether Levenberg-Marquardt solved the whole drive, since the steps of iSAM2 did not lower the cost."""
    closures: tuple[Closure, ...] = ()
    """Loop closures that were tested."""
    warnings: tuple[str, ...] = ()
    """What a user should know of the update, a sentence each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """Estimated mast poses and angles, in the order in which stops were added."""

    stops: tuple[str, ...]
    """Id of each stop."""
    world_T_mast: tuple[gtsam.Pose3, ...]
    """Mast pose of each stop."""
    frames: tuple[str, ...]
    """Id of each frame."""
    pan_tilt_rad: FloatArray
    """(frames, 2) pan and tilt of each frame, radians"""
