"""Score tests of the rig: what freeing its held numbers would lower the cost by, without a solve of its own.

At the optimum with the rig held, the gradient g of the cost by the rig's numbers and their information L (all
else marginalised) are computed. Freeing entry j lowers the cost by about g_j^2 / (2 L_jj): Rao's score test.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.data import FIXED, FOCAL, Freedom, Quantity, Sharing
from pancam_graph.graph import HardTemplate
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._reduced import ReducedSystem

__all__ = ["HeldEntry", "held_entries"]

_FREED: dict[Quantity, Freedom] = {
    "calibration": Freedom(scope="eye", free=(FOCAL, "cx_px", "cy_px")),
    "mounts": Freedom(scope="eye"),
    "pan_T_tilt": Freedom(scope="all"),
}


_ENOUGH = 3000
"""Observations from which gains are estimated where a problem has more: those of every n-th landmark."""


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


def held_entries(problem: Problem) -> list[HeldEntry]:
    """Every number of the rig that is held at a problem's optimum; none for models but the rigid mast.

    None either where the images do not determine the system with these numbers free. Of a large problem a
    part of the landmarks serves, and gains are raised to the whole.
    """
    template = problem.template
    if not isinstance(template, HardTemplate):
        return []
    sharing = template.rig_variables.sharing
    freed = [q for q in _FREED if getattr(sharing, q) == FIXED]
    if not freed:
        return []
    wide = replace(sharing, **{q: _FREED[q] for q in freed})
    part = _part(problem)
    share = part.kept.sum() / max(problem.kept.sum(), 1)
    try:
        entries = list(_scores(part.on(HardTemplate(template.traverse, wide)), wide, freed))
    except SolveError:
        return []
    return [replace(e, gain=float(e.gain / share)) for e in entries]


def _part(problem: Problem) -> Problem:
    """The problem with about `_ENOUGH` of its observations."""
    m = problem.measurements
    every = max(int(problem.kept.sum()) // _ENOUGH, 1)
    return replace(problem, accepted=problem.accepted & (m.landmark % every == 0))


def _scores(problem: Problem, sharing: Sharing, freed: list[Quantity]) -> Iterator[HeldEntry]:
    template = problem.template
    link, rig = template.linkage, template.rig_variables
    root = ReducedSystem.of(problem).root
    group = len(template.traverse.stops)
    covariance = root.covariance().block(group, group)
    begin = int(link.group_column[group])
    information = np.linalg.inv(covariance)
    pull = information @ root.step()[begin : begin + len(covariance)]
    for v in rig.variables:
        if v.quantity not in freed:
            continue
        columns = link.columns_of(v.key)
        for entry, column in zip(v.entries, range(columns.start, columns.stop), strict=True):
            yield HeldEntry(
                quantity=v.quantity,
                scope=getattr(sharing, v.quantity).scope,
                entry=entry,
                camera=None if v.eye is None else template.traverse.rig.eyes[v.eye].name,
                change=float(pull[column] / information[column, column]),
                gain=float(0.5 * pull[column] ** 2 / information[column, column]),
            )
