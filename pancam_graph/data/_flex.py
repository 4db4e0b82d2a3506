"""How far the heads of frames were found to stand off the rigid mast."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.data._sharing import ENTRIES
from pancam_graph.data._solution import Solution

__all__ = ["Flex", "flex_of"]


@dataclass(frozen=True, kw_only=True)
class Flex:
    """One entry of the flex of all frames; radians or metres as its name says."""

    entry: str
    sigma: float
    """As it was told."""
    rms: float
    """Root mean square over the frames that may flex."""
    largest: float
    """The value that is largest in size."""
    frame: str
    """Id of the frame that has it."""


def flex_of(solution: Solution) -> tuple[Flex, ...]:
    """The flex of a solution's frames by entry; nothing where heads were taken to sit firmly."""
    rig, sharing, frames = solution.final.rig, solution.sharing, solution.traverse.frames
    free = [row for row, frame in enumerate(frames) if frame.sigma_pan_rad or frame.sigma_tilt_rad]
    if rig is None or rig.flex is None or sharing is None or not free:
        return ()
    out = []
    for entry in sharing.flex.entries("flex"):
        found = rig.flex[free, ENTRIES["flex"].index(entry)]
        worst = int(np.argmax(np.abs(found)))
        out.append(
            Flex(
                entry=entry,
                sigma=sharing.flex.sigma_of(entry),
                rms=float(np.sqrt(np.mean(found**2))),
                largest=float(found[worst]),
                frame=frames[free[worst]].id,
            )
        )
    return tuple(out)
