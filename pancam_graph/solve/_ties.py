"""Constraints on terrain points as further measurements of their landmarks, by sensors behind the images."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import Traverse
from pancam_graph.graph import Sight, sights_of
from pancam_graph.landmarks import Measurements

__all__ = ["Ties", "ties_of"]

_T = TypeVar("_T", bound=np.generic)


@dataclass(frozen=True, kw_only=True, eq=False)
class Ties:
    """Measurements by sensors: m rows, one a sensor."""

    constraint: IntArray
    """(m,) row of the traverse's constraint that each is of; -1: it holds a point to its variable"""
    landmark: IntArray
    """(m,) landmark row"""
    uv: FloatArray
    """(m, 2) what each sensor is known to see"""
    whitening: FloatArray
    """(m, 2, 2)"""
    first_image: int
    """Number of images, behind which the sensors are."""

    @property
    def of_constraint(self) -> BoolArray:
        """(m,) whether each is of a constraint."""
        return np.asarray(self.constraint >= 0)

    def rows(self, which: BoolArray, landmark: IntArray) -> Measurements:
        """Some of them alone, whose landmarks have these numbers (landmarks,); in their own order.

        Their row is -1: they are no observations.
        """
        of = landmark[self.landmark[which]]
        return Measurements(
            row=np.full(len(of), -1),
            image=self.first_image + np.flatnonzero(which),
            landmark=of,
            uv_px=self.uv[which],
            whitening=self.whitening[which],
        )

    def behind(self, m: Measurements, which: BoolArray, landmark: IntArray) -> tuple[Measurements, IntArray]:
        """Measurements with some of these behind those of the same landmark, and the places of the first.

        `landmark` (landmarks,) are numbers of landmarks in `m`.
        """
        mine = self.rows(which, landmark)
        order = np.argsort(mine.landmark, kind="stable")
        at = m.begin[mine.landmark[order] + 1]

        def joined(a: NDArray[_T], b: NDArray[_T]) -> NDArray[_T]:
            return np.insert(a, at, b[order], axis=0)

        place = np.ones(len(m.row) + len(order), dtype=bool)
        place[at + np.arange(len(order))] = False
        return (
            Measurements(
                row=joined(m.row, mine.row),
                image=joined(m.image, mine.image),
                landmark=joined(m.landmark, mine.landmark),
                uv_px=joined(m.uv_px, mine.uv_px),
                whitening=joined(m.whitening, mine.whitening),
            ),
            np.flatnonzero(place),
        )


def ties_of(traverse: Traverse, landmark_track: IntArray) -> tuple[Sequence[Sight], Ties] | None:
    """The constraints on landmarks of these tracks (landmarks,), ascending; None where there are none.

    Constraints on other points are left out.
    """
    sights = [sight for sight in sights_of(traverse) if sight.track in landmark_track]
    if not sights:
        return None
    return sights, Ties(
        constraint=np.array([s.constraint for s in sights], dtype=np.int64),
        landmark=np.searchsorted(landmark_track, [s.track for s in sights]).astype(np.int64),
        uv=np.array([s.uv for s in sights]),
        whitening=np.array([s.whitening for s in sights]),
        first_image=len(traverse.images),
    )
