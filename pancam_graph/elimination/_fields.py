"""The columns of smooth distortion fields in a system whose landmarks are eliminated.

An observation touches 32 coefficients of its camera's field, by weights that never change. These columns are
in no block: they are dense, the same for all blocks, and belong to one group.
"""

from collections.abc import Callable

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.cameras import FIELD_SHAPE, Fields
from pancam_graph.elimination._blocks import Block
from pancam_graph.elimination._linkage import FieldColumns
from pancam_graph.elimination._panels import Covariance, Panels
from pancam_graph.landmarks import CameraViews, kernel

__all__ = ["FieldPart", "FieldSystem"]

FieldPart = tuple[FloatArray, FloatArray, FloatArray]
"""What some landmarks add to (S, s): S between the columns of their block and those of fields, half of S
among fields, and s of fields; as `kernel.eliminate_fields` writes them."""


class FieldSystem:
    """The observations of a landmark system as their fields see them, in the order of elimination."""

    def __init__(self, columns: FieldColumns, image: IntArray, uv_px: FloatArray, begin: IntArray) -> None:
        """Images (n,), pixels (n, 2) as measured, and the first observation of each landmark, with n."""
        self.columns = columns
        self._image, self._uv_px, self._begin = image, uv_px, begin
        self._basis: tuple[IntArray, FloatArray] | None = None
        self._sights: kernel.FieldSights | None = None
        self._pixels: tuple[CameraViews, FloatArray] | None = None
        self._linearised: FloatArray = uv_px

    def pixels(self, views: CameraViews) -> FloatArray:
        """Pixels (n, 2) as they would be without the fields of these cameras."""
        if self._pixels is None or self._pixels[0] is not views:
            assert views.fields is not None  # the linkage has columns for them
            at = views.fields.weighted(self._image, *self._basis_of(views.fields))
            self._pixels = views, np.ascontiguousarray(self._uv_px - at)
        return self._pixels[1]

    def linearise_at(self, views: CameraViews) -> kernel.FieldSights:
        """Where observations lie in their fields; the fields of these cameras are those of linearisation."""
        self._linearised = self.pixels(views)
        if self._sights is None:
            assert views.fields is not None
            first, weight = self._basis_of(views.fields)
            _, rows, per_row = FIELD_SHAPE
            self._sights = kernel.FieldSights(
                first=self.columns.image_column[self._image] + first @ np.array([per_row, 1]),
                weight=np.ascontiguousarray(weight),
                per_row=per_row,
                per_axis=rows * per_row,
                arms=np.zeros((len(self._image), 2, 3)),
            )
        return self._sights

    def _basis_of(self, fields: Fields) -> tuple[IntArray, FloatArray]:
        if self._basis is None:
            self._basis = fields.basis(self._image, self._uv_px)
        return self._basis

    def room(self, block: Block) -> FieldPart:
        """Zeros for what landmarks of a block add."""
        n = self.columns.n
        return np.zeros((len(block.row), n)), np.zeros((n, n)), np.zeros(n)

    def add(self, part: FieldPart, block: Block, panels: Panels) -> None:
        """Add what landmarks of a block tell to the panels."""
        across, own, right = part
        g, columns = self.columns.group, self.columns.columns
        for i, h in enumerate(block.groups):
            rows = slice(int(block.begin[i]), int(block.begin[i + 1]))
            place = block.row[rows]
            of_group = np.zeros((int(panels.structure.dim[h]), len(right)))
            of_group[place[place >= 0]] = across[rows][place >= 0]
            panels.add_block(h, slice(0, len(of_group)), g, columns, of_group)
        panels.add_block(g, columns, g, columns, own + own.T)
        panels.add_right(g, columns, right)

    def following(self, gamma: FloatArray, views: CameraViews) -> FloatArray:
        """L^-1 g (landmarks, 3) after a step of the fields alone, from where they were linearised."""
        assert self._sights is not None  # steps follow a linearisation
        step = self._linearised - self.pixels(views)
        moved = np.einsum("icm,ic->im", self._sights.arms, step)
        return np.asarray(gamma + np.add.reduceat(moved, self._begin[:-1], axis=0))

    def spread(
        self,
        first: int,
        last: int,
        block: Block,
        covariance: Covariance,
        arms_of: Callable[[], FloatArray],
    ) -> FloatArray:
        """What the uncertainty of fields adds to L' C L of landmarks first to last: (landmarks, 3, 3).

        C is a landmark's covariance in its tangent space. `arms_of` gives W (landmarks, 3, columns of the
        block).
        """
        assert self._sights is not None
        a, b = int(self._begin[first]), int(self._begin[last])
        of = np.repeat(np.arange(last - first), np.diff(self._begin[first : last + 1]))
        Y = np.zeros((last - first, self.columns.n, 3))
        per_row, per_axis = self._sights.per_row, self._sights.per_axis
        four = np.arange(4)
        for c in range(2):
            column = self._sights.first[a:b, None, None] + c * per_axis + per_row * four[:, None] + four
            told = self._sights.weight[a:b, :, :, None] * self._sights.arms[a:b, c, None, None, :]
            np.add.at(Y, (of[:, None, None], column), told)
        g, columns = self.columns.group, self.columns.columns
        own = covariance.block(g, g)[columns, columns]
        across = np.zeros((len(block.row), self.columns.n))
        for i, h in enumerate(block.groups):
            rows = slice(int(block.begin[i]), int(block.begin[i + 1]))
            place = block.row[rows]
            of_group = covariance.block(h, g)[:, columns]
            across[rows][place >= 0] = of_group[place[place >= 0]]
        mixed = (arms_of() @ across) @ Y
        return np.asarray(np.swapaxes(Y, 1, 2) @ (own @ Y) + mixed + np.swapaxes(mixed, 1, 2))
