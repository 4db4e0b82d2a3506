"""How the errors of a rig's numbers hang together, as a calibration with images leaves them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from pancam_graph.base.choices import expected_one_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import FIELD_SHAPE

__all__ = ["ASPECT", "FOCAL", "POSE_ENTRIES", "RIG_ENTRIES", "RigCovariance", "RigEntry"]

FOCAL = "focal"
ASPECT = "aspect"
POSE_ENTRIES = ("rx_rad", "ry_rad", "rz_rad", "x_m", "y_m", "z_m")
"""A rotation vector and a shift in the pose's own frame (geometry.corrected_poses)."""
FIELD_ENTRIES = tuple(
    f"{axis}{row}{column}_px" for axis, row, column in product("uv", *map(range, FIELD_SHAPE[1:]))
)
"""Coefficients of a smooth field (cameras.Fields) in their order: those of u, then v, row by row."""

RIG_ENTRIES: Mapping[str, tuple[str, ...]] = {
    "calibration": (FOCAL, ASPECT, "skew_px", "cx_px", "cy_px"),
    "mounts": POSE_ENTRIES,
    "pan_T_tilt": POSE_ENTRIES,
    "field": FIELD_ENTRIES,
}
"""Names of the numbers of a rig by quantity: calibration, mount and field of each eye, and the tilt axis."""

_ASYMMETRY = 1e-9
"""Largest difference of two entries that mirror each other, as a share of their variances' geometric mean."""
_LEAST_EIGENVALUE = 1e-13
"""Least eigenvalue of the correlations: below, rounding decides whether the matrix is positive definite."""


class RigEntry(NamedTuple):
    """One number of a rig, as `RIG_ENTRIES` has it."""

    quantity: str
    """One of `RIG_ENTRIES`."""
    camera: str | None
    """Name of its eye; None for the tilt axis."""
    entry: str
    """Name of the number, with its unit; factors are shares."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RigCovariance:
    """The joint covariance of the errors of some numbers of a rig about the values that the rig states.

    Raises InputError for entries that no rig has or that stand twice, and for a matrix of another size, with
    numbers that are not finite, that is not symmetric or not positive definite.
    """

    entries: tuple[RigEntry, ...]
    matrix: FloatArray
    """(n, n) in the order of the entries and in their units."""
    pictures: tuple[str, ...] = ()
    """Digests of the pictures that the rig was calibrated with: a traverse that has one of them would count
    it twice."""

    def __post_init__(self) -> None:
        """Check entries and matrix."""
        object.__setattr__(self, "entries", tuple(RigEntry(*entry) for entry in self.entries))
        object.__setattr__(self, "pictures", tuple(self.pictures))
        matrix = np.array(self.matrix, dtype=float)
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)
        for i, entry in enumerate(self.entries):
            _check_entry(f"covariance: entries[{i}]", entry)
            if entry in self.entries[:i]:
                raise InputError(
                    f"covariance: entries[{i}]: expected different entries, found {_name(entry)} twice"
                )
        _check_matrix(self.entries, matrix)

    def sigma(self, entry: RigEntry) -> float | None:
        """Standard deviation of an entry; None where the covariance does not name it."""
        if entry not in self.entries:
            return None
        i = self.entries.index(entry)
        return float(np.sqrt(self.matrix[i, i]))

    def among(self, entries: Sequence[RigEntry], sigma: FloatArray) -> FloatArray:
        """Covariance (n, n) of some entries; one that is not named is independent, with its `sigma` (n,)."""
        place = [self.entries.index(entry) if entry in self.entries else -1 for entry in entries]
        named = np.flatnonzero(np.array(place, dtype=np.int64) >= 0)
        rows = [place[i] for i in named]
        out = np.diag(np.asarray(sigma, dtype=float) ** 2)
        out[np.ix_(named, named)] = self.matrix[np.ix_(rows, rows)]
        return out


def _name(entry: RigEntry) -> str:
    return " ".join(part for part in entry if part is not None)


def _check_entry(where: str, entry: RigEntry) -> None:
    if entry.quantity not in RIG_ENTRIES:
        raise InputError(f"{where}: {expected_one_of('quantity', entry.quantity, tuple(RIG_ENTRIES))}")
    known = RIG_ENTRIES[entry.quantity]
    if entry.entry not in known:
        raise InputError(f"{where}: {expected_one_of('entry', entry.entry, known)}")
    if (entry.camera is None) != (entry.quantity == "pan_T_tilt"):
        expected = "no camera, as all have one tilt axis" if entry.camera else "the name of a camera"
        raise InputError(f"{where}: camera: expected {expected}; found {entry.camera or 'none'}")


def _check_matrix(entries: Sequence[RigEntry], matrix: FloatArray) -> None:
    n = len(entries)
    where = "covariance: matrix"
    if matrix.shape != (n, n):
        shape = " x ".join(str(m) for m in matrix.shape)
        raise InputError(f"{where}: expected {n} x {n} numbers, one row an entry; found {shape}")
    if n == 0:
        return
    if not np.isfinite(matrix).all():
        raise InputError(f"{where}: expected finite numbers, found others")
    variance = np.diag(matrix)
    if not (variance > np.finfo(float).tiny).all():
        i = int(np.argmin(variance))
        raise InputError(
            f"{where}: expected variances above 0, found {variance[i]:g} of {_name(entries[i])}; an entry "
            "that is exact is not named"
        )
    size = np.sqrt(variance)
    correlation = matrix / size[:, None] / size
    asymmetry = np.abs(correlation - correlation.T)
    if asymmetry.max() > _ASYMMETRY:
        i, j = (int(k) for k in np.unravel_index(int(asymmetry.argmax()), (n, n)))
        raise InputError(
            f"{where}: expected a symmetric matrix, found {matrix[i, j]:.6g} and {matrix[j, i]:.6g} for "
            f"{_name(entries[i])} with {_name(entries[j])}"
        )
    if not np.isfinite(correlation).all():
        raise InputError(f"{where}: expected correlations that are finite, found numbers too large")
    least = float(np.linalg.eigvalsh(correlation)[0])
    if least < _LEAST_EIGENVALUE:
        raise InputError(
            f"{where}: expected a positive definite matrix, found correlations whose least eigenvalue is "
            f"{least:.2g}"
        )
