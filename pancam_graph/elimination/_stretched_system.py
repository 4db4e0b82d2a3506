"""Landmarks of a long drive, stretch by stretch: those of one stretch at a time are in memory."""

import logging
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.elimination._blocks import Block, blocks_of
from pancam_graph.elimination._dissection import Dissection
from pancam_graph.elimination._linkage import Linkage, Posture
from pancam_graph.elimination._panels import Covariance, Panels, pattern
from pancam_graph.elimination._strays import is_halfway
from pancam_graph.elimination._system import LandmarkSystem, Room
from pancam_graph.landmarks import SQUARED, Landmarks, Loss, Measurements

__all__ = ["StretchedSystem"]

_LOG = logging.getLogger(__name__)
_T = TypeVar("_T", bound=np.generic)


class StretchedSystem:
    """The same as a LandmarkSystem of all landmarks, of the landmarks of stretches, which are on disk.

    Its square root has the same rows as one in memory, but for the order of elimination and rounding.
    """

    def __init__(
        self,
        linkage: Linkage,
        measurements: Measurements,
        landmarks: Landmarks,
        loss: Loss = SQUARED,
        *,
        stretches: int,
        n_stops: int,
        cliques: Iterable[Iterable[int]] = (),
        last: int | None = None,
        refined: bool = False,
    ) -> None:
        """As a LandmarkSystem; `stretches` is their number, and groups from `n_stops` on are shared by all.

        Raises InputError where the disk has no room.
        """
        self.linkage, self.loss = linkage, loss
        cliques = [tuple(clique) for clique in cliques]
        cut = Dissection.of(linkage, measurements, cliques, n=stretches, n_stops=n_stops)
        self._n_landmarks = len(landmarks.vector)
        self._rows = [rows for s in range(cut.n) if len(rows := np.flatnonzero(cut.landmark == s))]
        of_landmark = np.diff(measurements.begin)

        def part(rows: IntArray) -> Measurements:
            of = np.zeros(self._n_landmarks, dtype=bool)
            of[rows] = True
            return measurements.part(np.flatnonzero(np.repeat(of, of_landmark)))

        reach = [groups for rows in self._rows for groups in blocks_of(linkage, part(rows))[1].values()]
        self.structure = pattern(linkage.group_dim, [*reach, *cliques], last=last, stage=cut.stage)
        room = Room()
        self._parts: list[LandmarkSystem] = []
        for rows in self._rows:
            system = LandmarkSystem(
                linkage,
                part(rows),
                landmarks.of(rows),
                loss,
                refined=refined,
                room=room,
                structure=self.structure,
            )
            system.put_on_disk()
            system.let_go()
            self._parts.append(system)
        joints = int(np.count_nonzero((cut.stage == cut.n) & (linkage.group_dim > 0)))
        _LOG.info("%d stretches of %d stops, joined by %d", len(self._parts), n_stops, joints)

    def _visits(self) -> Iterator[LandmarkSystem]:
        """The stretches one after the other; each leaves memory before the next."""
        for part in self._parts:
            try:
                yield part
            finally:
                part.let_go()

    def _sum(self, of_part: Callable[[LandmarkSystem], float]) -> float:
        return float(sum(of_part(part) for part in self._visits()))

    def linearise(self, posture: Posture) -> Panels:
        """As of a LandmarkSystem."""
        panels = Panels(self.structure, on_disk=True)
        for part in self._visits():
            part.linearise(posture, panels)
            panels.let_go()
        return panels

    def try_step(self, posture: Posture, step: FloatArray) -> FloatArray:
        """As of a LandmarkSystem, with the costs of stretches (stretches,) in place of those of blocks."""
        for part in self._visits():
            part.follow(posture, step)
        halfway = is_halfway(self.linearised_cost, self.moved_cost)
        for part in self._visits():
            part.replace_strays(posture, halfway=halfway)
        return np.array([part.moved_cost for part in self._visits()])

    def adopt(self) -> None:
        """As of a LandmarkSystem."""
        for part in self._parts:
            part.adopt()

    def rest(self) -> None:
        """As of a LandmarkSystem."""
        for part in self._parts:
            part.rest()

    @property
    def any_behind(self) -> bool:
        """As of a LandmarkSystem."""
        return any(part.any_behind for part in self._visits())

    @property
    def moved_cost(self) -> float:
        """As of a LandmarkSystem."""
        return self._sum(lambda part: part.moved_cost)

    @property
    def linearised_cost(self) -> float:
        """As of a LandmarkSystem."""
        return self._sum(lambda part: part.linearised_cost)

    @property
    def gain_alone(self) -> float:
        """As of a LandmarkSystem."""
        return self._sum(lambda part: part.gain_alone)

    @property
    def regained(self) -> float:
        """As of a LandmarkSystem."""
        return self._sum(lambda part: part.regained)

    def landmarks(self) -> Landmarks:
        """As of a LandmarkSystem."""
        parts = [part.landmarks() for part in self._visits()]
        return Landmarks(
            vector=self._of_all([part.vector for part in parts]),
            origin_m=self._of_all([part.origin_m for part in parts]),
        )

    @property
    def undetermined(self) -> BoolArray:
        """As of a LandmarkSystem."""
        return self._of_all([part.undetermined for part in self._visits()])

    def landmark_covariance_m2(
        self, covariance: Covariance | None, *, only: BoolArray | None = None
    ) -> FloatArray:
        """As of a LandmarkSystem."""
        return self._of_all(
            [
                part.landmark_covariance_m2(covariance, only=None if only is None else only[rows])
                for part, rows in zip(self._visits(), self._rows, strict=True)
            ]
        )

    def eliminated(
        self, landmark: int, covariance: Covariance
    ) -> tuple[Block, FloatArray, FloatArray, FloatArray]:
        """As of a LandmarkSystem."""
        for part, rows in zip(self._parts, self._rows, strict=True):
            place = int(np.searchsorted(rows, landmark))
            if place < len(rows) and rows[place] == landmark:
                return part.eliminated(place, covariance)
        raise IndexError(f"landmark {landmark} of {self._n_landmarks}")

    def _of_all(self, parts: list[NDArray[_T]]) -> NDArray[_T]:
        """Rows of the landmarks of all stretches, in the order in which landmarks were given."""
        out = np.empty((self._n_landmarks, *parts[0].shape[1:]), dtype=parts[0].dtype)
        for rows, part in zip(self._rows, parts, strict=True):
            out[rows] = part
        return out
