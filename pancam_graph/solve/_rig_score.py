"""Score tests of the rig: what freeing its held numbers would lower the cost by, without a solve of its own.

At the optimum with the rig held, the gradient g of the cost by the rig's numbers and their information L (all
else marginalised) are computed. Freeing entry j lowers the cost by about g_j^2 / (2 L_jj): Rao's score test.
"""

from dataclasses import dataclass

import numpy as np

from pancam_graph.data import FIXED, Quantity
from pancam_graph.solve._rig_told import RigTold

__all__ = ["HeldEntry", "held_entries"]


@dataclass(frozen=True, kw_only=True)
class HeldEntry:
    """A number of the rig that was held, and what the solution says of it."""

    quantity: Quantity
    scope: str
    entry: str
    camera: str | None
    """Name of its eye; None if it belongs to all."""
    change: float
    """Change that would lower the cost most, all else free to follow; in the entry's unit."""
    gain: float
    """Decrease of the cost by that change."""

    @property
    def sigmas(self) -> float:
        """The gain as the size of a standard normal number."""
        return float(np.sqrt(2 * max(self.gain, 0.0)))


def held_entries(told: RigTold) -> list[HeldEntry]:
    """The numbers of the rig that are held at a problem's optimum, of which images tell so much.

    Gains by part of a problem are raised to the whole.
    """
    eyes, out = told.rig.traverse.rig.eyes, list[HeldEntry]()
    for (quantity, eye, entry), column in told.column.items():
        freedom = getattr(told.freed, quantity)
        if freedom == FIXED or entry not in freedom.entries(quantity):
            continue
        pull, information = told.gradient[column], told.information[column, column]
        out.append(
            HeldEntry(
                quantity=quantity,
                scope=freedom.scope,
                entry=entry,
                camera=None if eye is None else eyes[eye].name,
                change=float(-pull / information),
                gain=float(0.5 * pull**2 / information / told.share),
            )
        )
    return out
