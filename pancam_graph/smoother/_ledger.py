"""All observations that a smoother was given, and the present use of each."""

from enum import IntEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import Observations

__all__ = ["Fate", "Ledger", "left_out"]


class Fate(IntEnum):
    """Present use of an observation."""

    WAITING = 0
    """Its track has one observation so far; a single ray determines no landmark."""
    USED = 1
    """It takes part in the adjustment."""
    OUTLIER = 2
    """It contradicts the other observations of its track."""
    OUTSIDE = 3
    """Outside the domain of its camera model."""
    CLOSURE = 4
    """Part of a loop closure that was rejected."""
    REMOVED = 5
    """Taken back by the caller."""
    CHANCE = 6
    """It fits, but among so many outliers chance alone explains that."""


_LEFT_OUT = (Fate.OUTLIER, Fate.CLOSURE, Fate.CHANCE)

_COLUMNS: dict[str, tuple[tuple[int, ...], type]] = {
    "image": ((), np.int64),
    "track": ((), np.int64),
    "uv_px": ((2,), np.float64),
    "sigma_px": ((), np.float64),
    "covariance_px2": ((2, 2), np.float64),
    "whitening": ((2, 2), np.float64),
    "fate": ((), np.int8),
}


class Ledger:
    """A table of observations that grows by rows; the number of a row never changes."""

    def __init__(self) -> None:
        self._n = 0
        self._column: dict[str, NDArray[Any]] = {
            name: np.zeros((1024, *shape), dtype) for name, (shape, dtype) in _COLUMNS.items()
        }
        self.has_covariances = False
        self._origin: Literal["given", "images"] = "given"

    def __len__(self) -> int:
        """Number of observations."""
        return self._n

    def append(
        self,
        image: IntArray,
        observations: Observations,
        valid: BoolArray,
    ) -> IntArray:
        """Append observations of images (n,), rows of the drive's images; return their rows (n,).

        `valid` (n,) says whether they are in the domain of their camera. One that was removed takes its old
        row: an image sees a track once.
        """
        rows = self._find_among(self.all_with(Fate.REMOVED), image, observations.track)
        is_new = rows < 0
        n, new = int(is_new.sum()), np.zeros(0)
        rows[is_new] = np.arange(self._n, self._n + n)
        for name, column in self._column.items():
            if len(column) < self._n + n:
                new = np.zeros((max(2 * len(column), self._n + n), *column.shape[1:]), column.dtype)
                new[: self._n] = column[: self._n]
                self._column[name] = new
        self._n += n
        covariance = observations.covariance_px2
        self.has_covariances |= covariance is not None
        if observations.origin == "images":
            self._origin = "images"
        if covariance is None:
            covariance = np.square(observations.sigma_px)[:, None, None] * np.eye(2)
        fate = np.where(valid, int(Fate.WAITING), int(Fate.OUTSIDE))
        of = observations
        for name, part in zip(
            _COLUMNS,
            (image, of.track, of.uv_px, of.sigma_px, covariance, of.noise.whitening, fate),
            strict=True,
        ):
            self._column[name][rows] = part
        return rows

    def _all(self, name: str) -> NDArray[Any]:
        return self._column[name][: self._n]

    @property
    def image(self) -> IntArray:
        """(n,) row among the drive's images."""
        return self._all("image")

    @property
    def track(self) -> IntArray:
        """(n,) track number of each observation."""
        return self._all("track")

    @property
    def uv_px(self) -> FloatArray:
        """(n, 2) pixels as measured."""
        return self._all("uv_px")

    @property
    def whitening(self) -> FloatArray:
        """(n, 2, 2) takes a residual in pixels to one of unit covariance."""
        return self._all("whitening")

    @property
    def fate(self) -> NDArray[np.int8]:
        """(n,) values of `Fate`, as a writable view."""
        return self._all("fate")

    @property
    def observations(self) -> Observations:
        """All observations as given; `image` counts the images of the whole drive."""
        covariance = self._all("covariance_px2").copy() if self.has_covariances else None
        return Observations(
            image=self.image.copy(),
            track=self.track.copy(),
            uv_px=self.uv_px.copy(),
            sigma_px=self._all("sigma_px").copy(),
            covariance_px2=covariance,
            origin=self._origin,
        )

    def find(self, image: IntArray, track: IntArray) -> IntArray:
        """Rows (n,) of observations of tracks (n,) in images (n,); -1 for one that is not in the ledger."""
        return self._find_among(np.flatnonzero(self.fate != int(Fate.REMOVED)), image, track)

    def _find_among(self, there: IntArray, image: IntArray, track: IntArray) -> IntArray:
        """The same among some rows only."""
        if not len(there):
            return np.full(len(track), -1)
        known, wanted = _pairs(self.image[there], self.track[there]), _pairs(image, track)
        order = np.argsort(known, kind="stable")
        at = order[np.searchsorted(known[order], wanted).clip(max=len(order) - 1)]
        rows: IntArray = np.where(known[at] == wanted, there[at], -1)
        return rows

    def with_fate(self, rows: IntArray, fate: Fate) -> IntArray:
        """Those of the rows that have this fate."""
        with_it: IntArray = rows[self.fate[rows] == int(fate)]
        return with_it

    def all_with(self, fate: Fate) -> IntArray:
        """All rows that have this fate."""
        return np.flatnonzero(self.fate == int(fate))

    def take_over(self, fate: IntArray) -> None:
        """Set all fates (n,) to kept ones. Raises InputError for a use outside a camera's domain."""
        wrong = np.flatnonzero((self.fate == int(Fate.OUTSIDE)) & (fate == int(Fate.USED)))
        if len(wrong):
            raise InputError(
                f"fate, row {wrong[0]}: expected no use of a pixel outside the camera's domain, found one"
            )
        self.fate[:] = fate

    def set_fate(self, rows: IntArray, fate: Fate) -> None:
        """Set the fate of some rows."""
        self.fate[rows] = int(fate)


def left_out(fate: NDArray[np.int8]) -> BoolArray:
    """(n,) whether each was judged and left out, alone or with its loop closure."""
    return np.isin(fate, [int(one) for one in _LEFT_OUT])


def _pairs(image: IntArray, track: IntArray) -> IntArray:
    """One number (n,) for each pair of an image and a track."""
    return np.asarray(track * (1 << 24) + image)
