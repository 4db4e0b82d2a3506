"""All landmarks of a problem, in blocks, and their Schur complement on the variables of cameras."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice, pairwise
from threading import local
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.scratch import Scratch
from pancam_graph.base.threads import in_parallel
from pancam_graph.cameras import Fields
from pancam_graph.elimination._blocks import Block, Layout, blocks_of
from pancam_graph.elimination._fields import FieldPart, FieldSystem
from pancam_graph.elimination._linkage import Linkage, Posture
from pancam_graph.elimination._panels import Covariance, Panels, Pattern, pattern
from pancam_graph.elimination._strays import Strays, is_halfway
from pancam_graph.landmarks import (
    SQUARED,
    CameraViews,
    Landmarks,
    Loss,
    Measurements,
    kernel,
)

__all__ = ["LandmarkSystem", "Room"]

_T = TypeVar("_T", bound=np.generic)

_PARTS = 8
"""Parts of equal size, of all observations, that a chunk does not exceed: two or eight cores then have even
work."""
_ROOM = 6_000_000
"""Numbers in the dense systems of a wave of chunks: 48 MB."""
_COST_GRAIN = 8192
"""Landmarks whose cost one thread computes at once."""
_SMALLEST_SUM = 200_000
"""Entries of dense systems from which on several threads sum them up."""
_SMALLEST_FILL = 1_000_000
"""Entries of dense systems from which on several threads clear them: after each clearing a thread waits for
the interpreter's lock."""
_SMALLEST_CHUNK = 4000
"""Least observations of a chunk, below which its overhead dominates."""
_ENTRIES_PER_OBSERVATION = 25
"""Entries of a dense system whose filling and summing takes about as long as one observation."""


@dataclass(frozen=True, kw_only=True)
class _Chunk:
    """Landmarks of a block that one thread takes at once. Depends on the problem, not on the threads."""

    block: int
    begin: int
    end: int


class Room(local):
    """Memory that systems share if they are linearised one after the other.

    Allocating memory would take as long as filling it. Each thread has memory of its own, so systems may also
    be linearised in parallel.
    """

    def __init__(self) -> None:
        self._numbers = np.empty(0)
        self._columns = np.empty(0, dtype=np.int64)

    def numbers(self, n: int) -> FloatArray:
        """(n,) numbers with arbitrary values."""
        if len(self._numbers) < n:
            # At least twice as much as before, so that growth in small steps rarely needs new memory.
            self._numbers = np.empty(max(n, 2 * len(self._numbers)))
        return self._numbers[:n]

    def columns_of(self, block: Block, n: int) -> IntArray:
        """(n,) first column in a block of each of n segments; arbitrary for units that do not see it."""
        if len(self._columns) < n:
            self._columns = np.empty(n, dtype=np.int64)
        self._columns[block.segment] = block.segment_column
        return self._columns[:n]


_OfChunk = tuple[FloatArray, FloatArray, int, float, int, int, IntArray, int, kernel.Reduced]
_Wave = list[_Chunk]
_Systems = list[tuple[FloatArray, FloatArray]]
"""(S, s) of each chunk of a wave, over the columns of its block; S in tiles, see kernel.add_to_panels."""


class LandmarkSystem:
    """Landmarks, unit 4-vectors on S^3, that are eliminated from every linearisation.

    `linearise` gives the Schur complement on the variables of cameras; `try_step` moves the landmarks along
    with a step of these variables and returns the true cost; `adopt` makes the moved landmarks the next
    linearisation point.
    """

    def __init__(
        self,
        linkage: Linkage,
        measurements: Measurements,
        landmarks: Landmarks,
        loss: Loss = SQUARED,
        *,
        cliques: Iterable[Iterable[int]] = (),
        last: int | None = None,
        refined: bool = False,
        room: Room | None = None,
        structure: Pattern | None = None,
    ) -> None:
        """Arrange observations and landmarks; `cliques` are groups that other factors join.

        `last` is the group that is eliminated last; None: the one that leaves the least work. `refined`:
        after a step all landmarks are refined, not only strays. `structure` is that of a system of which
        these are some of the landmarks; None: they are all.
        """
        self.linkage, self.loss, self._refined = linkage, loss, refined
        self._measurements = measurements
        n = len(landmarks.vector)
        first, reach, units = blocks_of(linkage, measurements)
        self.landmark_row = np.argsort(first, kind="stable")
        """(landmarks,) row in `landmarks` of each in the order of elimination"""
        self.vector = landmarks.vector[self.landmark_row]
        """(landmarks, 4) at the point of linearisation"""
        self.origin_m = landmarks.origin_m[self.landmark_row]
        self.structure = structure or pattern(linkage.group_dim, [*reach.values(), *cliques], last=last)
        self._panels = Panels(self.structure)  # stays 0, and without memory where it is large
        self._layout = Layout.of(linkage)
        self._memory = room or Room()
        edges = np.flatnonzero(np.diff(first[self.landmark_row], prepend=-1, append=-1))
        self._arrange(measurements, first, reach, units, edges)
        self.reduced = kernel.Reduced(
            factor=np.empty((n, 6)),
            gamma=np.empty((n, 3)),
            arms=np.empty(6 * len(self.sights.pair)),
            cost=np.zeros(n),
            undetermined=np.zeros(n, dtype=bool),
        )
        self.regained = 0.0
        """Decrease of the cost by placing strays anew after the last step tried."""
        self._fields: FieldSystem | None = None
        if linkage.fields is not None:
            self._fields = FieldSystem(linkage.fields, self.sights.image, self.sights.uv_px, self._begin)
        self._plain: tuple[Fields, kernel.Sights] | None = None
        self._on_disk: Scratch | None = None
        self._arms_on_disk: Scratch | None = None
        self._moved, self._moved_cost = np.empty_like(self.vector), np.zeros(n)
        self._has_moved = False
        self._posture: Posture
        self._rests = False

    def _arrange(
        self,
        m: Measurements,
        first: IntArray,
        reach: dict[int, tuple[int, ...]],
        units: dict[int, IntArray],
        edges: IntArray,
    ) -> None:
        """Fill `sights`, `blocks` and `chunks`."""
        link = self.linkage
        n_obs, n = len(m.image), len(self.landmark_row)
        n_pairs = (link.segment_width + 1) // 2
        times = np.bincount(m.image, minlength=len(link.image_unit))
        of_unit = np.bincount(link.image_unit, times, minlength=len(link.segment_begin) - 1)
        n_segments = int(of_unit @ np.diff(link.segment_begin))
        most_pairs = int(of_unit @ np.diff(np.concatenate([[0], np.cumsum(n_pairs)])[link.segment_begin]))
        sights = kernel.Sights(
            image=np.empty(n_obs, dtype=np.int64),
            uv_px=np.empty((0, 2)),
            whitening=np.empty((0, 2, 2)),
            occurrence_begin=np.empty(n_obs + 1, dtype=np.int64),
            occurrence_unit=np.empty(n_obs, dtype=np.int32),
            occurrence_row=np.empty(n_obs, dtype=np.int32),
            place_begin=np.empty(n_obs + 1, dtype=np.int64),
            place=np.empty(n_segments, dtype=np.int32),
            landmark_begin=np.empty(n + 1, dtype=np.int64),
            pair_begin=np.empty(n + 1, dtype=np.int64),
            pair=np.empty(most_pairs, dtype=np.int32),
        )
        begin = m.begin
        rows, cursor = np.empty(n_obs, dtype=np.int64), np.zeros(4, dtype=np.int64)
        self.blocks: list[Block] = []
        self.chunks: list[_Chunk] = []
        for a, b in pairwise(edges.tolist()):
            name = int(first[self.landmark_row[a]])
            groups = tuple(self._panels.sorted(reach[name]))
            block = Block.of(link, self._layout, self._panels, groups, units[name])
            n_units = kernel.arrange(
                self.landmark_row[a:b],
                begin,
                m.image,
                link.image_unit,
                link.segment_begin,
                n_pairs,
                self._memory.columns_of(block, len(link.segment_width)) >> 1,
                len(block.row) // 2,
                a,
                rows,
                sights,
                cursor,
            )
            self.blocks.append(replace(block, n_units=n_units))
            counts = np.cumsum(begin[self.landmark_row[a:b] + 1] - begin[self.landmark_row[a:b]])
            most = max(n_obs // _PARTS, _SMALLEST_CHUNK, len(block.row) ** 2 // _ENTRIES_PER_OBSERVATION)
            n_parts = -(-int(counts[-1]) // most)
            cuts = [a, *(a + 1 + np.searchsorted(counts, counts[-1] * np.arange(1, n_parts) / n_parts)), b]
            self.chunks += [
                _Chunk(block=len(self.blocks) - 1, begin=int(p), end=int(q))
                for p, q in pairwise(cuts)
                if q > p
            ]
        occurrences, places, pairs = (int(c) for c in cursor[1:])
        sights.occurrence_begin[occurrences] = n_obs
        sights.place_begin[occurrences] = places
        sights.landmark_begin[n], sights.pair_begin[n] = occurrences, pairs
        in_order = np.array_equal(rows, np.arange(n_obs))
        self.sights = sights._replace(
            uv_px=m.uv_px if in_order else m.uv_px.take(rows, axis=0),  # several times as fast as an index
            whitening=m.whitening if in_order else m.whitening.take(rows, axis=0),
            occurrence_begin=sights.occurrence_begin[: occurrences + 1].copy(),
            occurrence_unit=sights.occurrence_unit[:occurrences].copy(),
            occurrence_row=sights.occurrence_row[:occurrences].copy(),
            place_begin=sights.place_begin[: occurrences + 1].copy(),
            place=sights.place[:places].copy(),
            pair=sights.pair[:pairs].copy(),
        )

    def bearings(self, posture: Posture) -> kernel.Bearings:
        """A posture as the kernel reads it."""
        return kernel.Bearings(
            cameras=posture.views.in_kernel,
            unit_R=np.ascontiguousarray(posture.unit_R),
            unit_t=np.ascontiguousarray(posture.unit_t),
            segment_begin=self.linkage.segment_begin,
            segment_width=self.linkage.segment_width,
            plain=self.linkage.segment_plain,
            chain=np.ascontiguousarray(posture.chain),
        )

    def linearise(self, posture: Posture, into: Panels | None = None) -> Panels:
        """The reduced normal equations (S, s) of the cameras' variables.

        These are the normal equations of cameras and landmarks (thesis eq. 3.40) with landmarks eliminated
        (eq. 3.42), linearised at the given posture and at the landmarks' linearisation point. They are added
        to those of other landmarks, `into`, if these are given.
        """
        bearings, sights = self.bearings(posture), self._sights_at(posture.views)
        if self._rests:
            self.reduced = self.reduced._replace(arms=self._room_for_arms())
        self._posture, self._rests = posture, False
        eliminate = kernel.eliminate_poses if bearings.chain.shape[1] == 6 else kernel.eliminate_calibrations
        panels = into or self._panels.blank()
        for wave in self._waves:
            systems = self._room(wave)
            n_entries = sum(len(S) for S, _ in systems)
            by_chunk = n_entries >= _SMALLEST_FILL
            parts = self._field_parts(wave, posture.views)
            if not by_chunk:
                for S, s in systems:
                    S.fill(0.0)
                    s.fill(0.0)

            def eliminated(
                first: int,
                last: int,
                wave: _Wave = wave,
                systems: _Systems = systems,
                parts: Sequence[tuple[kernel.FieldSights, FieldPart]] = parts,
                by_chunk: bool = by_chunk,
            ) -> None:
                for chunk, (S, s) in zip(wave[first:last], systems[first:last], strict=True):
                    if by_chunk:
                        S.fill(0.0)
                        s.fill(0.0)
                    eliminate(sights, bearings, *self._of_chunk(chunk), S, s)
                for chunk, (seen, part) in zip(wave[first:last], parts[first:last], strict=False):
                    kernel.eliminate_fields(sights, bearings, seen, *self._of_chunk(chunk), *part)

            def summed(first: int, last: int, wave: _Wave = wave, systems: _Systems = systems) -> None:
                # In the order of the chunks, so that no bit depends on the number of threads.
                for chunk, (S, s) in zip(wave, systems, strict=True):
                    block = self.blocks[chunk.block]
                    of_block = block.row, block.group, block.begin, block.panel_column
                    to = panels.begin, panels.width, panels.numbers
                    kernel.add_to_panels(S, s, *of_block, first, last, *to)

            in_parallel(eliminated, len(wave), grain=1)
            n_groups = self.linkage.n_groups
            grain = max(n_groups, 1) if n_entries < _SMALLEST_SUM else 1 + n_groups // 8
            in_parallel(summed, n_groups, grain=grain)
            for chunk, (_, part) in zip(wave, parts, strict=False):
                assert self._fields is not None
                self._fields.add(part, self.blocks[chunk.block], panels)
        return panels

    def _of_chunk(self, chunk: _Chunk) -> _OfChunk:
        """What the loops that eliminate take of the landmarks of a chunk, in their order."""
        block, loss = self.blocks[chunk.block], self.loss
        landmarks = self.vector, self.origin_m, loss.kind, loss.width, chunk.begin, chunk.end
        columns = self._memory.columns_of(block, len(self.linkage.segment_width))
        return *landmarks, columns, block.n_units, self.reduced

    def _field_parts(self, wave: _Wave, views: CameraViews) -> Sequence[tuple[kernel.FieldSights, FieldPart]]:
        """Room for what each chunk of a wave tells about fields; empty where there are none."""
        fields = self._fields
        if fields is None:
            return ()
        seen = fields.linearise_at(views)
        return [(seen, fields.room(self.blocks[chunk.block])) for chunk in wave]

    def _sights_at(self, views: CameraViews) -> kernel.Sights:
        """Observations without the fields of these cameras."""
        if self._fields is not None:
            return self.sights._replace(uv_px=self._fields.pixels(views))
        if views.fields is None:
            return self.sights
        if self._plain is None or self._plain[0] is not views.fields:
            uv_px = views.without_field(self.sights.image, self.sights.uv_px)
            self._plain = views.fields, self.sights._replace(uv_px=np.ascontiguousarray(uv_px))
        return self._plain[1]

    def _room_for_arms(self) -> FloatArray:
        n = 6 * len(self.sights.pair)
        if self._on_disk is None:
            return np.empty(n)
        self._arms_on_disk = Scratch([((n,), np.float64)])
        return self._arms_on_disk.arrays[0]

    def put_on_disk(self) -> None:
        """Move all arrays of observations and of landmarks to a temporary file; see `let_go`."""
        m = self._measurements
        own = (self.vector, self.origin_m, self._moved, self._moved_cost)
        of_m = (m.row, m.image, m.landmark, m.uv_px, m.whitening)
        of_reduced = (self.reduced.factor, self.reduced.gamma, self.reduced.cost, self.reduced.undetermined)
        self._on_disk = Scratch.of([*own, *of_m, *of_reduced, *self.sights])
        stored = iter(self._on_disk.arrays)
        self.vector, self.origin_m, self._moved, self._moved_cost = islice(stored, len(own))
        names = ("row", "image", "landmark", "uv_px", "whitening")
        self._measurements = replace(m, **dict(zip(names, islice(stored, len(of_m)), strict=True)))
        factor, gamma, cost, undetermined = islice(stored, len(of_reduced))
        self.sights = kernel.Sights(*stored)
        self.reduced = kernel.Reduced(
            factor=factor, gamma=gamma, arms=self._room_for_arms(), cost=cost, undetermined=undetermined
        )

    def let_go(self) -> None:
        """Take what is on disk out of memory, until it is needed again."""
        for stored in (self._on_disk, self._arms_on_disk):
            if stored is not None:
                stored.let_go()

    def rest(self) -> None:
        """Give back the memory of products of landmarks with cameras: what needs them linearises again."""
        self.reduced, self._memory = self.reduced._replace(arms=np.empty(0)), Room()
        self._arms_on_disk = None
        self._rests = True

    def put_back(self, panels: Panels, g: int) -> tuple[FloatArray, FloatArray]:
        """The system (n, n), (n,) in the columns of one group, landmarks and other variables held.

        `panels` are those of the last linearisation, with any other factors added. Elimination subtracted W'W
        and W'gamma of each landmark, W = L^-1 E' and gamma = L^-1 g with L L' = V; both are added again.
        """
        n = int(self.linkage.group_dim[g])
        upper = np.triu(panels.panel[g][:, :n])
        S, s = upper + np.triu(upper, 1).T, panels.panel[g][:, -1].copy()
        for chunk in self.chunks:
            block = self.blocks[chunk.block]
            if g not in block.groups:
                continue
            i = block.groups.index(g)
            W = np.zeros((chunk.end - chunk.begin, 3, n + 1))
            W[:, :, block.row[block.begin[i] : block.begin[i + 1]]] = self._dense_arms(chunk)[
                :, :, block.begin[i] : block.begin[i + 1]
            ]
            W = W.reshape(-1, n + 1)[:, :n]
            S += W.T @ W
            s += W.T @ self.reduced.gamma[chunk.begin : chunk.end].ravel()
        return S, s

    def _dense_arms(self, chunk: _Chunk) -> FloatArray:
        """W = L^-1 E' (landmarks, 3, columns of the block) of the landmarks of a chunk."""
        if self._rests:
            self.linearise(self._posture)
        counts = np.diff(self.sights.pair_begin[chunk.begin : chunk.end + 1])
        first, last = self.sights.pair_begin[chunk.begin], self.sights.pair_begin[chunk.end]
        landmark, pair = np.repeat(np.arange(len(counts)), counts), self.sights.pair[first:last]
        out = np.zeros((len(counts), 3, len(self.blocks[chunk.block].row) // 2, 2))
        out[landmark, :, pair] = self.reduced.arms.reshape(-1, 3, 2)[first:last]
        return out.reshape(len(counts), 3, -1)

    @cached_property
    def _waves(self) -> list[list[_Chunk]]:
        """Chunks whose dense systems are in memory at once."""
        waves: list[list[_Chunk]] = [[]]
        room = 0
        for chunk in self.chunks:
            need = len(self.blocks[chunk.block].row) ** 2
            if waves[-1] and room + need > _ROOM:
                waves.append([])
                room = 0
            waves[-1].append(chunk)
            room += need
        return waves

    def _room(self, wave: list[_Chunk]) -> _Systems:
        """A dense system (S, s) for each chunk of a wave, in memory that is used again."""
        dims = [len(self.blocks[chunk.block].row) for chunk in wave]
        memory = self._memory.numbers(sum(n * n + n for n in dims))
        out, begin = [], 0
        for n in dims:
            out.append((memory[begin : begin + n * n], memory[begin + n * n :][:n]))
            begin += n * n + n
        return out

    def try_step(self, posture: Posture, step: FloatArray) -> FloatArray:
        """True costs (blocks,) after a step of all variables (columns,), with landmarks moved along.

        Landmarks follow by back substitution (thesis eq. 3.43), and strays among them are refined or
        triangulated. `posture` is that after the step. A landmark that cannot be brought in front of its
        cameras costs kernel.BEHIND_COST.
        """
        self.follow(posture, step)
        self.replace_strays(posture, halfway=is_halfway(self.linearised_cost, self.moved_cost))
        return self._by_block(self._moved_cost)

    def follow(self, posture: Posture, step: FloatArray) -> None:
        """The first half of `try_step`: back substitution."""
        bearings, sights, reduced = self.bearings(posture), self._sights_at(posture.views), self.reduced
        with_none = np.append(step, 0.0)  # for columns that belong to no variable
        steps = [with_none[block.source] for block in self.blocks]
        if self._fields is not None:
            reduced = reduced._replace(gamma=self._fields.following(reduced.gamma, posture.views))

        landmarks = self.vector, self.origin_m, self.loss.kind, self.loss.width
        moved = self._moved, self._moved_cost

        def work(begin: int, end: int) -> None:
            for chunk in self.chunks[begin:end]:
                some = chunk.begin, chunk.end, reduced, steps[chunk.block]
                kernel.follow(sights, bearings, *landmarks, *some, *moved)

        in_parallel(work, len(self.chunks), grain=1)
        self._has_moved = True

    def replace_strays(self, posture: Posture, *, halfway: bool) -> None:
        """The second half of `try_step`; `halfway`: all landmarks count as strays."""
        strays = Strays(
            measurements=self._measurements,
            landmark_row=self.landmark_row,
            origin_m=self.origin_m,
            begin=self._begin,
            loss=self.loss,
        )
        self.regained = strays.replace(
            posture.views,
            self._sights_at(posture.views),
            self.bearings(posture),
            self.reduced.cost,
            self._moved,
            self._moved_cost,
            all_of_them=halfway or self._refined,
        )

    def cost_at(self, posture: Posture) -> float:
        """True cost with landmarks at the linearisation point and cameras in another posture."""
        bearings, cost, loss = self.bearings(posture), np.empty(len(self.vector)), self.loss
        sights = self._sights_at(posture.views)

        def work(begin: int, end: int) -> None:
            which, vector = np.arange(begin, end), self.vector[begin:end]
            of_loss = loss.kind, loss.width
            kernel.landmark_costs(sights, bearings, which, vector, self.origin_m, *of_loss, cost[begin:end])

        in_parallel(work, len(cost), grain=_COST_GRAIN)
        return float(cost.sum())

    @cached_property
    def _begin(self) -> IntArray:
        """(landmarks + 1,) first observation of each landmark in the order of elimination, and n."""
        return self.sights.occurrence_begin[self.sights.landmark_begin]

    def _given(self, array: NDArray[_T]) -> NDArray[_T]:
        """Rows in the order in which landmarks were given."""
        out = np.empty_like(array)
        out[self.landmark_row] = array
        return out

    def adopt(self) -> None:
        """Take the landmarks of the last step tried as the next point of linearisation."""
        self.vector, self._moved = self._moved, self.vector

    @property
    def any_behind(self) -> bool:
        """Whether a landmark is behind one of its cameras after the last step; before any, as linearised."""
        cost = self._moved_cost if self._has_moved else self.reduced.cost
        return bool(cost.max() >= kernel.BEHIND_COST)

    @property
    def moved_cost(self) -> float:
        """Total cost of landmarks after the last step tried."""
        return float(self._moved_cost.sum())

    @property
    def linearised_cost(self) -> float:
        """Total cost of landmarks at the last linearisation."""
        return float(self.reduced.cost.sum())

    @property
    def gain_alone(self) -> float:
        """Decrease of the linearised cost by moving landmarks alone, with cameras held."""
        return 0.5 * float(np.sum(self.reduced.gamma**2))

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

    def landmark_covariance_m2(
        self, covariance: Covariance | None, *, only: BoolArray | None = None
    ) -> FloatArray:
        """Covariance (landmarks, 3, 3) of world points X / w, cameras marginalised, in the order given.

        It is V^-1 + V^-1 E' C E V^-1 at the last linearisation, with C the covariance of the variables of a
        landmark's cameras; None: cameras are exact. Infinite for landmarks at infinity, NaN for those that
        are not among `only` (landmarks,).
        """
        if self._rests:
            self.linearise(self._posture)
        out = np.full((len(self.landmark_row), 3, 3), np.nan)
        of_block: list[list[_Chunk]] = [[] for _ in self.blocks]
        asked = None if only is None else np.flatnonzero(only[self.landmark_row])
        for chunk in self.chunks:
            parts = [chunk]
            if asked is not None:
                among = asked[(asked >= chunk.begin) & (asked < chunk.end)].tolist()
                parts = [replace(chunk, begin=j, end=j + 1) for j in among]
            of_block[chunk.block] += parts

        def work(first: int, last: int) -> None:
            for block, chunks in zip(self.blocks[first:last], of_block[first:last], strict=True):
                if not chunks:
                    continue
                joint = block.joint(covariance)
                for chunk in chunks:
                    begin, end, more = chunk.begin, chunk.end, np.zeros((chunk.end - chunk.begin, 3, 3))
                    if self._fields is not None and covariance is not None:
                        arms_of = partial(self._dense_arms, chunk)
                        more = self._fields.spread(begin, end, block, covariance, arms_of)
                    kernel.point_covariances(
                        self.sights, self.reduced, self.vector, joint, more, begin, end, out
                    )

        in_parallel(work, len(self.blocks), grain=1)
        return self._given(out)

    def eliminated(
        self, landmark: int, covariance: Covariance
    ) -> tuple[Block, FloatArray, FloatArray, FloatArray]:
        """Of a landmark, by its row in the order given: block, W, L, and what fields add to L' C L (3, 3)."""
        j = int(np.flatnonzero(self.landmark_row == landmark)[0])
        chunk = next(chunk for chunk in self.chunks if chunk.begin <= j < chunk.end)
        one, block = replace(chunk, begin=j, end=j + 1), self.blocks[chunk.block]
        W, L, more = self._dense_arms(one), np.zeros((3, 3)), np.zeros((1, 3, 3))
        L[np.tril_indices(3)] = self.reduced.factor[j]
        if self._fields is not None:
            more = self._fields.spread(j, j + 1, block, covariance, lambda: W)
        return block, W[0], L, more[0]

    @property
    def undetermined(self) -> BoolArray:
        """(landmarks,) whether only the weak prior held it at the last linearisation, in the order given."""
        return self._given(self.reduced.undetermined)
