"""Displacement of image windows by phase correlation, to hundredths of a pixel."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray

__all__ = ["WINDOW_PX", "Displacements", "displacements"]

WINDOW_PX = 64
"""Side of a window."""

_HIGHEST_FREQUENCY = 0.25
"""Highest frequency used, cycles per pixel: above it optics and lossy compression leave mostly noise."""
_STEPS = 5
_TURNS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Displacements:
    """Displacements of n windows of one image against the same windows of another."""

    shift_px: FloatArray
    """(n, 2) by which the second image's texture is displaced, right and down."""
    sigma_px: FloatArray
    """(n,) formal standard deviation of the shift in its less certain direction; large without texture."""
    coherence: FloatArray
    """(n,) 1 where the windows differ by a shift only, near 0 where they have nothing in common."""


def displacements(first: NDArray[Any], second: NDArray[Any]) -> Displacements:
    """Displacements of windows (n, 64, 64) of a second image against the same of a first.

    The integer part is the peak of the normalised cross-power spectrum (Kuglin and Hines 1975); the rest a
    weighted least-squares fit of a plane to the spectrum's phase (Stone, Orchard, Chang and Martucci, A
    fast direct Fourier-based algorithm for subpixel registration of images, 2001). OpenCV's own phase
    correlation takes a centroid about the peak, whose scatter on rover images, 0.17 px, is as large as what
    is to be measured here.
    """
    side = WINDOW_PX
    f = np.fft.fftfreq(side)
    low = np.hypot(f[:, None], f) <= _HIGHEST_FREQUENCY
    low[0, 0] = False
    omega = 2 * np.pi * np.column_stack([np.tile(f, (side, 1))[low], np.tile(f[:, None], (1, side))[low]])

    shift: FloatArray = np.zeros((len(first), 2))
    for turn in range(_TURNS):
        # The tapers move with the texture: tapers that stand still would make it seem to move less.
        cross = np.conj(_spectrum(first, -0.5 * shift)) * _spectrum(second, 0.5 * shift)
        if turn == 0:
            shift = _peak(np.where(low, cross, 0.0))
        cross = cross[:, low]
        weight = np.abs(cross)
        total = np.maximum(weight.sum(axis=1), 1e-30)
        normal = np.einsum("nk,ki,kj->nij", weight, omega, omega) / total[:, None, None]
        normal += 1e-12 * np.eye(2)
        for _ in range(_STEPS):
            phase = np.angle(cross * np.exp(1j * (shift @ omega.T)))
            slope = np.einsum("nk,nk,ki->ni", weight, phase, omega) / total[:, None]
            step = np.linalg.solve(normal, slope[..., None])
            shift = shift - np.clip(step[..., 0], -1.0, 1.0)
    left = cross * np.exp(1j * (shift @ omega.T))
    coherence = np.abs(left.sum(axis=1)) / total
    # The variance of a phase is taken to be the inverse of its weight. Half of the frequencies mirror the
    # other half, and the taper correlates neighbours: about one in four is independent.
    scatter = np.einsum("nk,nk->n", weight, np.angle(left) ** 2) / total
    variance = (scatter / (np.count_nonzero(low) / 4))[:, None, None] * np.linalg.inv(normal)
    return Displacements(
        shift_px=shift,
        sigma_px=np.sqrt(np.maximum(np.linalg.eigvalsh(variance)[:, -1], 0.0)),
        coherence=coherence,
    )


def _spectrum(windows: NDArray[Any], shift_px: FloatArray) -> NDArray[np.complex128]:
    """Spectra (n, 64, 64) of windows less their means, under tapers moved by shifts (n, 2)."""
    middle, half = 0.5 * (WINDOW_PX - 1), 0.5 * (WINDOW_PX + 1)
    away = np.arange(WINDOW_PX) - middle - np.clip(shift_px, -0.5 * half, 0.5 * half)[..., None]
    hann = np.where(np.abs(away) < half, np.cos(0.5 * np.pi * away / half) ** 2, 0.0)
    taper = hann[:, 1, :, None] * hann[:, 0, None, :]
    grey = np.asarray(windows, dtype=np.float64)
    mean = np.einsum("nij,nij->n", grey, taper) / taper.sum(axis=(1, 2))
    return np.asarray(np.fft.fft2((grey - mean[:, None, None]) * taper))


def _peak(cross: NDArray[np.complex128]) -> FloatArray:
    """Whole shifts (n, 2) at which the normalised cross-power spectra (n, 64, 64) correlate best."""
    side = WINDOW_PX
    unit = cross / np.maximum(np.abs(cross), 1e-30)
    peak = np.argmax(np.fft.ifft2(unit).real.reshape(len(cross), -1), axis=1)
    whole = np.column_stack([peak % side, peak // side]).astype(np.float64)
    return (whole + side / 2) % side - side / 2
