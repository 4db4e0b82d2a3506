"""Landmarks cut into blocks, and the columns of variables that each block touches."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.elimination._linkage import Linkage
from pancam_graph.elimination._panels import Covariance, Panels
from pancam_graph.landmarks import Measurements

__all__ = ["Block", "Layout", "blocks_of"]

_NOWHERE = int(np.iinfo(np.int32).min)
"""First column of a group that a block does not touch: columns of its segments are then negative."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """Landmarks first seen from one stop, and the groups that these touch.

    Its columns are those on which some segment depends, group by group. Each segment has an even number of
    columns, since the kernel takes them in pairs: an odd segment gets one more, which belongs to no variable.
    """

    groups: tuple[int, ...]
    """Groups in the order of elimination."""
    begin: IntArray
    """(groups + 1,) first column of each in the block"""
    segment: IntArray
    """(n,) segments of the units that see its landmarks"""
    segment_column: IntArray
    """(n,) first column in the block of each of these"""
    row: IntArray
    """(columns,) place of each column of the block among those of its group; -1: it belongs to no variable"""
    group: IntArray
    """(groups,) `groups` as an array"""
    panel_column: IntArray
    """(groups, columns) place of each column of the block in the panel of each of the groups; -1: none"""
    source: IntArray
    """(columns,) place of each column of the block among all columns; -1: it belongs to no variable"""
    n_units: int

    @staticmethod
    def of(
        link: Linkage, layout: "Layout", panels: Panels, groups: tuple[int, ...], units: IntArray
    ) -> "Block":
        """The columns of a block that touches these groups, and is seen by some of these units.

        How many see it is not counted yet.
        """
        group = np.array(groups, dtype=np.int64)
        width = layout.group_width[group]
        begin = np.zeros(len(groups) + 1, dtype=np.int64)
        np.cumsum(width, out=begin[1:])
        shift = np.full(link.n_groups, _NOWHERE)
        shift[group] = begin[:-1]
        row = np.concatenate([np.zeros(0, dtype=np.int64), *(layout.row[g] for g in groups)])
        begins, counts = link.segment_begin[units], np.diff(link.segment_begin)[units]
        before = np.cumsum(counts) - counts
        segment = np.repeat(begins - before, counts) + np.arange(int(counts.sum()))
        of, is_nobodys = group.repeat(width), row < 0
        # Where each group begins in the panel of each; -1 where it is not there.
        starts = np.array([panels.first_columns(g) for g in groups], dtype=np.int64)
        first = starts.reshape(len(groups), link.n_groups)[:, of]
        return Block(
            groups=groups,
            group=group,
            begin=begin,
            segment=segment,
            segment_column=shift[layout.segment_group[segment]] + layout.segment_column[segment],
            row=row,
            panel_column=np.where(is_nobodys | (first < 0), -1, first + row),
            source=np.where(is_nobodys, -1, link.group_column[of] + row),
            n_units=0,
        )

    def joint(self, covariance: Covariance | None) -> FloatArray:
        """Covariance (columns, columns) of the columns of the block; 0 where a column belongs to no variable.

        None: all is exact, so that it is 0.
        """
        out = np.zeros((len(self.row), len(self.row)))
        if covariance is None:
            return out
        filled = [np.flatnonzero(self.row[a:b] >= 0) for a, b in pairwise(self.begin)]
        of_group = [self.row[a + f] for a, f in zip(self.begin, filled, strict=False)]
        for i, g in enumerate(self.groups):
            for j, h in enumerate(self.groups[: i + 1]):
                part = covariance.block(g, h).take(of_group[i], axis=0).take(of_group[j], axis=1)
                rows, columns = self.begin[i] + filled[i], self.begin[j] + filled[j]
                out[rows[:, None], columns] = part
                out[columns[:, None], rows] = part.T
        return out


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Columns that segments touch, group by group; the number of columns of each segment is made even."""

    group_width: IntArray
    """(groups,) number of columns of each group"""
    segment_group: IntArray
    """(segments,) group of each"""
    segment_column: IntArray
    """(segments,) first column of each in its group"""
    row: tuple[IntArray, ...]
    """For each group, the place of each of these columns among all of the group; -1: it belongs to no
    variable"""

    @staticmethod
    def of(linkage: Linkage) -> "Layout":
        """Segments that touch the same columns share them."""
        of = linkage.segment_variable
        group, start = linkage.group[of], linkage.variable_column[of] + linkage.segment_column
        begin = linkage.group_column
        _, one, which = np.unique(begin[group] + start, return_index=True, return_inverse=True)
        width = linkage.segment_width[one]
        even = width + width % 2
        place = np.cumsum(even) - even
        group_width = np.bincount(group[one], even, minlength=linkage.n_groups).astype(np.int64)
        group_begin = np.concatenate([[0], np.cumsum(group_width)])
        step = np.arange(int(width.sum())) - np.repeat(np.cumsum(width) - width, width)
        row = np.full(int(group_begin[-1]), -1)
        row[np.repeat(place, width) + step] = np.repeat(start[one], width) + step
        return Layout(
            group_width=group_width,
            segment_group=group,
            segment_column=place[which] - group_begin[group],
            row=tuple(row[a:b] for a, b in pairwise(group_begin)),
        )


def blocks_of(
    linkage: Linkage, m: Measurements
) -> tuple[IntArray, dict[int, tuple[int, ...]], dict[int, IntArray]]:
    """Block of each landmark, named by the first group that sees it; by block its groups, and its units."""
    groups = linkage.unit_groups
    # Landmarks of constant cameras form a block that depends on no group.
    nobody = linkage.n_groups
    unit_first = np.array([g[0] if g else nobody for g in groups])
    unit = linkage.image_unit[m.image]
    first = np.minimum.reduceat(unit_first[unit], m.starts)
    seen = np.zeros((nobody + 1, len(groups)), dtype=bool)
    seen[first[m.landmark], unit] = True
    units = {int(b): np.flatnonzero(seen[b]) for b in np.flatnonzero(seen.any(axis=1))}
    reach = {b: tuple(sorted(set().union(*{groups[u] for u in some}))) for b, some in units.items()}
    return first, reach, units
