"""Symmetric block-sparse systems: order of elimination, square root, and entries of the inverse."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.lapack import lapack
from pancam_graph.base.scratch import Scratch

__all__ = ["Covariance", "FreeDirectionError", "Panels", "Pattern", "Root", "pattern"]

_RANK_TOLERANCE = 1e-12
"""A pivot counts as zero up to this share of its diagonal entry before elimination."""
_AT_ONCE = 4_000_000
"""Numbers of a system on disk that are in memory at a time: 32 MB."""
_ROUNDED = 1e-9
"""A pivot below this share may be off by a percent: rounding errors reach 5e-12 of that entry."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pattern:
    """Fill-in of the square root by blocks, in an order of elimination that keeps it small."""

    dim: IntArray
    """(groups,) number of columns of each group"""
    order: tuple[int, ...]
    """Groups in the order of elimination."""
    after: tuple[tuple[int, ...], ...]
    """For each group, the groups of the filled blocks in its rows: itself, then others in the order of
    elimination."""
    begin: tuple[IntArray, ...]
    """For each group the first column of each of these in its panel, and the number of columns."""


def pattern(
    dim: IntArray,
    cliques: Iterable[Iterable[int]],
    *,
    last: int | None = None,
    stage: IntArray | None = None,
) -> Pattern:
    """Order of elimination by minimum degree, counted in columns, and its fill-in.

    `cliques` are sets of groups that some factor joins; `last` is a group that is eliminated after all others
    whatever its degree. Groups of a later `stage` (groups,) are eliminated after those of earlier ones.
    """
    n = len(dim)
    stage = np.zeros(n, dtype=np.int64) if stage is None else stage.copy()
    if last is not None:
        stage[last] = stage.max() + 1
    near: list[set[int]] = [set() for _ in range(n)]
    for clique in {frozenset(c) for c in cliques}:
        for g in clique:
            near[g] |= clique
    degree = np.array([sum(int(dim[h]) for h in near[g] - {g}) for g in range(n)], dtype=np.int64)
    left = np.ones(n, dtype=bool)
    order: list[int] = []
    reach: list[set[int]] = [set() for _ in range(n)]
    for now in np.sort(stage).tolist():
        g = int(np.argmin(np.where(left & (stage == now), degree, np.iinfo(np.int64).max)))
        left[g] = False
        order.append(g)
        reach[g] = near[g] - {g}
        for h in reach[g]:
            near[h] = (near[h] | reach[g]) - {g}
            degree[h] = sum(int(dim[k]) for k in near[h] - {h})
    position = np.empty(n, dtype=np.int64)
    position[order] = np.arange(n)
    after = tuple((g, *sorted(reach[g], key=lambda h: int(position[h]))) for g in range(n))
    begin = tuple(np.concatenate([[0], np.cumsum(dim[list(a)])]) for a in after)
    return Pattern(dim=dim, order=tuple(order), after=after, begin=begin)


class FreeDirectionError(SolveError):
    """A direction is undetermined; its largest component is in column `column` of group `group`."""

    def __init__(self, group: int, column: int) -> None:
        super().__init__("nothing holds a direction of the solution")
        self.group, self.column = group, column


class Panels:
    """Upper half of a symmetric system (S, s): one dense panel per group, s as a last column."""

    def __init__(self, structure: Pattern, *, on_disk: bool = False) -> None:
        """0; `on_disk`: in a temporary file, for structures that memory has no room for (see `let_go`)."""
        self.structure = structure
        self.width = np.array([begin[-1] + 1 for begin in structure.begin], dtype=np.int64)
        """(groups,) columns of each panel"""
        self.begin = np.zeros(len(structure.dim) + 1, dtype=np.int64)
        """(groups + 1,) first of the numbers of each panel"""
        np.cumsum(structure.dim * self.width, out=self.begin[1:])
        self.scratch = Scratch([((int(self.begin[-1]),), np.float64)]) if on_disk else None
        """Where they are on disk; None: they are in memory."""
        self.numbers: FloatArray = (
            np.zeros(int(self.begin[-1])) if self.scratch is None else self.scratch.arrays[0]
        )
        """Of all panels, one after the other, row by row."""
        self.panel = self._views()
        self._place = [
            dict(zip(a, b, strict=False)) for a, b in zip(structure.after, structure.begin, strict=True)
        ]
        self._position = {g: i for i, g in enumerate(structure.order)}

    def blank(self) -> "Panels":
        """A system of the same structure that is 0."""
        twin = copy(self)
        if self.scratch is None:
            twin.numbers = np.zeros(len(self.numbers))
        else:
            twin.scratch = Scratch([(self.numbers.shape, np.float64)])
            twin.numbers = twin.scratch.arrays[0]
        twin.panel = twin._views()
        return twin

    def let_go(self) -> None:
        """Take panels that are on disk out of memory, until they are needed again."""
        if self.scratch is not None:
            self.scratch.let_go()

    def _views(self) -> list[FloatArray]:
        """The panel of each group, in `numbers`."""
        of_groups = zip(pairwise(self.begin.tolist()), self.width.tolist(), strict=True)
        return [self.numbers[first:last].reshape(-1, width) for (first, last), width in of_groups]

    def sorted(self, groups: Iterable[int]) -> list[int]:
        """Groups in the order of elimination."""
        return sorted(groups, key=self._position.__getitem__)

    def first_columns(self, g: int) -> IntArray:
        """First column (groups,) of each group in the panel of g; -1 for a group without a block there."""
        out = np.full(len(self.structure.dim), -1)
        out[list(self.structure.after[g])] = self.structure.begin[g][:-1]
        return out

    def add(self, groups: Sequence[int], S: FloatArray, s: FloatArray) -> None:
        """Add a dense system over groups in order of elimination; of S only the upper triangle is read."""
        begin = np.concatenate([[0], np.cumsum(self.structure.dim[list(groups)])])
        for i in range(len(groups)):
            self.add_rows(i, groups, begin, S, s)

    def add_rows(self, i: int, groups: Sequence[int], begin: IntArray, S: FloatArray, s: FloatArray) -> None:
        """Add the rows of groups[i]; `begin` (groups + 1,) are the columns of S where the groups begin."""
        panel, place = self.panel[groups[i]], self._place[groups[i]]
        rows = slice(begin[i], begin[i + 1])
        panel[:, -1] += s[rows]
        # Runs of groups that are adjacent in the panel too are added at once.
        j = i
        while j < len(groups):
            k, first = j + 1, place[groups[j]]
            while k < len(groups) and place[groups[k]] - first == begin[k] - begin[j]:
                k += 1
            width = begin[k] - begin[j]
            panel[:, first : first + width] += S[rows, begin[j] : begin[k]]
            j = k

    def add_block(self, g: int, rows: slice, h: int, columns: slice, block: FloatArray) -> None:
        """Add a dense block of S, at rows of group g and columns of group h, and its transpose."""
        if h not in self._place[g]:
            g, rows, h, columns, block = h, columns, g, rows, block.T
        first = self._place[g][h]
        self.panel[g][rows, first + columns.start : first + columns.stop] += block
        if g == h and rows != columns:
            self.panel[g][columns, rows] += block.T

    def add_right(self, g: int, rows: slice, right: FloatArray) -> None:
        """Add to s, at rows of group g."""
        self.panel[g][rows, -1] += right

    def copy(self) -> "Panels":
        """The same system in memory, or on disk, of its own."""
        twin = self.blank()
        for begin in range(0, len(self.numbers), _AT_ONCE):
            twin.numbers[begin : begin + _AT_ONCE] = self.numbers[begin : begin + _AT_ONCE]
            self.let_go()
            twin.let_go()
        return twin

    def hold(self, held: dict[int, IntArray]) -> None:
        """Decouple some columns of groups from all others, with information 1."""
        for g, columns in held.items():
            self.panel[g][columns] = 0.0
            for panel, place in zip(self.panel, self._place, strict=True):
                if g in place:
                    panel[:, place[g] + columns] = 0.0
            self.panel[g][columns, columns] = 1.0

    def diagonal(self) -> FloatArray:
        """Diagonal of S (columns,), group by group."""
        return np.concatenate([np.zeros(0), *(np.diag(panel) for panel in self.panel)])

    def right(self) -> FloatArray:
        """Right-hand side s (columns,), group by group."""
        return np.concatenate([np.zeros(0), *(panel[:, -1] for panel in self.panel)])

    def damp(self, share: float) -> None:
        """Add a share of the diagonal to the diagonal (Marquardt's damping)."""
        for panel in self.panel:
            diagonal = np.arange(len(panel))
            panel[diagonal, diagonal] *= 1 + share

    def times(self, x: FloatArray) -> FloatArray:
        """S x (columns, n) for x (columns, n), group by group."""
        st, out = self.structure, np.zeros_like(x)
        first = np.concatenate([[0], np.cumsum(st.dim)])
        for g, panel in enumerate(self.panel):
            n, begin, rows = int(st.dim[g]), st.begin[g], slice(first[g], first[g + 1])
            upper = np.triu(panel[:, :n])
            out[rows] += (upper + np.triu(upper, 1).T) @ x[rows]
            for h, a, b in zip(st.after[g][1:], begin[1:-1], begin[2:], strict=True):
                others = slice(first[h], first[h + 1])
                out[rows] += panel[:, a:b] @ x[others]
                out[others] += panel[:, a:b].T @ x[rows]
        return out

    def trace_with(self, covariance: "Covariance") -> float:
        """Trace of S times a covariance that has its blocks."""
        total = 0.0
        for g, panel in enumerate(self.panel):
            n, begin = int(self.structure.dim[g]), self.structure.begin[g]
            upper = np.triu(panel[:, :n])
            total += 2 * float(np.sum(np.triu(upper, 1) * covariance.block(g, g)))
            total += float(np.diag(upper) @ np.diag(covariance.block(g, g)))
            for h, first, last in zip(self.structure.after[g][1:], begin[1:-1], begin[2:], strict=True):
                total += 2 * float(np.sum(panel[:, first:last] * covariance.block(g, h)))
        return total

    def root(self) -> "Root":
        """Square root R'R = S with R'e = s, rows by group, which take the place of the panels.

        Rank-revealing: where S is singular, as the free gauge of position and orientation makes it with
        images alone, a group has fewer rows than columns.
        """
        st = self.structure
        rows: list[FloatArray] = [np.zeros((0, 0))] * len(st.dim)
        # Pivots are compared with the diagonal before elimination: one tiny beside it is rounding.
        summed = [panel.diagonal().copy() for panel in self.panel]
        self.let_go()
        least = 1.0
        for g in _in_turn(st, st.order, self.scratch):
            found, pivot = _root_of_panel(self.panel[g], summed[g])
            rows[g] = self.panel[g][: len(found)]
            rows[g][:] = found
            least = min(least, pivot)
            self._pass_on(g, rows[g])
        return Root(structure=st, rows=tuple(rows), least_pivot=least, scratch=self.scratch)

    def _pass_on(self, g: int, rows: FloatArray) -> None:
        st = self.structure
        n = int(st.dim[g])
        rest = rows[:, n:]
        if rest.shape[1] == 1 or len(rows) == 0:
            return
        update = rest.T @ rest
        np.negative(update, out=update)
        begin, after = st.begin[g] - n, st.after[g]
        for i in range(1, len(after)):
            self.add_rows(i, after, begin, update, update[:, -1])


def _in_turn(structure: Pattern, order: Iterable[int], scratch: Scratch | None) -> Iterator[int]:
    """Groups of an order; what is on disk of them leaves memory on the way, and at the end."""
    held = 0
    for g in order:
        yield g
        held += int(structure.dim[g] * structure.begin[g][-1])
        if scratch is not None and held > _AT_ONCE:
            scratch.let_go()
            held = 0
    if scratch is not None:
        scratch.let_go()


def _root_of_panel(panel: FloatArray, summed: FloatArray) -> tuple[FloatArray, float]:
    """Rows (rank, columns) of the square root of a panel whose own block comes first, and its least pivot.

    Pivoted Cholesky P'S P = U'U of the block, scaled by the diagonal (n,) as it was before other groups were
    eliminated: this balances radians and metres, and a pivot tiny beside that diagonal is rounding.
    """
    n, unit = len(summed), np.sqrt(np.maximum(summed, 0.0))
    scale = np.where(unit > 0, 1 / np.maximum(unit, 1e-150), 0.0)
    if not np.isfinite(panel).all():
        raise SolveError("the linearised system is not finite: a camera or a landmark has left the domain")
    scaled = panel[:, :n] * scale[:, None] * scale
    upper, pivot, rank, _ = lapack().dpstrf(scaled, tol=_RANK_TOLERANCE)
    pivot -= 1  # LAPACK counts from 1, and never rejects the first pivot
    if scaled.diagonal().max(initial=0.0) <= _RANK_TOLERANCE:
        rank = 0
    rows = np.zeros((rank, panel.shape[1]))
    if rank > 0:
        upper = np.where(_upper_triangle(n), upper, 0.0)[:rank]
        rows[:, pivot] = upper * unit[pivot]
        right = panel[pivot[:rank], n:] * scale[pivot[:rank], None]
        # U'^-1 right, transposed: BLAS gets columns in its own order, and no large copy is made.
        rows[:, n:] = lapack().dtrsm(1.0, upper[:, :rank], right.T, side=1, overwrite_b=1).T
    return rows, float(upper.diagonal()[:rank].min(initial=1.0)) ** 2


@lru_cache(maxsize=16)
def _upper_triangle(n: int) -> BoolArray:
    """(n, n) whether an entry is on the diagonal or above it: NumPy takes longer than a small system."""
    return np.triu(np.ones((n, n), dtype=bool))


@dataclass(frozen=True, kw_only=True, eq=False)
class Root:
    """Square root of a system, by group."""

    structure: Pattern
    rows: tuple[FloatArray, ...]
    """For each group (rank, columns of its panel + 1): R, and e as the last column."""
    least_pivot: float = 1.0
    """Smallest pivot, as a share of its diagonal entry before elimination; 1 where no digits were lost."""
    scratch: Scratch | None = None
    """Where rows are on disk; None: they are in memory."""

    @property
    def leaves_free(self) -> bool:
        """Whether a direction of some group is undetermined: fewer rows than columns."""
        return any(len(rows) < n for rows, n in zip(self.rows, self.structure.dim, strict=True))

    @property
    def is_rounded(self) -> bool:
        """Whether rounding errors of the normal equations may have a part in what holds some direction."""
        return self.leaves_free or self.least_pivot < _ROUNDED

    def _in_turn(self, order: Iterable[int]) -> Iterator[int]:
        return _in_turn(self.structure, order, self.scratch)

    def gain(self) -> float:
        """Decrease of the linearised cost by the step that solves the system: |e|^2 / 2."""
        return 0.5 * sum(float(rows[:, -1] @ rows[:, -1]) for rows in self.rows)

    def step(self, known: Mapping[int, FloatArray] | None = None) -> FloatArray:
        """The x (columns,) that solves S x = -s, by back substitution in R x = -e; group by group.

        Groups whose x is `known` keep it, and groups that were eliminated before them follow. Where a group
        has fewer rows than columns, its x is the minimum-norm solution given the later groups.
        """
        st = self.structure
        begin = np.concatenate([[0], np.cumsum(st.dim)])
        x = np.zeros(int(begin[-1]))
        for g in self._in_turn(reversed(st.order)):
            if known is not None and g in known:
                x[begin[g] : begin[g + 1]] = known[g]
                continue
            n, rows = int(st.dim[g]), self.rows[g]
            rest = np.concatenate([np.zeros(0), *(x[begin[h] : begin[h + 1]] for h in st.after[g][1:])])
            right = -rows[:, -1] - rows[:, n:-1] @ rest
            diagonal_rows = rows[:, :n]
            # Rows are in the order of their pivots, not of the columns.
            is_square = len(diagonal_rows) == n
            x[begin[g] : begin[g + 1]] = (
                np.linalg.solve(diagonal_rows, right)
                if is_square
                else np.linalg.lstsq(diagonal_rows, right)[0]
            )
        return x

    def forward(self, right: FloatArray) -> FloatArray:
        """The Y (columns, n) with R'Y = right (columns, n), by forward substitution; group by group.

        Y'Y is right' S^-1 right. Raises FreeDirectionError where R leaves a direction free.
        """
        st = self.structure
        begin = np.concatenate([[0], np.cumsum(st.dim)])
        y = np.array(right, dtype=float)
        for g in self._in_turn(st.order):
            n, rows = int(st.dim[g]), self.rows[g]
            if len(rows) < n:
                raise FreeDirectionError(g, _loosest(rows[:, :n]))
            of_group = slice(begin[g], begin[g + 1])
            touched = y[of_group].any(axis=0)
            if touched.any():
                some = slice(None) if touched.all() else np.flatnonzero(touched)
                solved = np.linalg.solve(rows[:, :n].T, y[of_group][:, some])
                y[of_group, some] = solved
                for h, a, b in zip(st.after[g][1:], st.begin[g][1:-1], st.begin[g][2:], strict=True):
                    y[begin[h] : begin[h + 1], some] -= rows[:, a:b].T @ solved
        return y

    def inverse_columns(self, g: int, columns: slice) -> FloatArray:
        """Columns (all columns, n) of the inverse of R'R that belong to some columns of group g.

        By forward and back substitution, so that blocks of any two groups are available. Raises
        FreeDirectionError where R leaves a direction free.
        """
        st = self.structure
        begin = np.concatenate([[0], np.cumsum(st.dim)])
        x = np.zeros((int(begin[-1]), columns.stop - columns.start))
        x[begin[g] + columns.start : begin[g] + columns.stop] = np.eye(x.shape[1])
        x = self.forward(x)
        for h in self._in_turn(reversed(st.order)):
            n, rows = int(st.dim[h]), self.rows[h]
            of_group = slice(begin[h], begin[h + 1])
            rest = np.concatenate([x[:0], *(x[begin[k] : begin[k + 1]] for k in st.after[h][1:])])
            x[of_group] = np.linalg.solve(rows[:, :n], x[of_group] - rows[:, n:-1] @ rest)
        return x

    def last_information(self) -> tuple[FloatArray, FloatArray]:
        """Information (n, n) of the group eliminated last, all others marginalised, and its gradient (n,).

        Raises FreeDirectionError where R leaves a direction free.
        """
        st = self.structure
        for g in st.order:
            n = int(st.dim[g])
            if len(self.rows[g]) < n:
                raise FreeDirectionError(g, _loosest(self.rows[g][:, :n]))
        rows = self.rows[st.order[-1]]
        return rows[:, :-1].T @ rows[:, :-1], rows[:, :-1].T @ rows[:, -1]

    def covariance(self) -> "Covariance":
        """The blocks of the inverse of R'R where R is filled.

        Groups are taken from the last to be eliminated back to the first. Each group's factor F, with FF' the
        covariance of itself and the groups after it, follows from its parent's by orthogonal
        transformations. The recursion for the covariances themselves (Takahashi, Fagan and Chen 1973) loses
        all digits along a chain of 80 stops. Raises FreeDirectionError where R leaves a direction free.
        """
        st = self.structure
        children = np.bincount([a[1] for a in st.after if len(a) > 1], minlength=len(st.dim))
        factors: dict[int, FloatArray] = {}
        blocks: dict[tuple[int, int], FloatArray] = {}
        store = None if self.scratch is None else Panels(st, on_disk=True)
        for g in self._in_turn(reversed(st.order)):
            n, rows, (_, *rest) = int(st.dim[g]), self.rows[g], st.after[g]
            if len(rows) < n:
                raise FreeDirectionError(g, _loosest(rows[:, :n]))
            half = np.linalg.inv(rows[:, :n])
            factor = np.zeros((int(st.begin[g][-1]),) * 2, order="F")
            if n:
                factor[:n, :n] = np.triu(lapack().dgerqf(half)[0])
            if rest:
                parent = rest[0]
                around = _factor_of_some(factors[parent], st.begin[parent], np.isin(st.after[parent], rest))
                factor[n:, n:] = around
                factor[:n, n:] = lapack().dtrmm(-1.0, around, half @ rows[:, n:-1], side=1)
                children[parent] -= 1
                if not children[parent]:
                    del factors[parent]
            if children[g]:
                factors[g] = factor
            own = lapack().dtrmm(1.0, factor, factor[:n], side=1, trans_a=1)
            if store is not None:
                kept = store.panel[g][:, :-1]
                kept[:] = own
                own = kept
            for h, first, last in zip(st.after[g], st.begin[g], st.begin[g][1:], strict=False):
                blocks[g, h] = own[:, first:last]
        return Covariance(blocks, None if store is None else store.scratch)


def _factor_of_some(factor: FloatArray, begin: IntArray, wanted: BoolArray) -> FloatArray:
    """Upper triangular factor of the covariance of some groups, from the factor of more.

    `factor` (n, n) is upper triangular; group i has rows `begin[i]` to `begin[i + 1]`; `wanted` says which
    groups stay. Rows above those of a group that leaves lose its columns by orthogonal transformations from
    the right (trapezoid to triangle); rows below have zeros there.
    """
    for i in np.flatnonzero(~wanted)[::-1]:
        first, last = begin[i], begin[i + 1]
        above = factor[:first, :last]
        kept = np.r_[:first, last : len(factor)]
        factor = np.asfortranarray(factor[:, kept][kept])
        if first > 0:
            triangle, _, _ = lapack().dtzrzf(above)
            factor[:first, :first] = np.triu(triangle[:, :first])
    return factor


def _loosest(rows: FloatArray) -> int:
    """The column with the largest component in the null space of rows (rank, n), rank below n."""
    unit = np.sqrt(np.sum(rows**2, axis=0))
    scaled = rows / np.where(unit > 0, unit, 1.0)
    _, _, turn = np.linalg.svd(scaled, full_matrices=True)
    free: FloatArray = turn[len(rows) :]
    return int(np.argmax(np.sum(free**2, axis=0)))


def _block(blocks: dict[tuple[int, int], FloatArray], g: int, h: int) -> FloatArray:
    return blocks[g, h] if (g, h) in blocks else blocks[h, g].T


class Covariance:
    """Blocks of the inverse of a system, for pairs of groups that a clique joins."""

    def __init__(self, blocks: dict[tuple[int, int], FloatArray], scratch: Scratch | None = None) -> None:
        """Blocks by pairs of groups; `scratch` is where they are on disk, None: they are in memory."""
        self._blocks, self._scratch = blocks, scratch
        self.let_go()

    def let_go(self) -> None:
        """Take blocks that are on disk out of memory, until they are needed again."""
        if self._scratch is not None:
            self._scratch.let_go()

    def release(self, held: dict[int, IntArray]) -> None:
        """Set the variance of columns that were held to 0."""
        for g, columns in held.items():
            for (a, b), block in self._blocks.items():
                if a == g:
                    block[columns] = 0.0
                if b == g:
                    block[:, columns] = 0.0

    def block(self, g: int, h: int) -> FloatArray:
        """Covariance (dim g, dim h) of two groups. Raises KeyError for two that no clique joins."""
        return _block(self._blocks, g, h)
