"""Covariance of rows of a landmark's residuals, from that of the landmark and of the cameras."""

from collections.abc import Iterable

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination._panels import Covariance
from pancam_graph.elimination._stretched_system import StretchedSystem
from pancam_graph.elimination._system import LandmarkSystem

__all__ = ["RowSpread"]


class RowSpread:
    """Covariances of residuals of landmarks of one system; what they share is computed once."""

    def __init__(self, system: LandmarkSystem | StretchedSystem, covariance: Covariance) -> None:
        """A system at its last linearisation, and the covariance of its variables."""
        self._system, self._covariance = system, covariance
        self._joint: dict[tuple[int, ...], FloatArray] = {}

    def of(
        self, landmark: int, by_landmark: FloatArray, by_variable: Iterable[tuple[int, FloatArray]]
    ) -> FloatArray:
        """Covariance (k, k) of B l + F x: l is a landmark, x are the variables.

        `landmark` is its row in the order given, `by_landmark` (k, 3) is B, by the tangents of the landmark;
        `by_variable` has F (k, dim) by key. With V = L L' and the arms W = L^-1 E' the covariance of l is
        L^-T (I + W C W') L^-1, and that of l and x is -L^-T W C. How errors of smooth fields hang together
        with F x is left out.
        """
        block, W, L, of_fields = self._system.eliminated(landmark, self._covariance)
        link = self._system.linkage
        F = np.zeros((len(by_landmark), len(block.row)))
        for key, moves in by_variable:
            i = block.groups.index(int(link.group[link.row[key]]))
            columns, rows = link.columns_of(key), slice(int(block.begin[i]), int(block.begin[i + 1]))
            place = block.row[rows]
            own = np.flatnonzero((place >= columns.start) & (place < columns.stop))
            F[:, rows.start + own] += moves[:, place[own] - columns.start]
        if block.groups not in self._joint:
            self._joint[block.groups] = block.joint(self._covariance)
        B = np.linalg.solve(L, by_landmark.T).T
        reach = F - B @ W
        moved = np.flatnonzero(reach.any(axis=0))  # few: those of the stops that see the landmark
        reach, joint = reach[:, moved], self._joint[block.groups][np.ix_(moved, moved)]
        return np.asarray(B @ (np.eye(3) + of_fields) @ B.T + reach @ joint @ reach.T)
