"""Noise scale of squared residuals of which most may be outliers: maximum likelihood of a scale mixture."""

from functools import cache

import numpy as np
import scipy

from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = ["LEAST_SHARE", "noise_scale"]

LEAST_SHARE = 0.1
"""Smallest share of the residuals that must be noise; outliers may be all others."""
_BINS = 4
"""Bins of residuals in each factor of two."""
_SCALES = 16
"""Candidate scales in each factor of two."""
_OCTAVES = 16
"""Factors of two from the smallest candidate to the largest residual."""
_OUTLIERS = 2
"""Scales of outliers in each factor of two; the same for all candidates, or these could not be compared."""
_APART = 28
"""Steps of a candidate from the noise scale to the narrowest outliers: a factor of 3.4."""
_EM_ROUNDS = 60
_RELAXED = 1.7
"""Power of the multiplicative update of the proportions: above 1 it converges faster, from 2 on not."""


def noise_scale(test: FloatArray, freedom: IntArray) -> float:
    """Scale s of the noise in squared residuals `test` (n,), each a sum of `freedom` (n,) squares: 0 to 2.

    The residuals are modelled as a mixture: noise of scale s, at least `LEAST_SHARE` of all, and outliers of
    many scales from 3.4 s up, in any proportions. Their joint likelihood has its maximum at the
    result. Residuals without freedom do not count; 0 where no residual is above 0.
    """
    positive = (freedom > 0) & (test > 0)
    if not positive.any():
        return 0.0
    residual, freedom = np.sqrt(test[positive]), freedom[positive]
    # The first bin holds whatever is smaller; the upper edge of the last is the largest residual.
    largest, n_bins = float(residual.max()), _BINS * _OCTAVES + 1
    place = np.ceil(_BINS * np.log2(residual / largest)).astype(np.int64) + n_bins - 1
    place = place.clip(0, n_bins - 1)
    counts = np.array([np.bincount(place[freedom == k], minlength=n_bins) for k in (1, 2)], dtype=float)
    filled = np.flatnonzero(counts.any(axis=0))
    counts, table = counts[:, filled], _probabilities()[:, :, filled]
    last = table.shape[1] - 1
    coarse = np.arange(0, last + 1, _SCALES // 2)
    best = int(coarse[np.argmax(_likelihood(counts, table, coarse))])
    # Between coarse candidates the narrowest outliers may fit the noise better than the noise does: try both.
    near = np.arange(-_SCALES // 2, _SCALES // 2 + 1)
    fine = np.unique(np.concatenate([best + near, best + _APART + near]).clip(0, last))
    likelihood = _likelihood(counts, table, fine)
    k = int(np.argmax(likelihood))
    step = float(fine[k])
    if 0 < k < len(fine) - 1 and fine[k + 1] - fine[k - 1] == 2:  # the vertex of a parabola
        a, b, c = likelihood[k - 1 : k + 2]
        curvature = a - 2 * b + c
        step += 0.5 * (a - c) / curvature if curvature < 0 else 0.0
    return float(largest * 2.0 ** ((step - last) / _SCALES))


@cache
def _probabilities() -> FloatArray:
    """Probability (2, scales, bins) of each bin, for residuals with one freedom and with two, and each scale.

    Scales and upper edges of bins are powers of two of the largest residual, the last of each being 1.
    """
    edge = 2.0 ** (np.arange(-_BINS * _OCTAVES, 1) / _BINS)
    scale = 2.0 ** (np.arange(-_SCALES * _OCTAVES, 1) / _SCALES)
    below = [scipy.special.gammainc(k / 2, (edge / scale[:, None]) ** 2 / 2) for k in (1, 2)]
    return np.array([np.diff(share, axis=1, prepend=0.0) for share in below])


def _likelihood(counts: FloatArray, table: FloatArray, candidates: IntArray) -> FloatArray:
    """Log-likelihood (candidates,) of binned residuals for candidate noise scales, as rows of `table`.

    Residuals with one freedom and with two have proportions of their own: a wrong track has no freedom that a
    right one has. `counts` (2, bins) and `table` (2, scales, bins) are of one freedom, then two.
    """
    noise_part = table[:, candidates]  # (2, candidates, bins)
    wide = np.arange(0, table.shape[1], _SCALES // _OUTLIERS)
    outlier_parts = table[:, wide]  # (2, scales of outliers, bins)
    allowed = wide >= np.minimum(candidates[:, None] + _APART, wide[-1])
    n = counts.sum(axis=1)
    share = (counts / np.maximum(n, 1.0)[:, None])[:, None]
    noise = np.full((2, len(candidates), 1), 0.5)
    outliers = np.broadcast_to(0.5 * allowed / allowed.sum(axis=1, keepdims=True), (2, *allowed.shape))
    for _ in range(_EM_ROUNDS):
        ratio = share / np.maximum(noise * noise_part + outliers @ outlier_parts, 1e-60)
        noise = noise * (noise_part * ratio).sum(axis=2, keepdims=True) ** _RELAXED
        outliers = outliers * (ratio @ outlier_parts.transpose(0, 2, 1)) ** _RELAXED
        total = np.maximum(noise + outliers.sum(axis=2, keepdims=True), 1e-300)
        noise = np.maximum(noise / total, 1e-9)
        whole = n @ noise[..., 0] / n.sum()
        noise = np.minimum(noise * np.maximum(LEAST_SHARE / whole, 1.0)[:, None], 1.0)
        outliers = (1 - noise) * outliers / np.maximum(outliers.sum(axis=2, keepdims=True), 1e-300)
    density = np.maximum(noise * noise_part + outliers @ outlier_parts, 1e-60)
    return np.asarray(np.einsum("kcb,kb->c", np.log(density), counts))
