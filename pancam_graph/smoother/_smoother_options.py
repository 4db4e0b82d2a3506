"""What a smoother is told, and what its updates return."""

from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Sharing

__all__ = ["Closure", "Estimate", "SmootherOptions", "Update"]


@dataclass(frozen=True, kw_only=True)
class SmootherOptions:
    """How to follow a drive. Raises InputError naming the option that makes no sense."""

    telemetry: Literal["absolute", "odometry"] = "absolute"
    """How stops' poses and sigmas are meant: "absolute": each is a prior of its own, as `solve` takes it;
    "odometry": of all but the first, only the motion from one stop to the next counts, and the sigmas are
    that motion's, in the body frame of the later stop."""
    sharing: Sharing | None = None
    """What of the rig is free, and who shares it; None: nothing is. As for `solve` with the model `mast`."""
    relinearise_rad: float = 1e-3
    """A block of landmarks is linearised anew where an angle, or how its masts are turned against each
    other, has moved by more."""
    relinearise_m: float = 1e-2
    """The same for how its masts stand to each other."""
    relinearise_rig: float = 1e-3
    """The same for free entries of the rig: radians, metres, shares of a focal length; a hundred times as
    much for pixels."""
    outlier_sigma: float | None = 4.0
    """An observation goes where noise would take it less often than a Gaussian beyond this many sigmas; None:
    all are kept."""
    closure_probability: float = 1e-6
    """A loop closure is believed unless a right one would contradict the drive as much less often than so."""
    max_rounds: int = 8
    """So many times at most an update is linearised anew; then, or where a step raises the cost, all is
    solved by Levenberg-Marquardt, as `solve` does."""

    def __post_init__(self) -> None:
        """Check the choices."""
        if self.telemetry not in {"absolute", "odometry"}:
            raise InputError(f"telemetry: expected one of absolute, odometry; found {self.telemetry!r}")
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


@dataclass(frozen=True, kw_only=True)
class Closure:
    """Observations of a stop that join it to a part of the drive that odometry had left behind."""

    stop: str
    other: str
    """The stop of that part which shares most of the tracks."""
    observations: int
    inliers: float
    """The share of them that agrees on one pose of the stop."""
    sigmas: float
    """By how much that pose contradicts the drive: the sigma beyond which a Gaussian is as rare."""
    shift_m: float
    """How far it is from where the drive had the stop."""
    accepted: bool


@dataclass(frozen=True, kw_only=True)
class Update:
    """What an update did."""

    stop: str | None
    """Of `add_stop`."""
    observations: int
    """New ones, or those removed."""
    rejected: int
    """Observations that this update rejected, old ones too."""
    blocks: int
    """Blocks of landmarks that were removed and added again, or added."""
    rounds: int
    """Updates of iSAM2."""
    relinearised: int
    """Variables that moved to another point of linearisation; one that moved twice counts twice."""
    cost: float
    """Of everything, after: half the sum of squares. Blocks far from what changed by their linear model."""
    seconds: float
    fell_back: bool
    """Whether all was solved anew by Levenberg-Marquardt, since iSAM2's steps did not lower the cost."""
    closures: tuple[Closure, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """Where everything is, in the order in which it was added."""

    stops: tuple[str, ...]
    world_T_mast: tuple[gtsam.Pose3, ...]
    frames: tuple[str, ...]
    pan_tilt_rad: FloatArray
    """(frames, 2)"""
