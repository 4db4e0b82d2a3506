"""The distortions of cameras for compiled loops: their numbers in a table, and one function for all."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pancam_graph.base.compiled import uncounted
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.cameras._camera import Camera
from pancam_graph.cameras._field_camera import without_field
from pancam_graph.cameras._lens import Distorted
from pancam_graph.cameras._lenses import LENSES, lens_of
from pancam_graph.cameras._sensors import SENSORS, SURFACE_HEAD

__all__ = ["LENS_SOURCES", "LensTable", "distort"]

LENS_SOURCES = Path(__file__).parent
"""Folder whose sources compiled loops depend on where they call `distort`."""

_KINDS = [lens.name for lens in LENSES]
_WIDTH = max(SURFACE_HEAD, *(lens.distortion.length for lens in LENSES if lens.distortion is not None))
"""Least columns of a table: as many as the lens with most parameters has."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LensTable:
    """The distortions of the cameras of n images."""

    row: IntArray
    """(n,) row of the table of each image; -1: the camera has no distortion."""
    kind: IntArray
    """(lenses,) which model each is: its place in `LENSES`, or behind these in `SENSORS`."""
    parameters: FloatArray
    """(lenses, width) its numbers, 0 where it has fewer."""

    @staticmethod
    def of(cameras: Sequence[Camera], image_camera: IntArray) -> "LensTable":
        """The table of images that each of some cameras took, by the camera's index (n,).

        Their smooth fields are not in it (`fields_of`). Raises CameraError for a camera whose class is not
        among `LENSES`.
        """
        row, kind, parameters = np.full(len(cameras), -1), list[int](), list[FloatArray]()
        for i, camera in enumerate(map(without_field, cameras)):
            lens = lens_of(camera)
            if lens.distortion is not None:
                row[i] = len(kind)
                kind.append(_KINDS.index(lens.name))
                numbers = np.asarray(lens.distortion.parameters(camera), dtype=float)
                parameters.append(np.pad(numbers, (0, _WIDTH - len(numbers))))
        return LensTable(
            row=row[image_camera],
            kind=np.array(kind, dtype=np.int64),
            parameters=np.array(parameters).reshape(-1, _WIDTH),
        )

    @staticmethod
    def without(n: int) -> "LensTable":
        """The table of n images without distortion."""
        return LensTable(
            row=np.full(n, -1), kind=np.zeros(0, dtype=np.int64), parameters=np.zeros((0, _WIDTH))
        )

    @staticmethod
    def of_sensors(kind: IntArray, table: IntArray, tables: Sequence[FloatArray]) -> "LensTable":
        """The table of sensors of some kinds (n,), each its place in `SENSORS`.

        `table` (n,) is the place in `tables` of the numbers (rows, columns) that a sensor reads, which
        several may share; -1: it has none.
        """
        n = len(kind)
        plain = LensTable(row=np.arange(n), kind=len(LENSES) + kind, parameters=np.zeros((n, _WIDTH)))
        if not tables:
            return plain
        parameters = _stacked([plain.parameters, *tables])
        begin = np.cumsum([n, *(len(one) for one in tables)])
        row = np.where(table < 0, plain.row, begin[table])
        kinds = np.full(len(parameters), -1, dtype=np.int64)  # rows that no sensor begins with are of no kind
        kinds[row] = plain.kind
        return LensTable(row=row, kind=kinds, parameters=parameters)

    @staticmethod
    def joined(tables: "Sequence[LensTable]") -> "LensTable":
        """The table of the images of several tables, one after the other."""
        begin = np.cumsum([0, *(len(t.kind) for t in tables)])
        rows = [np.where(t.row < 0, -1, t.row + b) for t, b in zip(tables, begin, strict=False)]
        return LensTable(
            row=np.concatenate(rows),
            kind=np.concatenate([t.kind for t in tables]),
            parameters=_stacked([t.parameters for t in tables]),
        )


def _stacked(tables: Sequence[FloatArray]) -> FloatArray:
    """Tables (rows, columns) one below the other, 0 where one has fewer columns."""
    if len({one.shape[1] for one in tables}) == 1:
        return np.concatenate(tables)
    out = np.zeros((sum(map(len, tables)), max(one.shape[1] for one in tables)))
    begin = 0
    for one in tables:
        out[begin : begin + len(one), : one.shape[1]] = one
        begin += len(one)
    return out


_Distort = Callable[[int, FloatArray, int, float, float, float, float], Distorted]
_DistortOne = Callable[[FloatArray, int, float, float, float, float], Distorted]


@uncounted.part
def _none(kind: int, p: FloatArray, row: int, d0: float, d1: float, d2: float, w: float) -> Distorted:
    """Nothing is in the domain of a lens that there is not."""
    return False, (d0, d1, d2), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0)


def _first_or(number: int, own: _DistortOne, otherwise: _Distort) -> _Distort:
    """A function that calls one distortion where `kind` is its number, and another one elsewhere."""

    @uncounted.merged
    def either(kind: int, p: FloatArray, row: int, d0: float, d1: float, d2: float, w: float) -> Distorted:
        if kind == number:
            return own(p, row, d0, d1, d2, w)
        return otherwise(kind, p, row, d0, d1, d2, w)

    return either


def _any_of_lenses() -> _Distort:
    """One function for all lenses and sensors; compiled loops cannot look functions up in a table."""
    out: _Distort = _none
    for number, sensor in reversed(list(enumerate(SENSORS, start=len(LENSES)))):
        out = _first_or(number, sensor, out)
    for number, lens in reversed(list(enumerate(LENSES))):
        if lens.distortion is not None:
            out = _first_or(number, lens.distortion.distort, out)
    return out


distort = _any_of_lenses()
"""The distortion of any lens or sensor, for compiled loops: takes kind, parameters and row of a `LensTable`,
then d and w as `Distortion.distort` does."""
