"""Formal standard deviations, and beside them what halves of the observations say of them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray

__all__ = ["CrossValidation", "HalfScore", "Sigmas", "Splitting", "Spread"]

Splitting = Literal["random", "upper_lower"]
"""How tracks are halved: by lot, or by the half of the images that they lie in."""

_LEAST_SHARE = 1e-6
"""Where dropping half of the tracks changes the variance by a smaller share, telemetry alone decides."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Spread:
    """What one way of halving says of n quantities with k components; NaN where no halving tells.

    A half tells nothing of a frame that it does not see, or that it cuts off from its neighbours.
    """

    difference: FloatArray
    """(n, k) between the solutions of the two halves; RMS over the halvings"""
    ratio: FloatArray
    """(n, k) RMS over halves and halvings of the step from the whole solution to the half's, divided by the
    standard deviation that this step should have; 1 if noise is all there is. NaN where telemetry decides"""
    sigma: FloatArray
    """(n, k) standard deviation of the whole solution, the images' part of it multiplied by `ratio`"""

    @property
    def overall(self) -> float:
        """RMS of `ratio` over all quantities; NaN where none is known."""
        known = self.ratio[~np.isnan(self.ratio)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else np.nan

    def part(self, rows: slice, shape: tuple[int, int]) -> "Spread":
        """Some rows of a spread of vectors, in another shape."""
        return Spread(
            difference=self.difference[rows].reshape(shape),
            ratio=self.ratio[rows].reshape(shape),
            sigma=self.sigma[rows].reshape(shape),
        )

    @staticmethod
    def of(formal: FloatArray, step: FloatArray, half_variance: FloatArray) -> "Spread":
        """From formal sigmas (...), and of m halvings steps and variances of halves (m, 2, ...).

        Steps lead from the whole solution to the half's; both are NaN where a half tells nothing. An
        estimate from all observations is efficient, so the step from it to one from a part of them has the
        variance of the part's less that of the whole, whatever priors both share: Hausman, Specification
        tests in econometrics, 1978, lemma 2.1. If images decide and halves are alike, that is the variance
        of the whole, and the mean squared step over random halves estimates it without knowing the noise:
        McCarthy, Pseudo-replication: half samples, 1969.
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
    """Standard deviations of n quantities with k components: formal, and what halves say."""

    formal: FloatArray
    """(n, k) of the whole solution, landmarks marginalised; 0 where held, NaN where a direction is free"""
    random: Spread
    """From halves of the tracks drawn by lot: sees noise that is larger than its sigma, or not Gaussian"""
    upper_lower: Spread
    """From the tracks in the upper and in the lower halves of images: sees errors of the camera model too"""

    @property
    def honest(self) -> FloatArray:
        """(n, k) the largest of the three; NaN where no half tells anything."""
        told = np.fmax(self.random.sigma, self.upper_lower.sigma)
        return np.asarray(np.where(np.isnan(told), np.nan, np.fmax(told, self.formal)))

    @property
    def ratio(self) -> FloatArray:
        """(n, k) honest over formal, 1 or above; NaN where held or unknown."""
        return np.asarray(self.honest / np.where(self.formal > 0, self.formal, np.nan))


@dataclass(frozen=True, kw_only=True)
class HalfScore:
    """Tracks of one half, placed with its own cameras and with those of the other half."""

    splitting: Splitting
    halving: int
    """Number of the halving, from 0."""
    half: Literal["first", "second", "upper", "lower"]
    tracks: int
    """Tracks of this half."""
    scored: int
    """Tracks that are scored: the other half sees all their frames, and joins them."""
    observations: int
    """Observations of the scored tracks."""
    own_px: float
    """RMS residual of the scored tracks with cameras of the half's own solution, pixels per observation."""
    own_expected_px: float
    """What noise alone would make it; exact where all observations have one sigma."""
    other_px: float
    """RMS residual of the scored tracks, triangulated with the other half's cameras held."""
    other_expected_px: float
    """What noise alone would make it, the other half's formal covariance included."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CrossValidation:
    """Honest sigmas beside the formal ones, and how each half's cameras fit the other half's tracks."""

    halvings: int
    """How often tracks were halved by lot."""
    seed: int
    pointing: Sigmas
    """(frames, 2) pan and tilt of each frame, radians; telemetry has its part in these"""
    pairs: IntArray
    """(pairs, 2) rows of frames of one stop that share tracks: a tree over each group of frames, made of the
    pairs with the most tracks in common"""
    pair_tracks: IntArray
    """(pairs,) how many tracks both see"""
    relative_pointing: Sigmas
    """(pairs, 2) pan and tilt of the second less those of the first, radians: what images determine"""
    stops: Sigmas
    """(stops, 6) mast poses, rotation first (rad, then m), in the body frame"""
    scores: tuple[HalfScore, ...]
    warnings: tuple[str, ...]
    seconds: float
    """Wall-clock time."""

    def score_px(self, splitting: Splitting) -> tuple[float, float]:
        """RMS of tracks scored with the other half's cameras, and what noise alone would make it, pixels.

        Over all halves of a splitting, each observation counting alike; NaN where none was scored.
        """
        scores = [s for s in self.scores if s.splitting == splitting and s.observations > 0]
        n = np.array([s.observations for s in scores])
        squares = np.array([[s.other_px, s.other_expected_px] for s in scores]).reshape(-1, 2) ** 2
        if not len(n):
            return np.nan, np.nan
        found, expected = np.sqrt(n @ squares / n.sum())
        return float(found), float(expected)
