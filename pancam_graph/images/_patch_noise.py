"""The noise of positions that patches give: along the epipolar line and across it."""

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray

__all__ = ["patch_covariance_px2", "pulled_back", "shared_by_tracks", "unlike_covariance_px2"]

_PER_DIFFERENCE = 0.38**2
"""Variance of a position across its epipolar line, over that of `align_patches`: how few of a patch's 169
pixels differ independently of each other."""
_ALONG_ONE_POINTING, _ALONG = 1.0, 0.3
"""What relief within a patch adds along the epipolar line, over the variance that the patch alone gives: in
the eyes of one pointing, and where images of two pointings also sample the terrain differently."""
_OF_FIRST = 0.3
"""Share of the variance that is the first patch's own: the others of its track have it in common."""
_ALIKE = 0.6
"""Correlation of a point's errors in the images of one other frame, which see its patch from one side."""
_UNLIKE_PX = 1.2
"""Standard deviation along the epipolar line of features around which the patches look unlike."""
_LEAST_PX2 = 1e-5


def patch_covariance_px2(fit_px2: FloatArray, along: FloatArray, *, one_pointing: bool) -> FloatArray:
    """Covariances (n, 2, 2) of positions by least-squares matching.

    `fit_px2` (n, 3) are the entries uu, uv and vv that `align_patches` gives, `along` (n, 2) the unit vectors
    of the epipolar lines, 0 for a pixel without one. The constants are from rendered images with truth,
    and the same for two rigs whose noise differs by a factor of two: docs/accuracy.md has the measurements.
    """
    uu, uv, vv = fit_px2.T
    fit = np.stack([uu, uv, uv, vv], axis=1).reshape(-1, 2, 2)
    share = _ALONG_ONE_POINTING if one_pointing else _ALONG
    relief = share * np.einsum("ni,nij,nj->n", along, fit, along)
    lines = along[:, :, None] * along[:, None, :]
    return np.asarray(_PER_DIFFERENCE * (fit + relief[:, None, None] * lines) + _LEAST_PX2 * np.eye(2))


def unlike_covariance_px2(as_found_px: FloatArray, along: FloatArray) -> FloatArray:
    """Covariances (n, 2, 2) of features (n,) that were found to some pixels, and whose patches look unlike.

    Most of them lie where an edge hides terrain from one of the images: the match slides along its line.
    """
    lines = along[:, :, None] * along[:, None, :]
    return np.asarray(as_found_px[:, None, None] ** 2 * np.eye(2) + _UNLIKE_PX**2 * lines)


def pulled_back(covariance_px2: FloatArray, affine: FloatArray) -> FloatArray:
    """Covariances (n, 2, 2) in the first image of those in the other, to which `affine` (n, 2, 2) leads."""
    inverse = np.linalg.inv(affine)
    return np.asarray(inverse @ covariance_px2 @ np.swapaxes(inverse, 1, 2))


def shared_by_tracks(
    covariance_px2: FloatArray, in_first_px2: FloatArray, moved: BoolArray, track: IntArray, frame: IntArray
) -> FloatArray:
    """Covariances (n, 2, 2) as of independent observations, from those against the first of each track.

    Columns are sorted by track; those that `moved` (n,) were fitted to the first of their track, and
    `in_first_px2` (n, 2, 2) is their covariance in the first image. An error against the first is partly the
    first's own: a share goes to the first, the mean over those fitted to it. The images of one other frame,
    fitted to the same patch, err alike: their variances grow with their number.
    """
    out = covariance_px2.copy()
    first, other = np.searchsorted(track, track), np.flatnonzero(moved)
    total, count = np.zeros_like(covariance_px2), np.bincount(first[other], minlength=len(track))
    np.add.at(total, first[other], in_first_px2[other])
    has = np.flatnonzero(count)
    out[has] = _OF_FIRST * total[has] / count[has, None, None]
    elsewhere = other[frame[other] != frame[first[other]]]
    groups = np.column_stack([track[elsewhere], frame[elsewhere]])
    _, of, times = np.unique(groups, axis=0, return_inverse=True, return_counts=True)
    alike = np.ones(len(track))
    alike[elsewhere] = 1.0 + _ALIKE * (times[of.ravel()] - 1)
    out[other] *= ((1 - _OF_FIRST) * alike[other])[:, None, None]
    return out
