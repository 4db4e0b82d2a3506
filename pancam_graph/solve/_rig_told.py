"""What images tell of the numbers of a rig: their information and gradient, all else marginalised.

One system has all numbers of the rig free that any test asks about. It serves them all: what concerns some
numbers with the others held are their rows and columns of the information.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import FIXED, Freedom, Quantity, Sharing, sharing_within
from pancam_graph.graph import HardTemplate, LetGo, RigVariables
from pancam_graph.rigs import FOCAL
from pancam_graph.solve._problem import Problem, system_of
from pancam_graph.solve._reduced import ReducedSystem

__all__ = ["RigTold", "part_of", "reduced_to_rig", "rig_told"]

_TESTED: dict[Quantity, Freedom] = {
    "calibration": Freedom(scope="eye", free=(FOCAL, "cx_px", "cy_px")),
    "mounts": Freedom(scope="eye"),
    "pan_T_tilt": Freedom(scope="all"),
}
"""Numbers that the score test frees, unless any number of their quantity is free."""
_QUANTITIES: tuple[Quantity, ...] = (*_TESTED, "encoders")
_ENOUGH = 3000
"""Observations from which gains are estimated where a problem has more: those of every n-th landmark ..."""
_STOPS = 3
"""... at the fewest successive stops that have so many, of this many at least."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RigTold:
    """What a problem, or a part of it, tells of the numbers of its rig."""

    rig: RigVariables
    """Of the part: numbers of the problem's rig that are free or were held, all about their values."""
    freed: Sharing
    """Numbers that the problem holds and the score test frees."""
    stated: Sharing
    """Numbers of a rig that is held and states an uncertainty, free with it; none where any is free."""
    information: FloatArray
    """(n, n) of the columns of the rig with default priors of what was held, all else marginalised."""
    gradient: FloatArray
    """(n,) of the cost by these columns, all else marginalised."""
    column: dict[tuple[Quantity, int | None, str], int]
    """The column of an entry, by its quantity and eye."""
    share: float
    """Share of the problem's observations in the part."""

    def without_priors(self, columns: IntArray) -> FloatArray:
        """Information (k, k) of some columns, without the priors of what was held, the others held."""
        usual = np.zeros(len(self.gradient))
        for v in self.rig.of_stop(None):
            for entry, sigma in zip(v.entries, v.sigma, strict=True):
                usual[self.column[v.quantity, v.eye, entry]] = sigma
        return np.asarray(self.information[np.ix_(columns, columns)] - np.diag(usual[columns] ** -2.0))


def _stated_sharing(problem: Problem) -> Sharing:
    """Numbers of a rig that is held and states an uncertainty, free with it; none where any is free.

    None of models but the rigid mast either. A head's flex is one with its pan and tilt, and no number.
    """
    template = problem.template
    if not isinstance(template, HardTemplate) or template.rig_variables.sharing.any_free:
        return Sharing()
    return replace(sharing_within(template.traverse.rig.uncertainty, "mast"), flex=FIXED)


def rig_told(problem: Problem) -> RigTold | None:
    """What images tell of the rig of a problem at its optimum; None for models but the rigid mast.

    None also where no number of the rig is held. Of a large problem a part serves: the rig is the same at all
    stops. Raises SolveError where images do not determine the system with all these numbers free.
    """
    template = problem.template
    if not isinstance(template, HardTemplate):
        return None
    own, stated = template.rig_variables.sharing, _stated_sharing(problem)
    freed: dict[str, Any] = {q: f for q, f in _TESTED.items() if getattr(own, q) == FIXED}
    wide: dict[str, Any] = {}
    for quantity in _QUANTITIES:
        some = [f for f in (freed.get(quantity, FIXED), getattr(stated, quantity)) if f != FIXED]
        if some:
            free = {entry for freedom in some for entry in freedom.entries(quantity)}
            wide[quantity] = Freedom(scope=some[0].scope, free=tuple(free))
    if not wide:
        return None
    # Priors of what was held are the default ones, each by itself: `without_priors` takes them off again.
    covariance = own.covariance if own.any_free else None
    part = part_of(problem, replace(own, covariance=covariance, **wide))
    rig, link = part.template.rig_variables, part.template.linkage
    information, gradient = reduced_to_rig(part).root.last_information()
    column = {
        (v.quantity, v.eye, entry): link.columns_of(v.key).start + i
        for v in rig.of_stop(None)
        for i, entry in enumerate(v.entries)
    }
    return RigTold(
        rig=rig,
        freed=Sharing(**freed),
        stated=stated,
        information=information,
        gradient=gradient,
        column=column,
        share=float(part.kept.sum() / max(problem.kept.sum(), 1)),
    )


def reduced_to_rig(problem: Problem) -> ReducedSystem:
    """The reduced system of a problem whose rig is free, with what all stops share eliminated last."""
    return ReducedSystem.of(problem, system_of(problem, last=len(problem.template.traverse.stops)))


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
        constraints=(),
        points=None,
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
            constraints=let_go.constraints[:0],
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
