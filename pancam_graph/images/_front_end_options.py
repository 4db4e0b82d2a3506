"""Options of the image front end."""

from dataclasses import dataclass, fields
from typing import Literal

from pancam_graph.base.errors import InputError

__all__ = ["FrontEndOptions"]


@dataclass(frozen=True, kw_only=True)
class FrontEndOptions:
    """How observations are found in images. The defaults suit mast cameras over natural terrain.

    Raises InputError for a number that is not above 0, and for a ratio of 1 or more.
    """

    tile_px: float = 64.0
    """Size of the tiles over which brightness and contrast are evened out."""
    max_contrast_gain: float = 4.0
    """Limit of the factor that raises contrast; a higher one finds more features in haze, and more noise."""
    contrast_threshold: float = 0.01
    """Threshold of SIFT; a lower one finds fainter features."""
    max_features: int = 6_000
    """The strongest features kept per image, evenly over a grid of cells, where all of it overlaps others.

    Where half of the image does, four times as many are kept, up to 20 000: a narrow overlap needs more."""
    max_ties: int = 2_500
    """If an image shares more points with others, the points that most images see are kept, evenly over a
    grid of cells. A point is kept in all its images if one of them keeps it."""
    min_apart_px: float = 8.0
    """Of points of an image that are nearer to each other one is kept: their patches overlap, and so their
    errors are alike."""
    min_depth_m: float = 0.5
    """Nothing nearer than this is matched."""
    min_overlap: float = 0.05
    """Images of one stop of which less can overlap, as a share of either, are not compared."""
    min_overlap_between_stops: float = 0.25
    """The same for images of two stops, whose terrain may lie at any depth: most that can overlap do not."""
    max_stop_distance_m: float = 20.0
    """Images of stops further apart are not compared, telemetry off by two of its sigmas at most."""
    search_sigmas: float = 4.0
    """How many standard deviations of the telemetry the search window reaches."""
    search_slack_px: float = 3.0
    """Added to the search window, for errors that the standard deviations of telemetry leave out."""
    mount_sigma_rad: float = 1.05e-3
    """How well an eye's orientation on the head is known, twist and flex of the mast included."""
    ratio: float = 0.85
    """Largest distance of a match's descriptors relative to the best other candidate in the window."""
    max_descriptor_distance: float = 0.5
    """Largest distance between a match's descriptors, which have unit length."""
    guided_slack_px: float = 2.0
    """Half width of the window of the second search, along the epipolar segments that the first one found."""
    max_epipolar_px: float = 1.5
    """A match further than this from its epipolar segment is rejected, whatever the scatter of the others."""
    epipolar_scales: float = 4.0
    """A match is rejected further than this many robust standard deviations from its epipolar segment."""
    min_pair_matches: int = 12
    """A pair of images with fewer verified matches gives none."""
    sigma_px: float = 0.2
    """Standard deviation of each coordinate of a feature of size 0. A solve rescales this guess."""
    sigma_per_size: float = 0.03
    """What a feature's diameter adds to its standard deviation, in quadrature, as a share of the diameter."""
    masks: Literal["automatic", "user"] = "automatic"
    """Whether sky, saturated pixels and the rover are left out too, or only what the user's masks cover."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.masks not in {"automatic", "user"}:
            raise InputError(f"FrontEndOptions: masks: expected automatic or user, found {self.masks!r}")
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not isinstance(value, str) and not value > 0:
                raise InputError(f"FrontEndOptions: {entry.name}: expected a number above 0, found {value}")
        if self.ratio >= 1:
            raise InputError(f"FrontEndOptions: ratio: expected a number below 1, found {self.ratio}")
