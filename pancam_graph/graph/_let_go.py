"""Telemetry and constraints that are believed less than their sigmas say."""

from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.data import Traverse

__all__ = ["LetGo"]


@dataclass(frozen=True, kw_only=True, eq=False)
class LetGo:
    """Sigmas of errors that telemetry is given beside those that it states; 0 where it is believed.

    An entry that telemetry holds (sigma 0) stays held.
    """

    angles_rad: FloatArray
    """(frames, 2) of single pans and tilts."""
    common_rad: FloatArray
    """(stops, 2) of one error that all pans, or all tilts, of a stop share."""
    stops: FloatArray
    """(stops, 6) of the mast's pose, in its tangent: rotation first, radians and metres."""
    constraints: BoolArray
    """(constraints,) whether each does not count."""

    @staticmethod
    def nothing(traverse: Traverse) -> "LetGo":
        """All telemetry is believed."""
        n_stops = len(traverse.stops)
        return LetGo(
            angles_rad=np.zeros((len(traverse.frames), 2)),
            common_rad=np.zeros((n_stops, 2)),
            stops=np.zeros((n_stops, 6)),
            constraints=np.zeros(len(traverse.constraints), dtype=bool),
        )

    def __bool__(self) -> bool:
        """Whether anything is let go."""
        some = self.angles_rad, self.common_rad, self.stops, self.constraints
        return any(bool(each.any()) for each in some)

    def __add__(self, other: "LetGo") -> "LetGo":
        """Both: of each entry the larger sigma."""
        return replace(
            self,
            angles_rad=np.maximum(self.angles_rad, other.angles_rad),
            common_rad=np.maximum(self.common_rad, other.common_rad),
            stops=np.maximum(self.stops, other.stops),
            constraints=self.constraints | other.constraints,
        )

    def angle_covariance(self, stop: int, sigmas: FloatArray, angles_rad: FloatArray) -> FloatArray | None:
        """Covariance (2 n, 2 n) of the pans and tilts of n frames of a stop; None without a common error.

        `sigmas` (n, 2) are the stated ones, 0 where held; `angles_rad` (n, 2) are the rows of these frames. A
        held entry has the variance 1 by itself: it does not move.
        """
        if not self.common_rad[stop].any():
            return None
        free = sigmas > 0
        variance = np.where(free, sigmas**2 + angles_rad**2, 1.0)
        covariance = np.diag(variance.ravel())
        for k in (0, 1):
            rows = 2 * np.flatnonzero(free[:, k]) + k
            covariance[np.ix_(rows, rows)] += self.common_rad[stop, k] ** 2
        return covariance

    def widened(self, sigmas: FloatArray, extra: FloatArray) -> FloatArray:
        """Stated sigmas with extra ones beside them; 0 stays 0."""
        return np.where(sigmas > 0, np.hypot(sigmas, extra), 0.0)
