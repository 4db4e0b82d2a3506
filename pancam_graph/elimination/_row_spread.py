"""Covariance of rows of a landmark's residuals, from that of the landmark and of the cameras."""

from collections.abc import Iterable

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination._panels import Covariance
from pancam_graph.elimination._system import LandmarkSystem

__all__ = ["row_spread"]


def row_spread(
    system: LandmarkSystem,
    landmark: int,
    by_landmark: FloatArray,
    by_variable: Iterable[tuple[int, FloatArray]],
    covariance: Covariance,
) -> FloatArray:
    """Covariance (k, k) of B l + F x at the last linearisation: l is a landmark, x are the variables.

    `landmark` is its row in the order given, `by_landmark` (k, 3) is B, by the tangents of the landmark;
    `by_variable` has F (k, dim) by key. With V = L L' and the arms W = L^-1 E' the covariance of l is
    L^-T (I + W C W') L^-1, and that of l and x is -L^-T W C. How errors of smooth fields hang together with
    F x is left out.
    """
    block, W, L, of_fields = system.eliminated(landmark, covariance)
    link = system.linkage
    F = np.zeros((len(by_landmark), len(block.row)))
    for key, moves in by_variable:
        i = block.groups.index(int(link.group[link.row[key]]))
        columns, rows = link.columns_of(key), slice(int(block.begin[i]), int(block.begin[i + 1]))
        place = block.row[rows]
        own = np.flatnonzero((place >= columns.start) & (place < columns.stop))
        F[:, rows.start + own] += moves[:, place[own] - columns.start]
    B = np.linalg.solve(L, by_landmark.T).T
    reach = F - B @ W
    return np.asarray(B @ (np.eye(3) + of_fields) @ B.T + reach @ block.joint(covariance) @ reach.T)
