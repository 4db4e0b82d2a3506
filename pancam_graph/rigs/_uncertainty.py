"""How far the numbers of a rig may be off."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import FIELD_PER_COEFFICIENT
from pancam_graph.rigs._covariance import ASPECT, FOCAL, RigCovariance, RigEntry

__all__ = ["RigUncertainty"]

_PRINCIPAL_POINT = 5e-3
_SKEW = 2e-4
_FIELD = 3.6e-5
"""Usual sigmas of principal point, skew and smooth field, as shares of the image's longer side."""
_NO_SIGMA = ("source", "covariance")
"""Fields that are no standard deviations."""


@dataclass(frozen=True, kw_only=True)
class RigUncertainty:
    """Standard deviations of a rig's numbers about the values that it states; 0: known exactly.

    Errors of different eyes, and of different entries, are independent, except for those that the covariance
    names. The defaults are our stated assumption for a calibrated rig of which nothing more is known, with
    images of 1024 px; `usual` scales them to other images. Raises InputError for a negative sigma, for one
    that is not finite, and for a covariance of entries whose sigma here is 0.
    """

    focal: float = 5e-3
    """Of each eye's focal length, as a share of it."""
    aspect: float = 5e-4
    """Of each eye's ratio fy / fx, as a share of it."""
    principal_point_px: float = _PRINCIPAL_POINT * 1024
    """Of each coordinate of each eye's principal point."""
    skew_px: float = _SKEW * 1024
    """Of each eye's skew."""
    mount_rad: float = 1e-3
    """Of each eye's `head_T_camera`: each component of its turn, in the camera's frame."""
    mount_m: float = 1e-3
    """Of each component of its shift."""
    tilt_axis_rad: float = 1e-3
    """Of `pan_T_tilt`: each component of its turn, in the tilt frame."""
    tilt_axis_m: float = 2e-3
    """Of each component of its shift."""
    flex_rad: float = 2e-4
    """Of each frame: how far the head stands turned from where the joints put it, about each of the pan axis,
    the tilt axis and its forward axis."""
    flex_m: float = 0.0
    """Of each frame: how far the head stands shifted, along each of its own axes."""
    pan_scale: float = 0.0
    """Of the pan that the head turns over the pan that is read, as a share. Gears and encoders that count
    whole turns have none; a servo or a potentiometer may be off by a percent. An offset of the readings is
    a turn of the tilt axis (`tilt_axis_rad`): about z that of pans, about y that of tilts."""
    tilt_scale: float = 0.0
    """Of the tilt, likewise; tilts count from the horizon of the mast."""
    field_px: float = _FIELD * 1024
    """Of each component of each eye's smooth distortion field, at a pixel: what its lens leaves, without
    shift, stretch and shear of the image, which are the calibration's."""
    source: str = "our stated assumption for a calibrated rig"
    """Where the numbers come from."""
    covariance: RigCovariance | None = None
    """Joint covariance of the entries that it names, in place of their sigmas; None: of none."""

    def __post_init__(self) -> None:
        """Check the sigmas, and that the covariance has no entry that is exact."""
        for name, sigma in self.sigmas.items():
            if not (np.isfinite(sigma) and sigma >= 0):
                raise InputError(
                    f"uncertainty: {name}: expected 0 (exact) or a positive number, found {sigma}"
                )
        for entry in () if self.covariance is None else self.covariance.entries:
            if self.sigma_of(entry.quantity, entry.entry) == 0:
                raise InputError(
                    f"uncertainty: covariance: expected entries whose own sigma is above 0, found "
                    f"{entry.entry} of {entry.quantity}, which is exact"
                )

    @property
    def sigmas(self) -> dict[str, float]:
        """The standard deviations by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _NO_SIGMA}

    def sigma_of(self, quantity: str, entry: str) -> float:
        """The standard deviation of an entry of `RIG_ENTRIES`, whatever its eye and the covariance."""
        if quantity == "calibration":
            of_entry = {FOCAL: self.focal, ASPECT: self.aspect, "skew_px": self.skew_px}
            return of_entry.get(entry, self.principal_point_px)
        if quantity == "field":
            return self.field_px / FIELD_PER_COEFFICIENT
        turn, shift = (
            (self.mount_rad, self.mount_m) if quantity == "mounts" else (self.tilt_axis_rad, self.tilt_axis_m)
        )
        return turn if entry.endswith("_rad") else shift

    def covariance_of(self, entries: Sequence[RigEntry]) -> FloatArray:
        """Joint covariance (n, n) of some entries; of those that no covariance names the sigmas count."""
        sigma = np.array([self.sigma_of(entry.quantity, entry.entry) for entry in entries])
        joint = self.covariance or RigCovariance(entries=(), matrix=np.zeros((0, 0)))
        return joint.among(entries, sigma)

    @staticmethod
    def exact() -> "RigUncertainty":
        """Of a rig whose numbers are all known."""
        zero: dict[str, Any] = {f.name: 0.0 for f in fields(RigUncertainty) if f.name not in _NO_SIGMA}
        return replace(RigUncertainty(), **zero, source="exact")

    @staticmethod
    def usual(side_px: int) -> "RigUncertainty":
        """The defaults for images whose longer side has so many pixels.

        Principal point: 0.5 % of that side (the principal points of the two Mars 2020 Navcams differ by
        0.35 % of it, that of Opportunity's left Navcam is 1 % off its label). Skew: 0.02 % (image axes of
        CAHV labels are off a right angle by up to 0.012 degrees). Smooth field: 0.0036 %, with which images
        of Navcams of Opportunity and Curiosity are likeliest (docs/accuracy.md).
        """
        return RigUncertainty(
            principal_point_px=_PRINCIPAL_POINT * side_px,
            skew_px=_SKEW * side_px,
            field_px=_FIELD * side_px,
        )

    @staticmethod
    def of_unit(side_px: int) -> "RigUncertainty":
        """Of one flight unit as its own calibration has it: mounts and axes are better known than usual ones.

        Our stated assumption.
        """
        return replace(
            RigUncertainty.usual(side_px),
            mount_rad=5e-4,
            mount_m=5e-4,
            tilt_axis_rad=5e-4,
            tilt_axis_m=1e-3,
        )
