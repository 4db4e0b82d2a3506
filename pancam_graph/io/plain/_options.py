"""What is told of plain pictures."""

from dataclasses import dataclass
from pathlib import Path

__all__ = ["POINTING_COLUMNS", "STOP_COLUMNS", "PlainOptions"]

POINTING_COLUMNS = "file, pan_deg, tilt_deg"
"""Columns of a table of known pointing."""
STOP_COLUMNS = "stop, x_m, y_m, z_m"
"""Columns that a table of stops must have."""


@dataclass(frozen=True, kw_only=True)
class PlainOptions:
    """What is told of a folder of plain pictures."""

    pointing: Path | None = None
    """CSV file with the pointing of each picture, or with their cameras and frames alone; None: not known."""
    stops: Path | None = None
    """CSV file with the place of each stop; a single stop needs none."""
    rig: str | None = None
    """A template by name, or the path of a JSON file; None: a rig is made from EXIF and the numbers below."""
    clockwise: bool = False
    """Whether pans of the table count clockwise seen from above, as azimuths do."""
    sigma_rad: float | None = None
    """Standard deviation of pans and tilts for which the table has none; None: that of a template, or 0.5
    degrees."""
    focal_px: float | None = None
    """Focal length of every camera of the rig that is made; None: by `field_rad`, or EXIF; without
    these, pictures of unknown pointing tell it."""
    field_rad: float | None = None
    """Horizontal field of view of every camera, of the picture as it is stored; None: not told."""
    focal_sigma: float | None = None
    """Standard deviation of focal lengths, as a share; None: 2 % of one that is told, more of EXIF."""
    arms_m: tuple[float, float, float] | None = None
    """Height of the tilt axis above the pan stage's origin, then how far the camera is in front of the tilt
    axis and left of the pan axis; None: not known."""
    arms_sigma_m: float | None = None
    """Standard deviation of each; None: 1 cm of arms that are told, else 5 cm."""
