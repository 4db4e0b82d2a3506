"""All landmarks of a problem, cut into blocks, and what is left of them for the cameras' variables."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pancam_graph import kernel
from pancam_graph.elimination._linkage import Linkage, Posture
from pancam_graph.elimination._panels import Covariance, Panels, pattern
from pancam_graph.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.landmarks import (
    CameraViews,
    Landmarks,
    Measurements,
    rays_of,
    refine,
    triangulate,
)
from pancam_graph.losses import SQUARED, Loss
from pancam_graph.threads import in_parallel

__all__ = ["LandmarkSystem"]

_T = TypeVar("_T", bound=np.generic)

_PARTS = 8
"""A chunk has at most this share of all observations, so that two cores, or eight, have even work."""
_ROOM = 6_000_000
"""Numbers in the dense systems of a wave of chunks: 48 MB."""
_STRAY = 0.5 * 5.0**2
"""A landmark with this cost per observation, as if all were 5 sigma off, is placed anew after a step."""
_SMALLEST_CHUNK = 4000
"""Observations of a chunk that is worth its overhead."""


@dataclass(frozen=True, kw_only=True)
class _Block:
    """Landmarks first seen from one stop, and the groups that these touch."""

    groups: tuple[int, ...]
    """In the order of elimination."""
    begin: IntArray
    """(groups + 1,) first column of each in the block"""
    segment_column: IntArray
    """(segments,) first column of each segment in the block; -1 where it is of another"""
    n_units: int


@dataclass(frozen=True, kw_only=True)
class _Chunk:
    """Landmarks of a block that one thread takes at once. Depends on the problem, not on the threads."""

    block: int
    begin: int
    end: int


_Wave = list[_Chunk]
_Systems = list[tuple[FloatArray, FloatArray]]
"""(S, s) of each chunk of a wave, over the columns of its block."""


class LandmarkSystem:
    """Landmarks as 4-vectors on S^3 that follow the cameras, eliminated from every linearisation.

    `linearise` gives the square root of the system in the cameras' variables that is left; `try_step` moves
    landmarks along with a step of these variables and tells the true cost; `adopt` makes that the
    next point of linearisation.
    """

    def __init__(
        self,
        linkage: Linkage,
        measurements: Measurements,
        landmarks: Landmarks,
        loss: Loss = SQUARED,
        *,
        cliques: Iterable[Iterable[int]] = (),
    ) -> None:
        """Arrange observations and landmarks; `cliques` are groups that other factors join."""
        self.linkage, self.loss = linkage, loss
        self._measurements = measurements
        n = len(landmarks.vector)
        first, reach = _blocks(linkage, measurements)
        self.landmark_row = np.argsort(first, kind="stable")
        """(landmarks,) row in `landmarks` of each in the order of elimination"""
        self.vector = landmarks.vector[self.landmark_row]
        """(landmarks, 4) at the point of linearisation"""
        self.origin_m = landmarks.origin_m[self.landmark_row]
        self.structure = pattern(linkage.group_dim, [*reach.values(), *cliques])
        self._panels = Panels(self.structure)
        edges = np.flatnonzero(np.diff(first[self.landmark_row], prepend=-1, append=-1))
        self._arrange(measurements, first, reach, edges)
        self.reduced = kernel.Reduced(
            factor=np.empty((n, 6)),
            gamma=np.empty((n, 3)),
            arms=np.empty(3 * len(self.sights.column)),
            cost=np.zeros(n),
            undetermined=np.zeros(n, dtype=bool),
        )
        self._memory = np.empty(0)
        self._moved, self._moved_cost = np.empty_like(self.vector), np.zeros(n)
        self._has_moved = False

    def _arrange(
        self, m: Measurements, first: IntArray, reach: dict[int, tuple[int, ...]], edges: IntArray
    ) -> None:
        """Fill `sights`, `blocks` and `chunks`."""
        link = self.linkage
        n_obs, n = len(m.image), len(self.landmark_row)
        segments = np.diff(link.segment_begin)
        widths = np.add.reduceat(np.append(link.segment_width, 0), link.segment_begin[:-1]) * (segments > 0)
        unit = link.image_unit[m.image]
        sights = kernel.Sights(
            image=np.empty(n_obs, dtype=np.int64),
            uv_px=np.empty((0, 2)),
            whitening=np.empty((0, 2, 2)),
            occurrence_begin=np.empty(n_obs + 1, dtype=np.int64),
            occurrence_unit=np.empty(n_obs, dtype=np.int64),
            occurrence_row=np.empty(n_obs, dtype=np.int64),
            place_begin=np.empty(n_obs + 1, dtype=np.int64),
            place=np.empty(int(segments[unit].sum()), dtype=np.int64),
            landmark_begin=np.empty(n + 1, dtype=np.int64),
            column_begin=np.empty(n + 1, dtype=np.int64),
            column=np.empty(int(widths[unit].sum()), dtype=np.int64),
        )
        begin = m.begin
        rows, cursor = np.empty(n_obs, dtype=np.int64), np.zeros(4, dtype=np.int64)
        most = max(n_obs // _PARTS, _SMALLEST_CHUNK)
        self.blocks: list[_Block] = []
        self.chunks: list[_Chunk] = []
        for a, b in pairwise(edges.tolist()):
            groups = tuple(self._panels.sorted(reach[int(first[self.landmark_row[a]])]))
            ends = np.concatenate([[0], np.cumsum(link.group_dim[list(groups)])])
            group_column = np.full(link.n_groups, -1)
            group_column[list(groups)] = ends[:-1]
            of = link.segment_variable
            column = group_column[link.group[of]] + link.variable_column[of] + link.segment_column
            n_units = kernel.arrange(
                self.landmark_row[a:b],
                begin,
                m.image,
                link.image_unit,
                link.segment_begin,
                link.segment_width,
                column,
                int(ends[-1]),
                a,
                rows,
                sights,
                cursor,
            )
            self.blocks.append(_Block(groups=groups, begin=ends, segment_column=column, n_units=n_units))
            counts = np.cumsum(begin[self.landmark_row[a:b] + 1] - begin[self.landmark_row[a:b]])
            n_parts = -(-int(counts[-1]) // most)
            cuts = [a, *(a + 1 + np.searchsorted(counts, counts[-1] * np.arange(1, n_parts) / n_parts)), b]
            self.chunks += [
                _Chunk(block=len(self.blocks) - 1, begin=int(p), end=int(q))
                for p, q in pairwise(cuts)
                if q > p
            ]
        occurrences, places, columns = (int(c) for c in cursor[1:])
        sights.occurrence_begin[occurrences] = n_obs
        sights.place_begin[occurrences] = places
        sights.landmark_begin[n], sights.column_begin[n] = occurrences, columns
        self.sights = sights._replace(
            uv_px=m.uv_px[rows],
            whitening=m.whitening[rows],
            occurrence_begin=sights.occurrence_begin[: occurrences + 1].copy(),
            occurrence_unit=sights.occurrence_unit[:occurrences].copy(),
            occurrence_row=sights.occurrence_row[:occurrences].copy(),
            place_begin=sights.place_begin[: occurrences + 1].copy(),
            place=sights.place[:places].copy(),
            column=sights.column[:columns].copy(),
        )

    def bearings(self, posture: Posture) -> kernel.Bearings:
        """A posture as the kernel reads it."""
        views = posture.views
        return kernel.Bearings(
            to_pixel=np.ascontiguousarray(views.to_pixel),
            centre_m=np.ascontiguousarray(views.world_t_camera),
            calibration=np.ascontiguousarray(views.calibration),
            unit_R=np.ascontiguousarray(posture.unit_R),
            unit_t=np.ascontiguousarray(posture.unit_t),
            segment_begin=self.linkage.segment_begin,
            segment_width=self.linkage.segment_width,
            chain=np.ascontiguousarray(posture.chain),
        )

    def linearise(self, posture: Posture) -> Panels:
        """The system (S, s) in the cameras' variables at the landmarks' present places.

        The panels are this object's own and are filled anew by the next call.
        """
        bearings = self.bearings(posture)
        eliminate = kernel.eliminate_poses if bearings.chain.shape[1] == 6 else kernel.eliminate_calibrations
        paired = not np.any(self.linkage.segment_width % 2) and not np.any(self.linkage.segment_column % 2)
        self._panels.clear()
        for wave in self._waves:
            systems = self._room(wave)

            def eliminated(first: int, last: int, wave: _Wave = wave, systems: _Systems = systems) -> None:
                for chunk, (S, s) in zip(wave[first:last], systems[first:last], strict=True):
                    S.fill(0.0)
                    s.fill(0.0)
                    block = self.blocks[chunk.block]
                    eliminate(
                        self.sights,
                        bearings,
                        self.vector,
                        self.origin_m,
                        self.loss.kind,
                        self.loss.width,
                        chunk.begin,
                        chunk.end,
                        block.segment_column,
                        block.n_units,
                        paired,
                        self.reduced,
                        S,
                        s,
                    )

            def summed(first: int, last: int, wave: _Wave = wave, systems: _Systems = systems) -> None:
                # In the order of the chunks, so that no bit depends on the number of threads.
                for chunk, (S, s) in zip(wave, systems, strict=True):
                    block = self.blocks[chunk.block]
                    for i, g in enumerate(block.groups):
                        if first <= g < last:
                            self._panels.add_rows(i, block.groups, block.begin, S, s)

            in_parallel(eliminated, len(wave), grain=1)
            in_parallel(summed, self.linkage.n_groups, grain=1 + self.linkage.n_groups // 8)
        return self._panels

    @cached_property
    def _waves(self) -> list[list[_Chunk]]:
        """Chunks whose dense systems are in memory at once."""
        waves: list[list[_Chunk]] = [[]]
        room = 0
        for chunk in self.chunks:
            need = int(self.blocks[chunk.block].begin[-1]) ** 2
            if waves[-1] and room + need > _ROOM:
                waves.append([])
                room = 0
            waves[-1].append(chunk)
            room += need
        return waves

    def _room(self, wave: list[_Chunk]) -> _Systems:
        """A dense system (S, s) for each chunk of a wave, in memory that is used again."""
        dims = [int(self.blocks[chunk.block].begin[-1]) for chunk in wave]
        need = sum(n * n + n for n in dims)
        if len(self._memory) < need:
            self._memory = np.empty(need)
        out, begin = [], 0
        for n in dims:
            out.append((self._memory[begin : begin + n * n].reshape(n, n), self._memory[begin + n * n :][:n]))
            begin += n * n + n
        return out

    def try_step(self, posture: Posture, step: FloatArray) -> FloatArray:
        """Costs (blocks,) where a step of all variables (columns,) leads, landmarks moved along.

        `posture` is that after the step. A landmark that cannot be brought in front of its cameras costs
        kernel.BEHIND_COST.
        """
        bearings = self.bearings(posture)
        column = self.linkage.group_column
        steps = [
            np.concatenate([step[:0], *(step[column[g] : column[g + 1]] for g in b.groups)])
            for b in self.blocks
        ]

        def work(begin: int, end: int) -> None:
            for chunk in self.chunks[begin:end]:
                kernel.follow(
                    self.sights,
                    bearings,
                    self.vector,
                    self.origin_m,
                    self.loss.kind,
                    self.loss.width,
                    chunk.begin,
                    chunk.end,
                    self.reduced,
                    steps[chunk.block],
                    self._moved,
                    self._moved_cost,
                )

        in_parallel(work, len(self.chunks), grain=1)
        self._has_moved = True
        self._replace_strays(posture.views, bearings)
        return self._by_block(self._moved_cost)

    def _replace_strays(self, views: CameraViews, bearings: kernel.Bearings) -> None:
        """Place anew what is behind a camera or was left far off; elsewhere the linear step is good.

        First from where the step led; what is far off even then, from nothing but its rays.
        """
        counts = np.diff(self.sights.occurrence_begin[self.sights.landmark_begin])
        strays = np.flatnonzero(self._moved_cost > _STRAY * counts)
        if len(strays) == 0:
            return
        m, ones = self._measurements, np.ones(len(self.sights.image))
        moved = Landmarks(vector=self._given(self._moved), origin_m=self._given(self.origin_m))
        rows = self.landmark_row[strays]
        refined = refine(moved, m, views, ones, self.loss, beyond_infinity=True, only=np.sort(rows))
        self._take_if_better(strays, refined.vector[rows], bearings)

        strays = strays[self._moved_cost[strays] > _STRAY * counts[strays]]
        if len(strays) == 0:
            return
        lost = np.zeros(len(counts), dtype=bool)
        lost[self.landmark_row[strays]] = True
        part, rows = m.part(np.flatnonzero(lost[m.landmark])), np.cumsum(lost)[self.landmark_row[strays]] - 1
        origin = moved.origin_m[lost]
        placed = triangulate(*rays_of(part, views), part.landmark, ones[: len(part.image)]).about(origin)
        placed = refine(placed, part, views, ones[: len(part.image)], self.loss, beyond_infinity=True)
        self._take_if_better(strays, placed.vector[rows], bearings)

    def _take_if_better(self, strays: IntArray, vector: FloatArray, bearings: kernel.Bearings) -> None:
        cost, loss = np.empty(len(strays)), self.loss
        kernel.costs(self.sights, bearings, strays, vector, self.origin_m, loss.kind, loss.width, cost)
        better = cost < self._moved_cost[strays]
        self._moved[strays[better]], self._moved_cost[strays[better]] = vector[better], cost[better]

    def _given(self, array: NDArray[_T]) -> NDArray[_T]:
        """Rows in the order that landmarks were given in."""
        out = np.empty_like(array)
        out[self.landmark_row] = array
        return out

    def adopt(self) -> None:
        """Take the landmarks of the last step tried as the next point of linearisation."""
        self.vector, self._moved = self._moved, self.vector

    @property
    def any_behind(self) -> bool:
        """Whether a landmark was behind a camera of its own where the last step led, or at its first."""
        cost = self._moved_cost if self._has_moved else self.reduced.cost
        return bool(cost.max() >= kernel.BEHIND_COST)

    def block_costs(self) -> FloatArray:
        """Costs (blocks,) at the last linearisation."""
        return self._by_block(self.reduced.cost)

    def _by_block(self, cost: FloatArray) -> FloatArray:
        begin = [0] * len(self.blocks)
        for chunk in reversed(self.chunks):
            begin[chunk.block] = chunk.begin
        return np.add.reduceat(cost, begin)

    def landmarks(self) -> Landmarks:
        """Landmarks at the point of linearisation, in the order they were given in."""
        return Landmarks(vector=self._given(self.vector), origin_m=self._given(self.origin_m))

    def landmark_covariance_m2(self, covariance: Covariance) -> FloatArray:
        """Covariance (landmarks, 3, 3) of world points X / w, cameras marginalised, in the order given.

        V^-1 + V^-1 E' C E V^-1 with C the covariance of the variables that a landmark's cameras hang on; at
        the last linearisation. Infinite for landmarks at infinity.
        """
        out = np.empty((len(self.landmark_row), 3, 3))
        for chunk in self.chunks:
            groups = self.blocks[chunk.block].groups
            joint = (
                np.block([[covariance.block(g, h) for h in groups] for g in groups])
                if groups
                else np.zeros((0, 0))
            )
            kernel.spread(self.sights, self.reduced, self.vector, joint, chunk.begin, chunk.end, out)
        return self._given(out)

    @property
    def undetermined(self) -> BoolArray:
        """(landmarks,) which the weak prior alone held at the last linearisation, in the order given."""
        return self._given(self.reduced.undetermined)


def _blocks(linkage: Linkage, m: Measurements) -> tuple[IntArray, dict[int, tuple[int, ...]]]:
    """Block of each landmark, named by the first group that sees it, and the groups each block touches."""
    groups = [linkage.unit_groups[u] for u in linkage.image_unit]
    # What no variable moves is of a block of its own that touches nothing.
    nobody = linkage.n_groups
    image_first = np.array([g[0] if g else nobody for g in groups])
    first = np.minimum.reduceat(image_first[m.image], m.starts)
    seen = np.zeros((nobody + 1, len(groups)), dtype=bool)
    seen[first[m.landmark], m.image] = True
    return first, {
        int(b): tuple(sorted(set().union(*(groups[i] for i in np.flatnonzero(seen[b])))))
        for b in np.unique(first)
    }
