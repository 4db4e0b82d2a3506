"""Small holes of a surface, filled from what surrounds them."""

from dataclasses import replace

import cv2
import numpy as np
import scipy
import scipy.sparse
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.terrain._fused import Fused

__all__ = ["filled"]

_RELIEF = 1.0
"""Standard deviation of what lies in a hole about the height that is filled in, over that of the heights
around the hole: measured on rendered ground (docs/terrain.md)."""


def filled(fused: Fused, widest_m: float) -> Fused:
    """A surface without the holes that are at most `widest_m` wide, which have seen cells all around.

    A hole is a group of unseen cells that touch along sides; its width is twice the distance of its innermost
    cell from what is seen. Heights and brightness are those of a membrane on the cells around (each cell the
    mean of its four neighbours). The variance is what such a membrane has of the variances around, and that
    of the heights around, for the ground in the hole is not known better. Filled cells have a count of 0.
    """
    label, number = _holes(fused, widest_m)
    cells = np.flatnonzero(label)
    if not number:
        return fused
    rows, columns = label.shape
    hole = label.ravel()[cells] - 1
    own = np.full(rows * columns, -1)
    own[cells] = np.arange(len(cells))
    beside = cells[:, None] + np.array([1, -1, columns, -columns])
    inner = own[beside] >= 0
    at, which = np.nonzero(inner)
    ones = np.ones(len(at))
    touch = scipy.sparse.coo_array((ones, (at, own[beside[at, which]])), shape=(len(cells),) * 2)
    membrane = scipy.sparse.linalg.splu(
        scipy.sparse.csc_array(4 * scipy.sparse.eye_array(len(cells)) - touch)
    )

    def stretched(band: NDArray[np.float32]) -> FloatArray:
        around = np.where(inner, 0.0, band.ravel().astype(float)[beside])
        return np.asarray(membrane.solve(around.sum(axis=1)))

    spread = _spread(fused.height_m.ravel().astype(float)[beside], inner, hole, number)
    variance = stretched(fused.sigma_m**2) + (_RELIEF * spread[hole]) ** 2
    new = {
        "height_m": stretched(fused.height_m),
        "sigma_m": np.sqrt(variance),
        "grey": stretched(fused.grey),
    }
    bands = {name: getattr(fused, name).copy() for name in new}
    for name, values in new.items():
        bands[name].ravel()[cells] = values
    return replace(fused, **bands)


def _holes(fused: Fused, widest_m: float) -> tuple[IntArray, int]:
    """Numbers (rows, columns), from 1 on, of the holes that are small enough, 0 elsewhere; and how many."""
    unseen = ~np.isfinite(fused.height_m)
    number, found = cv2.connectedComponents(unseen.astype(np.uint8), connectivity=4)
    label: IntArray = found.astype(np.int64)
    # From the middle of a cell to that of the nearest seen one: half a cell is the seen one's.
    away = cv2.distanceTransform(unseen.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5
    deepest = np.zeros(number)
    np.maximum.at(deepest, label[unseen], away[unseen])
    kept = 2 * fused.grid.cell_m * deepest <= widest_m
    kept[0] = False
    for edge in (label[0], label[-1], label[:, 0], label[:, -1]):
        kept[np.unique(edge)] = False
    renumbered = np.where(kept, np.cumsum(kept), 0)
    return renumbered[label], int(kept.sum())


def _spread(height_m: FloatArray, inner: NDArray[np.bool_], hole: IntArray, number: int) -> FloatArray:
    """Standard deviation (holes,) of the heights (cells, 4) around each hole, those not `inner`."""
    values, of = height_m[~inner], np.broadcast_to(hole[:, None], inner.shape)[~inner]
    count = np.bincount(of, minlength=number)
    mean = np.bincount(of, weights=values, minlength=number) / count
    return np.asarray(np.sqrt(np.bincount(of, weights=(values - mean[of]) ** 2, minlength=number) / count))
