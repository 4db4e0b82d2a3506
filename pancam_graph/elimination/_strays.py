"""Strays: landmarks that a step left behind a camera or with a large cost, and that are placed anew."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks import (
    CameraViews,
    Loss,
    Measurements,
    kernel,
    over_landmarks,
    rays_of,
    refine,
    triangulate,
)

__all__ = ["Strays", "is_halfway"]

_STRAY = 1.0
"""Cost per observation beyond which a landmark is a stray and is refined: at least twice the cost by
noise."""
_LOST = 0.5 * 5.0**2
"""Cost per observation after refinement, as of residuals of 5 sigma, beyond which a stray is triangulated."""
_TOUCHED = 1e-2
"""Relative change of its cost by a step below which a landmark is no stray."""
_HALFWAY = (1e-3, 0.1)
"""Relative decreases of the cost by a step between which all landmarks are refined after it. After a longer
step only strays are; after a shorter one, back substitution places landmarks well. Between, it leaves enough
of second order to need one more step of the cameras."""
_REFINED = 0.1
"""Refinement of a stray ends when its expected decrease is at most this share of its cost."""
_CREEPING = 1e-4
"""Both shares with a robust loss: its weights let a landmark with an outlier go on by small steps, of which
each would need a step of the cameras."""
_GRAIN = 256
"""Strays that one thread takes at once."""


def is_halfway(before: float, after: float) -> bool:
    """Whether a step between these costs of all landmarks is one after which all are refined."""
    least, most = _HALFWAY
    return least * before < before - after < most * before


@dataclass(frozen=True, kw_only=True, eq=False)
class Strays:
    """Landmarks in the order of elimination, and what it takes to place them anew."""

    measurements: Measurements
    """In the order in which landmarks were given."""
    landmark_row: IntArray
    """(landmarks,) row among those given"""
    origin_m: FloatArray
    """(landmarks, 3)"""
    begin: IntArray
    """(landmarks + 1,) first observation of each, and n"""
    loss: Loss

    def replace(
        self,
        views: CameraViews,
        sights: kernel.Sights,
        bearings: kernel.Bearings,
        before: FloatArray,
        vector: FloatArray,
        cost: FloatArray,
        *,
        all_of_them: bool,
    ) -> float:
        """Place strays anew, in `vector` (landmarks, 4) and `cost` (landmarks,); by how much costs fell.

        A stray is refined from its place after the step; if its cost remains large, it is triangulated from
        its rays. `before` (landmarks,) are costs before the step; `all_of_them`: all landmarks are refined.
        """
        seen = kernel.Seen(
            begin=self.begin,
            image=sights.image,
            uv_px=sights.uv_px,
            whitening=sights.whitening,
            cameras=bearings.cameras,
        )
        counts = np.diff(self.begin)
        # A landmark whose cost hardly changes is placed as well as before, however large its cost.
        share, settled = (_TOUCHED, _REFINED) if self.loss.kind == kernel.NONE else (_CREEPING, _CREEPING)
        touched = np.abs(cost - before) > share * before
        is_stray = (cost > _LOST * counts) | touched & (cost > _STRAY * counts)
        strays = np.flatnonzero(is_stray | all_of_them)
        if len(strays) == 0:
            return 0.0

        def take_if_better(which: IntArray, found: FloatArray) -> float:
            new, loss = np.empty(len(which)), self.loss
            kernel.landmark_costs(sights, bearings, which, found, self.origin_m, loss.kind, loss.width, new)
            better = new < cost[which]
            gained = float(np.sum((cost[which] - new)[better]))
            vector[which[better]], cost[which[better]] = found[better], new[better]
            return gained

        weight, loss, refined = np.ones(len(seen.image)), self.loss, vector.copy()
        given = self.origin_m, weight, loss.kind, loss.width, True, settled
        over_landmarks(kernel.refine, strays, seen, *given, refined, grain=_GRAIN)
        regained = take_if_better(strays, refined[strays])

        strays = strays[cost[strays] > _LOST * counts[strays]]
        if len(strays) == 0:
            return regained
        m, lost = self.measurements, np.zeros(len(counts), dtype=bool)
        lost[self.landmark_row[strays]] = True
        part, rows = m.part(np.flatnonzero(lost[m.landmark])), np.cumsum(lost)[self.landmark_row[strays]] - 1
        weight = weight[: len(part.image)]
        of_image = (part.row >= 0).astype(float)  # sensors have no rays
        placed = triangulate(*rays_of(part, views), part.landmark, of_image)
        origin_m = np.empty_like(self.origin_m)
        origin_m[self.landmark_row] = self.origin_m
        placed = refine(placed.about(origin_m[lost]), part, views, weight, loss, beyond_infinity=True)
        return regained + take_if_better(strays, placed.vector[rows])
