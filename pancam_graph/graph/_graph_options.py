"""Options of a graph: the model of cameras, and the flex of the mast."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pancam_graph.base.errors import InputError

__all__ = ["DEFAULT_FLEX", "RIGID", "Flex", "Model", "Tie"]

Tie = Literal["hard", "soft"]
"""Tie of camera poses to the mast: "hard" computes them from it, "soft" makes them variables near it."""

Model = Literal["mast", "circle", "free", "projective"]
"""Model of the camera poses: `mast` on the pan-tilt chain; `circle` with centres on the mast's circles and
free rotations (thesis eq. 4.6 to 4.9); `free` each independent but for a loose tie to telemetry; `projective`
the same for the 12 entries of each camera's projection matrix (thesis eq. 4.2 to 4.4)."""


@dataclass(frozen=True, kw_only=True)
class Flex:
    """Flex of the mast: sigma of a camera pose relative to the pose that the mast gives."""

    rotation_rad: float
    """Sigma of each component of the rotation vector."""
    translation_m: float
    """Sigma of each component of the translation."""
    calibration: float = 0.05
    """Sigma of the five entries of K relative to the rig's, in focal lengths; for the model `projective`
    alone."""

    def __post_init__(self) -> None:
        """Check that all are above 0."""
        for name in ("rotation_rad", "translation_m", "calibration"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"flex: {name}: expected a number above 0, found {value}")


RIGID = Flex(rotation_rad=1e-8, translation_m=1e-7)
"""Far below the resolution of images: the cost at the optimum is that of a rigid mast to 1e-8."""

DEFAULT_FLEX: dict[Model, Flex] = {
    # A tenth of a pixel of a rover's Navcam, and the millimetre to which mounts are known.
    "mast": Flex(rotation_rad=5e-5, translation_m=1e-3),
    # Centres on the circle to a tenth of a millimetre; rotations held no better than 20 mrad by telemetry.
    "circle": Flex(rotation_rad=0.02, translation_m=1e-4),
    # Loose compared with images, tight enough to determine cameras that no image joins.
    "free": Flex(rotation_rad=0.02, translation_m=0.02),
    # The same, and calibrations as far off as a lens of another make: 5 %, where real ones repeat to 0.3 %.
    "projective": Flex(rotation_rad=0.02, translation_m=0.02, calibration=0.05),
}
