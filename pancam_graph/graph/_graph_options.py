"""Choices that shape a graph."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pancam_graph.base.errors import InputError

__all__ = ["DEFAULT_FLEX", "RIGID", "Flex", "Model", "Tie"]

Tie = Literal["hard", "soft"]
"""Whether camera poses are computed from the mast, or are variables that a sigma holds near it."""

Model = Literal["mast", "circle", "free", "projective"]
"""How camera poses hang together: `mast` on the pan-tilt chain, `circle` with their centres on the mast's
circles and their rotations free (thesis eq. 4.6 to 4.9), `free` each on its own but for a loose telemetry
tie, `projective` the same for the 12 entries of each camera's projection matrix (thesis eq. 4.2 to 4.4)."""


@dataclass(frozen=True, kw_only=True)
class Flex:
    """How far a camera pose may be from where the mast puts it, one sigma: the flex of the mast."""

    rotation_rad: float
    translation_m: float
    calibration: float = 0.05
    """How far each of the five numbers of K may be from the rig's, in focal lengths; of model `projective`
    alone, since the others have the rig's K."""

    def __post_init__(self) -> None:
        """Check that all are above 0."""
        for name in ("rotation_rad", "translation_m", "calibration"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"flex: {name}: expected a number above 0, found {value}")


RIGID = Flex(rotation_rad=1e-8, translation_m=1e-7)
"""Far below what images can tell: the optimum is that of a rigid mast to 1e-8 of its cost."""

DEFAULT_FLEX: dict[Model, Flex] = {
    # A tenth of a pixel of a rover's Navcam, and the millimetre to which mounts are known.
    "mast": Flex(rotation_rad=5e-5, translation_m=1e-3),
    # Centres on the circle to a tenth of a millimetre; rotations held no better than 20 mrad by telemetry.
    "circle": Flex(rotation_rad=0.02, translation_m=1e-4),
    # Loose enough to say nothing that images say, tight enough to join what no image joins.
    "free": Flex(rotation_rad=0.02, translation_m=0.02),
    # The same, and calibrations as far off as a lens of another make: 5 %, where real ones repeat to 0.3 %.
    "projective": Flex(rotation_rad=0.02, translation_m=0.02, calibration=0.05),
}
