"""What is simulated: the drive and its telemetry, then observations of points or rendered images."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pancam_graph.base.errors import InputError

__all__ = ["DriveOptions", "RenderOptions", "SimulationOptions"]


@dataclass(frozen=True, kw_only=True)
class DriveOptions:
    """Where the mast stands and points, and what telemetry says of it.

    Raises InputError naming the option that makes no sense.
    """

    stops: int = 3
    """Number of places where the mast stands."""
    spacing_m: float = 4.0
    """Distance driven from stop to stop."""
    loop: bool = False
    """Whether the drive comes back to where it began: its heading turns by a circle in all, beside the random
    changes. Points found on one side of the joint are looked for on the other."""
    heading_change_rad: float = 0.25
    """Standard deviation of the change of heading from stop to stop."""
    sweep_rad: float | None = 2 * np.pi
    """Range of pan that a panorama covers, centred on straight ahead. None: all around, or as far as the
    pans reach whose frames overlap.

    A rig that does not turn (a Ladybug) takes one frame per stop, whatever sweep_rad, pans and tilts_rad say.
    """
    pans: int | None = None
    """Frames per row of a panorama. None: as many as make the widest eye's neighbours overlap by 28 %."""
    tilts_rad: tuple[float, ...] | None = None
    """Tilt of each row. None: two rows that overlap by 28 %, the upper one with the horizon in it."""
    pointing_scale: float = 1.0
    """Standard deviation of pan and tilt telemetry as a multiple of the rig's; 0: exact, and held."""
    sigma_stop_m: float = 0.1
    """Standard deviation of each component of a stop's position, but the first, which is held."""
    sigma_stop_rad: float = 0.01
    """Standard deviation of each component of a stop's rotation, but the first, which is held."""
    odometry: bool = False
    """Whether these are of the motion from the stop before, so that errors add up along the drive."""
    focal_error: float = 0.0
    """Standard deviation of the focal length of each eye in the rig that the traverse claims, as a share."""
    mount_error_rad: float = 0.0
    """Standard deviation of each component of the rotation of each mount in that rig."""
    mount_error_m: float = 0.0
    """Standard deviation of each component of the position of each mount in that rig."""
    radius_error_m: float = 0.0
    """Standard deviation of the radius of each eye's circle in that rig, at the mean tilt."""
    rig_error: Literal["none", "drawn"] = "none"
    """Errors of that rig beside these: "none", or "drawn" from its own uncertainty (`Rig.uncertainty`)."""

    def __post_init__(self) -> None:
        """Check ranges."""
        self._require_whole("stops", 1)
        self._require_whole("pans", 1, or_none=True)
        tilts = self.tilts_rad
        expected = "one or more angles from -pi/2 to pi/2"
        self._require("tilts_rad", tilts is None or len(tilts) > 0, expected)
        self._require("tilts_rad", all(abs(t) <= np.pi / 2 for t in tilts or ()), expected)
        for name in (
            "spacing_m",
            "heading_change_rad",
            "pointing_scale",
            "sigma_stop_m",
            "sigma_stop_rad",
            "focal_error",
            "mount_error_rad",
            "mount_error_m",
            "radius_error_m",
        ):
            self._require(name, 0 <= getattr(self, name) < np.inf, "a number of 0 or above")
        self._require("rig_error", self.rig_error in {"none", "drawn"}, "'none' or 'drawn'")
        sweep = self.sweep_rad
        self._require("sweep_rad", sweep is None or 0 < sweep <= 2 * np.pi, "an angle above 0, up to 2 pi")

    def _require_whole(self, name: str, low: int, *, or_none: bool = False) -> None:
        value = getattr(self, name)
        fits = or_none if value is None else isinstance(value, int | np.integer) and bool(value >= low)
        self._require(name, fits, f"a whole number of {low} or more")

    def _require(self, name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise InputError(f"simulation: {name}: expected {expected}, found {getattr(self, name)!r}")


@dataclass(frozen=True, kw_only=True)
class RenderOptions(DriveOptions):
    """What is driven and photographed. Raises InputError naming the option that makes no sense."""

    stops: int = 2
    spacing_m: float = 7.0
    sweep_rad: float | None = None
    pans: int | None = 10
    tilts_rad: tuple[float, ...] | None = None
    """Tilt of each row. None: one row with the horizon near its upper edge."""
    rock_abundance: float = 0.05
    """Share of the ground that rocks cover, on average (Golombek and Rapp 1997: 0.02 to 0.3 on Mars)."""
    ridge_m: float = 900.0
    """Mean distance of the ridge around."""
    sun_elevation_rad: float = float(np.deg2rad(38.0))
    """Height of the sun."""
    sun_azimuth_rad: float = float(np.deg2rad(125.0))
    """Its direction, anticlockwise from the world's x axis, which is where the rover heads first."""
    bits: Literal[8, 12] = 8
    """Of the samples; 12 are stored in 16."""
    sensor_noise: float = 1.0
    """Shot and read noise as a multiple of a rover CCD's; 0: none."""
    vignetting: float = 0.08
    """Share of light that is lost in the image's corners."""
    deck: bool = False
    """Whether the rover's own deck is in the images; it moves along from stop to stop."""

    def __post_init__(self) -> None:
        """Check ranges."""
        super().__post_init__()
        self._require("rock_abundance", 0 <= self.rock_abundance <= 0.3, "a share from 0 to 0.3")
        self._require("ridge_m", 100 <= self.ridge_m <= 5000, "a distance from 100 m to 5 km")
        low, high = np.deg2rad([15, 90])
        self._require(
            "sun_elevation_rad", low <= self.sun_elevation_rad <= high, "an angle from 0.262 to pi/2"
        )
        self._require("sun_azimuth_rad", bool(np.isfinite(self.sun_azimuth_rad)), "an angle")
        self._require("bits", self.bits in {8, 12}, "8 or 12")
        self._require("sensor_noise", 0 <= self.sensor_noise < np.inf, "a number of 0 or above")
        self._require("vignetting", 0 <= self.vignetting < 1, "a share of 0 or above, below 1")


@dataclass(frozen=True, kw_only=True)
class SimulationOptions(DriveOptions):
    """What is driven, seen and measured. Raises InputError naming the option that makes no sense."""

    slope_rad: float = 0.05
    """RMS slope of the rolling ground along x and y, and so of the mast's roll and pitch."""
    rocks: float = 0.6
    """Share of square metres of ground with a rock on them."""
    ridge_m: float = 1500.0
    """Mean distance from the drive to the ridge that surrounds it."""
    points_per_image: int = 25
    """Terrain points looked for in each image; it also sees those of the images that overlap it."""
    detection: float = 0.6
    """Chance that an image that sees a point yields an observation of it."""
    link_stops: int = 3
    """How many stops before and after the one that found a point look for it again."""
    reach_m: float = np.inf
    """Points farther than this from a camera are not matched in its images; infinite: out to the ridge."""
    max_turn_rad: float = float(np.deg2rad(40.0))
    """A point is not matched in images that see it from farther around than this from where it was found."""
    max_zoom: float = 2.0
    """Nor in those that see it from more than so many times nearer or farther."""
    min_views: int = 2
    """Tracks with fewer observations are dropped."""
    noise_px: float = 0.3
    """Standard deviation of each coordinate of an observation; with 0, they are said to have 0.3."""
    noise_stretch: float = 1.0
    """How many times longer than wide an observation's error ellipse is; its direction is drawn at random.

    Above 1 observations get covariances. Their mean variance is that of `noise_px`."""
    field_error: Literal["none", "drawn"] = "none"
    """Smooth distortion field of each eye, of which the traverse does not know: "none", or "drawn" from the
    rig's uncertainty (`RigUncertainty.field_px`)."""
    outliers: float = 0.0
    """Share of observations that are a random pixel of their image instead."""
    prior: Literal["telemetry", "truth"] = "telemetry"
    """Where the traverse's stop poses and angles are: at the disturbed telemetry, or at the truth.

    With "truth" and no noise the adjustment must return the truth, whatever it starts from.
    """

    def __post_init__(self) -> None:
        """Check ranges."""
        super().__post_init__()
        self._require("field_error", self.field_error in {"none", "drawn"}, "'none' or 'drawn'")
        for name, low in (("points_per_image", 1), ("link_stops", 0), ("min_views", 2)):
            self._require_whole(name, low)
        self._require("noise_px", 0 <= self.noise_px < np.inf, "a number of 0 or above")
        self._require("noise_stretch", 1 <= self.noise_stretch <= 1e4, "a number from 1 to 10000")
        self._require("slope_rad", 0 <= self.slope_rad <= 0.3, "a number from 0 to 0.3")
        self._require("rocks", 0 <= self.rocks <= 1, "a share from 0 to 1")
        self._require("ridge_m", 100 <= self.ridge_m <= 1e5, "a distance from 100 m to 100 km")
        self._require("reach_m", self.reach_m >= 1, "a distance of 1 m or more, or infinity")
        self._require("max_turn_rad", 0 < self.max_turn_rad <= np.pi, "an angle above 0, up to pi")
        self._require("max_zoom", 1 <= self.max_zoom < np.inf, "a number of 1 or above")
        self._require("detection", 0 < self.detection <= 1, "a chance above 0, up to 1")
        self._require("outliers", 0 <= self.outliers < 1, "a share of 0 or above, below 1")
        self._require("prior", self.prior in {"telemetry", "truth"}, "'telemetry' or 'truth'")
