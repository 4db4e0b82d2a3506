"""Score tests of the rig: what freeing its held numbers would lower the cost by, without a solve of its own.

At the optimum with the rig held, the gradient g of the cost by the rig's numbers and their information L (all
else marginalised) are computed. Freeing entry j lowers the cost by about g_j^2 / (2 L_jj): Rao's score test.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.data import FIXED, Freedom, Quantity, Sharing
from pancam_graph.graph import HardTemplate, LetGo
from pancam_graph.rigs import FOCAL
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._reduced import ReducedSystem

__all__ = ["HeldEntry", "held_entries", "part_of"]

_FREED: dict[Quantity, Freedom] = {
    "calibration": Freedom(scope="eye", free=(FOCAL, "cx_px", "cy_px")),
    "mounts": Freedom(scope="eye"),
    "pan_T_tilt": Freedom(scope="all"),
}


_ENOUGH = 3000
"""Observations from which gains are estimated where a problem has more: those of every n-th landmark ..."""
_STOPS = 3
"""... at the fewest successive stops that have so many, of this many at least."""


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
    part serves, and gains are raised to the whole: the rig is the same at all stops.
    """
    template = problem.template
    if not isinstance(template, HardTemplate):
        return []
    sharing = template.rig_variables.sharing
    freed = [q for q in _FREED if getattr(sharing, q) == FIXED]
    if not freed:
        return []
    freedoms: dict[str, Any] = {q: _FREED[q] for q in freed}
    wide = replace(sharing, **freedoms)
    part = part_of(problem, wide)
    share = part.kept.sum() / max(problem.kept.sum(), 1)
    try:
        entries = list(_scores(part, wide, freed))
    except SolveError:
        return []
    return [replace(e, gain=float(e.gain / share)) for e in entries]


def part_of(problem: Problem, sharing: Sharing) -> Problem:
    """A problem, or of a large one about `_ENOUGH` observations of a few stops; the rig is shared as told.

    The caller's factors may join any stops: a problem that has some keeps all stops.
    """
    t, m = problem.template.traverse, problem.measurements
    first, last = _stops(problem)
    if problem.factors.given or last - first == len(t.stops):
        every = max(int(problem.kept.sum()) // _ENOUGH, 1)
        part = replace(problem, accepted=problem.accepted & (m.landmark % every == 0))
        return part.on(HardTemplate(t, sharing))
    images = np.flatnonzero((t.image_stop >= first) & (t.image_stop < last))
    frames = np.flatnonzero((t.frame_stop >= first) & (t.frame_stop < last))
    of_part = replace(
        t,
        stops=t.stops[first:last],
        frames=tuple(t.frames[i] for i in frames),
        images=tuple(t.images[i] for i in images),
        observations=None,
    )
    place = np.full(len(t.images), -1)
    place[images] = np.arange(len(images))
    seen = problem.kept & (place[m.image] >= 0)
    joins = np.bincount(m.landmark[seen], minlength=m.n_landmarks) >= 2
    every = max(int((seen & joins[m.landmark]).sum()) // _ENOUGH, 1)
    joins[np.arange(m.n_landmarks) % every > 0] = False
    measurements = m.part(np.flatnonzero(seen & joins[m.landmark]))
    let_go = problem.template.let_go
    template = HardTemplate(of_part, sharing).letting_go(
        LetGo(
            angles_rad=let_go.angles_rad[frames],
            common_rad=let_go.common_rad[first:last],
            stops=let_go.stops[first:last],
        )
    )
    state = problem.template.state(problem.values, np.zeros((0, 3)), problem.views)
    return Problem(
        template=template,
        factors=template.factors(),
        measurements=replace(measurements, image=place[measurements.image]),
        accepted=np.ones(len(measurements.row), dtype=bool),
        values=template.values(state.part(slice(first, last), frames, images)),
        landmarks=problem.landmarks.of(np.flatnonzero(joins)),
    )


def _stops(problem: Problem) -> tuple[int, int]:
    """The first of some successive stops and the one after the last: those with most observations in use."""
    t, n = problem.template.traverse, len(problem.template.traverse.stops)
    image = problem.measurements.image[problem.kept]
    counts = np.bincount(t.image_stop, np.bincount(image, minlength=len(t.images)), minlength=n)
    before = np.concatenate([[0], np.cumsum(counts)])
    for length in range(_STOPS, n):
        within = before[length:] - before[:-length]
        first = int(np.argmax(within))
        if within[first] >= _ENOUGH:
            return first, first + length
    return 0, n


def _scores(problem: Problem, sharing: Sharing, freed: list[Quantity]) -> Iterator[HeldEntry]:
    template = problem.template
    link, rig = template.linkage, template.rig_variables
    covariance, change = ReducedSystem.of(problem).root.marginal(len(template.traverse.stops))
    information = np.linalg.inv(covariance)
    pull = information @ change
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
