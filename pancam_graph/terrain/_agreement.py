"""How far the surfaces of two frames differ where both see the same cells, before and after."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import IntArray
from pancam_graph.terrain._grid import Layer

__all__ = ["Agreement", "PairAgreement", "agreement_of", "finest_agreement"]

_LEAST_CELLS = 100


@dataclass(frozen=True, kw_only=True)
class PairAgreement:
    """Two frames that see the same ground: medians over the cells that both see."""

    frames: tuple[int, int]
    same_stop: bool
    cells: int
    """With the refined pointing."""
    telemetry_m: float
    """Median of the absolute difference in height; NaN where they share too few cells."""
    refined_m: float
    refined_sigmas: float
    """Median of the absolute difference over its standard deviation; 0.67 where sigmas are right."""

    @property
    def compared(self) -> bool:
        """Whether both numbers are known."""
        return bool(np.isfinite([self.telemetry_m, self.refined_m]).all())


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """All pairs of frames that see the same ground."""

    pairs: tuple[PairAgreement, ...]

    def median_m(self, pointing: str, *, same_stop: bool | None = None) -> float:
        """Median over pairs that have both numbers; NaN where there is none. None: of all stops."""
        both = [
            (p.telemetry_m, p.refined_m)
            for p in self.pairs
            if p.compared and same_stop in {None, p.same_stop}
        ]
        return float(np.median([b[pointing == "refined"] for b in both])) if both else float("nan")

    @property
    def median_sigmas(self) -> float:
        """Median over pairs, with the refined pointing; NaN where there is none."""
        found = [p.refined_sigmas for p in self.pairs if np.isfinite(p.refined_sigmas)]
        return float(np.median(found)) if found else float("nan")


def agreement_of(refined: Sequence[Layer], telemetry: Sequence[Layer], frame_stop: IntArray) -> Agreement:
    """Compare all pairs of frames. A cell that one frame sees twice, or between points, counts as once."""
    other = {layer.frame: layer for layer in telemetry}
    pairs = []
    for n, a in enumerate(refined):
        for b in refined[n + 1 :]:
            cells, off_m, sigmas = _difference(a, b)
            before = float("nan")
            if a.frame in other and b.frame in other:
                before = _difference(other[a.frame], other[b.frame])[1]
            if np.isfinite(off_m) or np.isfinite(before):
                pairs.append(
                    PairAgreement(
                        frames=(a.frame, b.frame),
                        same_stop=bool(frame_stop[a.frame] == frame_stop[b.frame]),
                        cells=cells,
                        telemetry_m=before,
                        refined_m=off_m,
                        refined_sigmas=sigmas,
                    )
                )
    return Agreement(pairs=tuple(pairs))


def finest_agreement(levels: Sequence[Agreement]) -> Agreement:
    """Of each pair of frames what the finest level says that shows both; levels are the finest first."""
    found = dict[tuple[int, int], PairAgreement]()
    for level in levels:
        for pair in level.pairs:
            known = found.get(pair.frames)
            if known is None or (pair.compared and not known.compared):
                found[pair.frames] = pair
    return Agreement(pairs=tuple(found[frames] for frames in sorted(found)))


def _difference(a: Layer, b: Layer) -> tuple[int, float, float]:
    """Cells that two layers share, and the median difference of their heights, in metres and in sigmas."""
    cut = a.cut(b)
    if cut is None:
        return 0, float("nan"), float("nan")
    off = np.abs(a.height_m[cut[0]] - b.height_m[cut[1]])
    both = np.isfinite(off)
    cells = int(np.count_nonzero(both))
    if cells < _LEAST_CELLS:
        return cells, float("nan"), float("nan")
    sigma = np.sqrt(a.variance_m2[cut[0]] + b.variance_m2[cut[1]])
    return cells, float(np.median(off[both])), float(np.median((off / sigma)[both]))
