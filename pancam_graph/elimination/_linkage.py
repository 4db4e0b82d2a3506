"""Dependence of camera poses on the variables of a graph, as a factor template states it."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.landmarks import CameraViews

__all__ = ["FieldColumns", "Linkage", "Posture"]


@dataclass(frozen=True, kw_only=True, eq=False)
class FieldColumns:
    """The columns of smooth distortion fields: adjoining ones of one group."""

    group: int
    first: int
    """First of them among the columns of the group"""
    n: int
    """Their number."""
    image_column: IntArray
    """(images,) first column of each image's field among them"""

    @property
    def columns(self) -> slice:
        """The columns among those of the group."""
        return slice(self.first, self.first + self.n)


@dataclass(frozen=True, kw_only=True, eq=False)
class Linkage:
    """Structure of the chain rule from variables to cameras; it stays the same from step to step.

    A *unit* is a set of images that every variable moves in the same way: the eyes of a frame on a rigid
    head, or one image. A unit depends on variables by *segments*: a segment is some columns of one variable,
    and a small matrix that takes these columns to the pose of the unit (and to its calibration). Variables of
    one *group* (a stop) are eliminated together.
    """

    key: tuple[int, ...]
    """Keys of the variables."""
    dim: IntArray
    """(variables,) tangent dimensions"""
    group: IntArray
    """(variables,) group of each, ascending"""
    image_unit: IntArray
    """(images,) unit of each"""
    segment_begin: IntArray
    """(units + 1,) first segment of each unit"""
    segment_variable: IntArray
    """(segments,) variable of each"""
    segment_column: IntArray
    """(segments,) first column of the variable"""
    segment_width: IntArray
    """(segments,) number of columns"""
    segment_plain: BoolArray
    """(segments,) whether the tangent of the variable is the twist of the base of the unit itself: the
    segment has 6 columns, and its matrix is the identity at all values"""
    fields: FieldColumns | None = None
    """Columns of variables that are the coefficients of fields, in no segment; None: there are none"""

    @property
    def n_groups(self) -> int:
        """Number of groups."""
        return int(self.group[-1]) + 1 if len(self.group) else 0

    @cached_property
    def group_begin(self) -> IntArray:
        """(groups + 1,) first variable of each group."""
        return np.searchsorted(self.group, np.arange(self.n_groups + 1))

    @cached_property
    def variable_column(self) -> IntArray:
        """(variables,) first column of each among the columns of its group."""
        before = np.concatenate([[0], np.cumsum(self.dim)])[:-1]
        return np.asarray(before - before[self.group_begin[:-1]][self.group])

    @cached_property
    def group_dim(self) -> IntArray:
        """(groups,) columns of each group."""
        return np.bincount(self.group, self.dim, minlength=self.n_groups).astype(np.int64)

    @cached_property
    def group_column(self) -> IntArray:
        """(groups + 1,) first column of each group among all columns."""
        return np.concatenate([[0], np.cumsum(self.group_dim)])

    @cached_property
    def row(self) -> dict[int, int]:
        """Index of the variable of each key."""
        return {key: i for i, key in enumerate(self.key)}

    @cached_property
    def place(self) -> dict[int, tuple[int, slice]]:
        """By key, the group of a variable and its columns among those of the group."""
        entries = zip(
            self.key, self.group.tolist(), self.variable_column.tolist(), self.dim.tolist(), strict=True
        )
        return {key: (group, slice(begin, begin + dim)) for key, group, begin, dim in entries}

    def columns_of(self, key: int) -> slice:
        """Columns of a variable among those of its group."""
        return self.place[key][1]

    def by_group(self, components: Iterable[tuple[int, IntArray]]) -> dict[int, IntArray]:
        """By group, the columns of components (n,) of variables, by key; only groups with any."""
        out: dict[int, IntArray] = {}
        for key, indices in components:
            if len(indices):
                g = int(self.group[self.row[key]])
                columns = self.columns_of(key).start + indices
                out[g] = np.concatenate([out.get(g, np.zeros(0, dtype=np.int64)), columns])
        return out

    @cached_property
    def touched(self) -> BoolArray:
        """(variables,) whether any image depends on it."""
        out = np.zeros(len(self.dim), dtype=bool)
        out[self.segment_variable] = True
        return out

    @cached_property
    def unit_groups(self) -> tuple[tuple[int, ...], ...]:
        """Groups of the variables of each unit."""
        of_segment, begin = self.group[self.segment_variable].tolist(), self.segment_begin.tolist()
        of_field = set() if self.fields is None else {self.fields.group}
        # Many units have the same groups: only what differs is sorted.
        known = dict[tuple[int, ...], tuple[int, ...]]()
        out = list[tuple[int, ...]]()
        for first, last in pairwise(begin):
            of_unit = tuple(of_segment[first:last])
            if of_unit not in known:
                known[of_unit] = tuple(sorted(of_field.union(of_unit)))
            out.append(known[of_unit])
        return tuple(out)


@dataclass(frozen=True, kw_only=True, eq=False)
class Posture:
    """Cameras at some values of the variables, and their derivatives by these."""

    views: CameraViews
    unit_R: FloatArray
    """(units, 3, 3) world_R_base of the body whose twist (its frame, rotation first) moves a unit's images"""
    unit_t: FloatArray
    """(units, 3) world_t_base of that body, metres"""
    chain: FloatArray
    """(segments, 6 or 11, widest) takes a segment's columns to that twist, and to changes of fx, fy, skew, cx
    and cy where calibrations are free; columns beyond a segment's width are 0"""
