"""The focal length of a camera, as told or by EXIF, and how well it is known."""

import math
from dataclasses import dataclass

from pancam_graph.base.errors import InputError
from pancam_graph.io.plain._find_pictures import PlainPicture
from pancam_graph.io.plain._options import PlainOptions

__all__ = ["Focal", "focal_of"]

_TOLD_SIGMA = 0.02
_SENSOR_SIGMA = 0.03
"""Focal lengths of lenses are engraved to some percent, and change with focus."""
_FILM_SIGMA = 0.04
"""Equivalents by the diagonal and by the width of a picture of 4 : 3 differ by as much."""
_FILM_ROUNDING_MM = 0.3
"""Standard deviation of what is rounded to millimetres."""
_GUESS_SIGMA = 0.5
"""Of a focal length as long as the longer side of a picture."""
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
_NARROWEST, _WIDEST = 100.0, 0.1
"""Focal lengths, over the longer side of a picture, of which EXIF is believed."""
_SAME_SHAPE = 0.01
"""Difference of the ratio of sides, as a share, up to which a picture was resized and not cropped."""


@dataclass(frozen=True, kw_only=True)
class Focal:
    """A focal length."""

    focal_px: float
    sigma: float
    """Standard deviation, as a share."""
    source: str
    """Where it comes from, as the end of a sentence."""


def focal_of(picture: PlainPicture, options: PlainOptions, *, guessed: bool) -> Focal:
    """The focal length of the camera that took a picture.

    Where neither options nor EXIF tell it, a guess if `guessed`; else raises InputError, which names the
    options that tell it.
    """
    if options.focal_px is not None:
        return _checked(options.focal_px, options.focal_sigma or _TOLD_SIGMA, "--focal-px", picture)
    if options.field_rad is not None:
        if not 0 < options.field_rad < math.pi:
            raise InputError(
                "--field-deg: expected a field of view between 0 and 180 degrees, found "
                f"{math.degrees(options.field_rad):g}"
            )
        focal_px = 0.5 * picture.width_px / math.tan(options.field_rad / 2)
        return _checked(focal_px, options.focal_sigma or _TOLD_SIGMA, "--field-deg", picture)
    found = _by_exif(picture)
    if isinstance(found, str) and guessed:
        return Focal(
            focal_px=float(max(picture.size_px)), sigma=_GUESS_SIGMA, source=f"a guess, as EXIF tells {found}"
        )
    if isinstance(found, str):
        raise InputError(
            f"{picture.path}: expected EXIF that tells the focal length, found {found}; --focal-px or "
            "--field-deg tells it, or --rig a rig"
        )
    if options.focal_sigma:
        return Focal(focal_px=found.focal_px, sigma=options.focal_sigma, source=found.source)
    return found


def _checked(focal_px: float, sigma: float, option: str, picture: PlainPicture) -> Focal:
    if not _believed(focal_px, picture):
        raise InputError(
            f"{option}: expected a focal length of {_WIDEST:g} to {_NARROWEST:g} times the longer side of "
            f"{picture.path} ({max(picture.size_px)} px), found {focal_px:g} px"
        )
    return Focal(focal_px=focal_px, sigma=sigma, source=f"as told by {option}")


def _believed(focal_px: float, picture: PlainPicture) -> bool:
    return _WIDEST <= focal_px / max(picture.size_px) <= _NARROWEST


def _by_exif(picture: PlainPicture) -> Focal | str:
    """The focal length by EXIF, or what was found instead: by the sensor's pixels, else by the equivalent."""
    exif = picture.exif
    if exif.focal_mm is None and exif.focal_35mm is None:
        return "none"
    scale = 1.0
    if exif.size_px is not None:
        scale = picture.width_px / exif.size_px[0]
        if abs(picture.height_px / exif.size_px[1] / scale - 1) > _SAME_SHAPE:
            return (
                f"that of a picture of {exif.size_px[0]} x {exif.size_px[1]} px, which was cropped to "
                f"{picture.width_px} x {picture.height_px}"
            )
    if exif.focal_mm is not None and exif.pixels_per_mm is not None and exif.size_px is not None:
        focal_px = exif.focal_mm * exif.pixels_per_mm * scale
        if _believed(focal_px, picture):
            return Focal(
                focal_px=focal_px,
                sigma=_SENSOR_SIGMA,
                source=f"by EXIF: {exif.focal_mm:g} mm, {exif.pixels_per_mm:.4g} pixels per mm",
            )
    if exif.focal_35mm is not None:
        focal_px = exif.focal_35mm / _FILM_DIAGONAL_MM * math.hypot(*picture.size_px)
        if _believed(focal_px, picture):
            sigma = math.hypot(_FILM_SIGMA, _FILM_ROUNDING_MM / exif.focal_35mm)
            return Focal(
                focal_px=focal_px,
                sigma=sigma,
                source=f"by EXIF: {exif.focal_35mm:g} mm on 35-mm film, by the diagonal",
            )
        return f"{exif.focal_35mm:g} mm on 35-mm film"
    if exif.pixels_per_mm is None or exif.size_px is None:
        return f"{exif.focal_mm:g} mm on a sensor of unknown size"
    return f"{exif.focal_mm:g} mm with {exif.pixels_per_mm:.4g} pixels per mm"
