"""The noise of observed pixels: one sigma for both coordinates, or a covariance.

Residuals are weighted by the inverse covariance (thesis eq. 3.3, 3.30 to 3.34): with C = L L' (Cholesky),
L^-1 r has unit covariance, and its square is r' C^-1 r.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray

__all__ = ["PixelNoise", "mean_sigma_px"]

_MOST_UNEVEN = 1e5
"""Largest ratio of standard deviations of a traverse; beyond about a million, steps lose their direction."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelNoise:
    """Noise of n observations."""

    sigma_px: FloatArray
    """(n,) standard deviation of each coordinate; with covariances, `mean_sigma_px` of them"""
    covariance_px2: FloatArray | None
    """(n, 2, 2) symmetric and positive definite; None: sigma_px^2 I"""

    def select(self, rows: BoolArray | IntArray) -> "PixelNoise":
        """The noise of some observations, by mask or index."""
        covariance = self.covariance_px2
        return PixelNoise(
            sigma_px=self.sigma_px[rows], covariance_px2=None if covariance is None else covariance[rows]
        )

    def scaled(self, factor: float) -> "PixelNoise":
        """Every standard deviation multiplied by a factor."""
        covariance = self.covariance_px2
        return PixelNoise(
            sigma_px=self.sigma_px * factor,
            covariance_px2=None if covariance is None else covariance * factor**2,
        )

    def widened(self, sigma_px: FloatArray) -> "PixelNoise":
        """With independent noise of standard deviations (n,) added, the same in all directions."""
        sigma = np.hypot(self.sigma_px, sigma_px)
        if self.covariance_px2 is None:
            return replace(self, sigma_px=sigma)
        added = np.square(sigma_px)[:, None, None] * np.eye(2)
        return PixelNoise(sigma_px=sigma, covariance_px2=self.covariance_px2 + added)

    @property
    def whitening(self) -> FloatArray:
        """L^-1 (n, 2, 2): takes residuals in pixels to unit covariance."""
        return self.whiten(np.broadcast_to(np.eye(2), (len(self.sigma_px), 2, 2)))

    def whiten(self, pixels: FloatArray) -> FloatArray:
        """L^-1 times vectors (n, 2) or matrices (n, 2, k) in pixels: of unit covariance."""
        if self.covariance_px2 is None:
            return np.asarray(pixels / self._each(self.sigma_px, pixels))
        a, b, c = (self._each(entry, pixels[:, 0]) for entry in self._root)
        first = pixels[:, 0] / a
        return np.stack([first, (pixels[:, 1] - b * first) / c], axis=1)

    def to_pixels(self, whitened: FloatArray) -> FloatArray:
        """L times vectors (n, 2) or matrices (n, 2, k); inverse of `whiten`."""
        if self.covariance_px2 is None:
            return np.asarray(whitened * self._each(self.sigma_px, whitened))
        a, b, c = (self._each(entry, whitened[:, 0]) for entry in self._root)
        return np.stack([a * whitened[:, 0], b * whitened[:, 0] + c * whitened[:, 1]], axis=1)

    @property
    def axes_px(self) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (n,) along the short and the long axis of each error ellipse."""
        if self.covariance_px2 is None:
            return self.sigma_px, self.sigma_px
        variance = np.linalg.eigvalsh(self.covariance_px2)
        # The short one from the determinant, which keeps its digits where the ellipse is long.
        a, _, c = self._root
        long = np.sqrt(variance[:, 1])
        return a * c / long, long

    def require_even(self) -> None:
        """Raise InputError where some observations are so much surer than others that weights lose digits."""
        short, long = self.axes_px
        if len(short) and long.max() > _MOST_UNEVEN * short.min():
            raise InputError(
                f"observations: sigma_px: expected standard deviations within a factor of {_MOST_UNEVEN:.0e} "
                f"of each other, which 64 bits weigh together, found {short.min():.3g} (row "
                f"{int(np.argmin(short))}) and {long.max():.3g} (row {int(np.argmax(long))}); leave out what "
                "was not measured, and state no sigma that pixels cannot have"
            )

    @cached_property
    def _root(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """L's entries (n,): first, below it, last."""
        assert self.covariance_px2 is not None
        first = np.sqrt(self.covariance_px2[:, 0, 0])
        below = self.covariance_px2[:, 1, 0] / first
        return first, below, np.sqrt(self.covariance_px2[:, 1, 1] - below**2)

    @staticmethod
    def _each(entry: FloatArray, like: FloatArray) -> FloatArray:
        """A number (n,) for each observation, with as many axes as the array it meets."""
        return entry.reshape(-1, *[1] * (like.ndim - 1))


def mean_sigma_px(covariance_px2: FloatArray) -> FloatArray:
    """Root of the mean variance (n,) over all directions of covariances (n, 2, 2); 0 for a negative one."""
    mean = covariance_px2[:, 0, 0] / 2 + covariance_px2[:, 1, 1] / 2
    return np.asarray(np.sqrt(np.maximum(mean, 0.0)))
