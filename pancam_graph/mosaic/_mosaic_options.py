"""Options of mosaics."""

from dataclasses import dataclass

from pancam_graph.base.errors import InputError

__all__ = ["MosaicOptions"]


@dataclass(frozen=True, kw_only=True)
class MosaicOptions:
    """How large mosaics are. The defaults show all the detail of the images.

    Raises InputError for a number that is not above 0, and for a mosaic of more than 32 million pixels.
    """

    px_per_degree: float | None = None
    """Scale of cylindrical mosaics; None: that of the images at their centre, if `max_width_px` allows."""
    max_width_px: int = 8192
    """Widest cylindrical mosaic; a wider one is made smaller."""
    ground_radius_m: float = 10.0
    """Half side of the square of ground that the mosaic from above shows."""
    ground_m_per_px: float = 0.01
    """Scale of the mosaic from above."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("px_per_degree", "max_width_px", "ground_radius_m", "ground_m_per_px"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"MosaicOptions: {name}: expected a number above 0, found {value}")
        side = 2 * self.ground_radius_m / self.ground_m_per_px
        if side**2 > 32e6 or self.max_width_px**2 / 2 > 64e6:
            raise InputError(
                "MosaicOptions: expected max_width_px of 11,000 or less and a square of ground of 5,600 "
                f"pixels or less, found {self.max_width_px} and {side:.0f} pixels"
            )
