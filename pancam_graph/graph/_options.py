"""Choices that shape a graph."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pancam_graph.errors import InputError

__all__ = ["DEFAULT_TIES", "Model", "Tie"]

Model = Literal["mast", "circle", "free"]
"""How camera poses hang together: `mast` on the pan-tilt chain, `circle` with their centres on the mast's
circles and their rotations free (thesis 4.6 to 4.9), `free` each on its own but for a loose telemetry tie."""


@dataclass(frozen=True, kw_only=True)
class Tie:
    """How firmly a camera pose is tied to where the mast puts it: the flex of the mast, one sigma."""

    rotation_rad: float
    translation_m: float

    def __post_init__(self) -> None:
        """Check that both are above 0."""
        for name in ("rotation_rad", "translation_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"tie: {name}: expected a number above 0, found {value}")


DEFAULT_TIES: dict[Model, Tie] = {
    # Rigid: a hundredth of what the images of a panorama can tell, so the optimum is that of a rigid mast.
    "mast": Tie(rotation_rad=1e-7, translation_m=1e-6),
    # Centres on the circle to a tenth of a millimetre; rotations held no better than 20 mrad by telemetry.
    "circle": Tie(rotation_rad=0.02, translation_m=1e-4),
    # Loose enough to say nothing that images say, tight enough to join what no image joins.
    "free": Tie(rotation_rad=0.02, translation_m=0.02),
}
