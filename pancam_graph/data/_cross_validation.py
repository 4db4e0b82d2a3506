"""Results of cross-validation: formal standard deviations beside those that halves of the tracks show."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray

__all__ = ["CrossValidation", "HalfScore", "Sigmas", "Splitting", "Spread"]

Splitting = Literal["random", "upper_lower"]
"""Ways of halving the tracks: "random" by lot, "upper_lower" by the half of the image in which they lie."""

_LEAST_SHARE = 1e-6
"""Least relative change of a variance when half of the tracks is dropped, for images to count as its
source."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Spread:
    """Spread of n quantities with k components over one way of halving; NaN where no halving determines it.

    A half determines nothing about a frame that it does not see or cuts off from its neighbours.
    """

    difference: FloatArray
    """(n, k) difference between the solutions of the two halves; RMS over the halvings."""
    ratio: FloatArray
    """(n, k) step from the whole solution to a half's over its expected standard deviation, RMS over halves
    and halvings; about 1 if noise is the only error. NaN where telemetry alone determines the quantity."""
    sigma: FloatArray
    """(n, k) standard deviation of the whole solution, with the part that is due to images scaled by
    `ratio`."""

    @property
    def overall(self) -> float:
        """RMS of `ratio` over all quantities; NaN where none is known."""
        known = self.ratio[~np.isnan(self.ratio)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else np.nan

    def part(self, rows: slice, shape: tuple[int, int]) -> "Spread":
        """The spread of a range of components of one long vector, reshaped to (n, k)."""
        return Spread(
            difference=self.difference[rows].reshape(shape),
            ratio=self.ratio[rows].reshape(shape),
            sigma=self.sigma[rows].reshape(shape),
        )

    @staticmethod
    def of(formal: FloatArray, step: FloatArray, half_variance: FloatArray) -> "Spread":
        """Spread from formal sigmas (...), and steps and variances (m, 2, ...) of the halves of m halvings.

        A step leads from the whole solution to the half's. Steps and variances are NaN where a half
        determines nothing. The estimate from all observations is efficient, so the variance of the step is
        the half's variance less the whole's, whatever priors both share: Hausman, Specification tests in
        econometrics, 1978, lemma 2.1. If images decide and both halves are equally strong, this difference
        equals the variance of the whole; the mean squared step over random halves then estimates it without
        knowledge of the noise: McCarthy, Pseudo-replication: half samples, 1969.
        """
        step_variance = half_variance - formal**2
        told: BoolArray = np.all(np.isfinite(step), axis=1)
        decided: BoolArray = told & np.all(step_variance > _LEAST_SHARE * formal**2, axis=1)
        squares = np.where(decided[:, None], step**2 / np.where(step_variance > 0, step_variance, 1.0), 0.0)
        count = np.count_nonzero(decided, axis=0)
        mean_square = squares.sum(axis=(0, 1)) / np.where(count > 0, 2 * count, np.nan)
        # If images decide, the geometric mean is the variance of the whole for halves of unequal weight too.
        geometric = np.sqrt(np.where(decided[:, None], step_variance, 0.0).prod(axis=1)).sum(axis=0)
        images_part = np.minimum(geometric / count.clip(1), formal**2)
        variance = formal**2 + np.where(count > 0, images_part * (np.nan_to_num(mean_square) - 1), 0.0)
        times = np.count_nonzero(told, axis=0)
        known = np.any(told & np.all(np.isfinite(step_variance), axis=1), axis=0)
        apart = np.where(told, np.nan_to_num(step[:, 1] - step[:, 0]) ** 2, 0.0).sum(axis=0)
        return Spread(
            difference=np.sqrt(apart / np.where(times > 0, times, np.nan)),
            ratio=np.sqrt(mean_square),
            sigma=np.where(known, np.sqrt(variance.clip(0.0)), np.nan),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Sigmas:
    """Standard deviations of n quantities with k components: formal, and by halves of the tracks."""

    formal: FloatArray
    """(n, k) formal sigma of the whole solution, landmarks marginalised; 0 if held, NaN if a direction is
    free."""
    random: Spread
    """Spread over halves drawn by lot: shows noise that is larger than its sigma, or not Gaussian."""
    upper_lower: Spread
    """Spread over tracks of upper and lower image halves: shows errors of the camera model too."""

    @property
    def honest(self) -> FloatArray:
        """(n, k) largest of the three sigmas; NaN where no half determines the quantity."""
        told = np.fmax(self.random.sigma, self.upper_lower.sigma)
        return np.asarray(np.where(np.isnan(told), np.nan, np.fmax(told, self.formal)))

    @property
    def ratio(self) -> FloatArray:
        """(n, k) honest over formal sigma, 1 or above; NaN where held or unknown."""
        return np.asarray(self.honest / np.where(self.formal > 0, self.formal, np.nan))


@dataclass(frozen=True, kw_only=True)
class HalfScore:
    """Residuals of the tracks of one half, with its own cameras and with those of the other half."""

    splitting: Splitting
    halving: int
    """Number of the halving, from 0."""
    half: Literal["first", "second", "upper", "lower"]
    tracks: int
    """Tracks of this half."""
    scored: int
    """Tracks whose frames the other half sees and connects; only these are scored."""
    observations: int
    """Observations of the scored tracks."""
    own_px: float
    """RMS residual of the scored tracks with the cameras of the half's own solution, pixels per
    observation."""
    own_expected_px: float
    """Value of `own_px` that noise alone would cause; exact if all observations have one sigma."""
    other_px: float
    """RMS residual of the scored tracks, triangulated with the other half's cameras held."""
    other_expected_px: float
    """Value of `other_px` that noise and the other half's formal covariance would cause."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CrossValidation:
    """Honest sigmas beside formal ones, and residuals of each half under the other half's cameras."""

    halvings: int
    """Number of halvings by lot."""
    seed: int
    pointing: Sigmas
    """(frames, 2) pan and tilt of each frame, radians; determined by telemetry and images together."""
    pairs: IntArray
    """(pairs, 2) rows of frames of one stop that share tracks: the spanning tree of each connected group of
    frames whose pairs have the most tracks in common."""
    pair_tracks: IntArray
    """(pairs,) number of tracks that both frames see."""
    relative_pointing: Sigmas
    """(pairs, 2) pan and tilt of the second frame less those of the first, radians; images determine
    these."""
    stops: Sigmas
    """(stops, 6) mast poses in the body frame: rotation (radians), then translation (metres)."""
    scores: tuple[HalfScore, ...]
    warnings: tuple[str, ...]
    seconds: float
    """Wall-clock time."""

    def score_px(self, splitting: Splitting) -> tuple[float, float]:
        """RMS residual under the other half's cameras, and the value that noise alone would cause, pixels.

        Over all halves of a splitting, with equal weight for every observation; NaN if none was scored.
        """
        scores = [s for s in self.scores if s.splitting == splitting and s.observations > 0]
        n = np.array([s.observations for s in scores])
        squares = np.array([[s.other_px, s.other_expected_px] for s in scores]).reshape(-1, 2) ** 2
        if not len(n):
            return np.nan, np.nan
        measured, expected = np.sqrt(n @ squares / n.sum())
        return float(measured), float(expected)
