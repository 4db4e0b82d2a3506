"""A section through the surfaces of two frames, before and after."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.terrain._agreement import Agreement
from pancam_graph.terrain._grid import Grid, Layer

__all__ = ["Section", "section_of"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Section:
    """Heights that two frames see along a line, with each pointing."""

    frames: tuple[int, int]
    ends_m: tuple[tuple[float, float], tuple[float, float]]
    """World x and y of the first and the last cell."""
    along_m: FloatArray
    """(n,) way of each cell along the line."""
    refined_m: NDArray[np.float32]
    """(2, n) heights of each frame; NaN where it sees nothing."""
    telemetry_m: NDArray[np.float32]
    """(2, n) heights with telemetry's pointing."""


def section_of(
    agreement: Agreement, refined: Sequence[Layer], telemetry: Sequence[Layer], grid: Grid
) -> Section | None:
    """A section of the two frames that share most cells, of those that telemetry puts apart by the median.

    It runs along the row or the column of the grid in which both frames see most cells with either pointing.
    None where no two frames do.
    """
    pairs = [p for p in agreement.pairs if p.compared]
    if not pairs:
        return None
    middle = agreement.median_m("telemetry")
    pair = max((p for p in pairs if p.telemetry_m >= middle), key=lambda p: p.cells)
    of = [{layer.frame: layer for layer in layers} for layers in (refined, telemetry)]
    layers = [each[frame] for each in of for frame in pair.frames]
    top, left = (min(layer.box[k].start for layer in layers) for k in (0, 1))
    bottom, right = (max(layer.box[k].stop for layer in layers) for k in (0, 1))
    heights = np.full((4, bottom - top, right - left), np.nan, dtype=np.float32)
    for own, layer in zip(heights, layers, strict=True):
        rows, columns = layer.box
        own[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = layer.height_m
    both: BoolArray = np.asarray(np.isfinite(heights).all(axis=0))
    if not both.any():
        return None
    row, column = int(both.sum(axis=1).argmax()), int(both.sum(axis=0).argmax())
    x, y = grid.part(top, left, bottom - top, right - left).middles()
    if both[row].sum() >= both[:, column].sum():
        seen, cut = np.flatnonzero(both[row]), heights[:, row]
        places = np.stack([x, np.full_like(x, y[row])], axis=1)
    else:
        seen, cut = np.flatnonzero(both[:, column]), heights[:, :, column]
        places = np.stack([np.full_like(y, x[column]), y], axis=1)
    cut, places = cut[:, seen[0] : seen[-1] + 1], places[seen[0] : seen[-1] + 1]
    return Section(
        frames=pair.frames,
        ends_m=((float(places[0, 0]), float(places[0, 1])), (float(places[-1, 0]), float(places[-1, 1]))),
        along_m=np.linalg.norm(places - places[0], axis=1),
        refined_m=cut[:2],
        telemetry_m=cut[2:],
    )
