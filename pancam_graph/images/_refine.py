"""Sub-pixel positions by least-squares matching of the patches around the features of a track."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.threads import in_parallel
from pancam_graph.cameras import Camera
from pancam_graph.data import Traverse
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._local_map import HALF_WIDTH_PX, local_map
from pancam_graph.images._pairs import FAR_M, PairGeometry
from pancam_graph.images._patch_noise import (
    patch_covariance_px2,
    pulled_back,
    unlike_covariance_px2,
)
from pancam_graph.images._patches import QUALITIES, align_patches
from pancam_graph.images._splines import Splines
from pancam_graph.images._verify import epipolar_px

__all__ = ["RefinedTracks", "refine_tracks"]

_STEPS = 6
_GRAIN = 256
_MAX_SHIFT_PX = 1.0
_MIN_CORRELATION = 0.8
_MAX_MAGNIFICATION = 2.0
_LEAST_PARALLAX_PX = 1e-9
_ENOUGH = 50
"""Points that two images share, and that look alike, from which on they do without those that look unlike."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedTracks:
    """Positions after least-squares matching, in columns sorted by track."""

    uv_px: FloatArray
    """(n, 2) pixels."""
    moved: BoolArray
    """(n,) which observations were fitted to the first of their track."""
    unlike: BoolArray
    """(n,) which were compared with the first of their track and look unlike."""
    spare: BoolArray
    """(n,) which of these the two images do without: they share enough points that look alike."""
    covariance_px2: FloatArray
    """(n, 2, 2) of these two: the noise against the first of the track; 0 of others."""
    in_first_px2: FloatArray
    """(n, 2, 2) the same of those moved, in the pixels of the first image."""


def refine_tracks(
    traverse: Traverse,
    spline: Splines,
    image: IntArray,
    track: IntArray,
    uv_px: FloatArray,
    as_found_px: FloatArray,
    options: FrontEndOptions,
) -> RefinedTracks:
    """Better positions and their noise, for columns (n,) sorted by track.

    The first observation of each track stays; the others move so that the brightness around them fits
    that around the first, under an affine map that starts from the camera models, and any gain and offset
    (least-squares matching: Gruen 1985). A feature stays as it was found, to `as_found_px` (n,), where the
    patches look unlike, where it would move by more than a pixel, near the image's edge, and between images
    whose scales differ by more than a factor of 2.
    """
    out = RefinedTracks(
        uv_px=uv_px.copy(),
        moved=np.zeros(len(image), dtype=bool),
        unlike=np.zeros(len(image), dtype=bool),
        spare=np.zeros(len(image), dtype=bool),
        covariance_px2=np.zeros((len(image), 2, 2)),
        in_first_px2=np.zeros((len(image), 2, 2)),
    )
    first = np.searchsorted(track, track)
    other = np.flatnonzero(first != np.arange(len(track)))
    pairs = np.column_stack([image[first[other]], image[other]])
    for a, b in np.unique(pairs, axis=0):
        pair = PairGeometry(traverse, int(a), int(b), options.mount_sigma_rad)
        rows = other[(pairs[:, 0] == a) & (pairs[:, 1] == b)]
        fit = _refine_pair(pair, spline, uv_px[first[rows]], uv_px[rows], options)
        missed = fit.compared & ~fit.good
        good, unlike = rows[fit.good], rows[missed]
        out.uv_px[good], out.moved[good], out.unlike[unlike] = fit.uv_px[fit.good], True, True
        out.spare[unlike] = len(good) >= _ENOUGH
        covariance = patch_covariance_px2(
            fit.fit_px2[fit.good], fit.along[fit.good], one_pointing=pair.same_frame
        )
        out.covariance_px2[good] = covariance
        out.in_first_px2[good] = pulled_back(covariance, fit.affine[fit.good])
        out.covariance_px2[unlike] = unlike_covariance_px2(as_found_px[unlike], fit.along[missed])
    return out


class _PairFit(NamedTuple):
    """Patches of one image fitted into another: n rows."""

    uv_px: FloatArray
    """(n, 2) pixels in the other image."""
    compared: BoolArray
    """(n,) which patches lie in both images, at scales that can be compared."""
    good: BoolArray
    """(n,) which of these were found."""
    fit_px2: FloatArray
    """(n, 3) covariance of the fit up to a factor: uu, uv, vv."""
    along: FloatArray
    """(n, 2) unit vectors along the epipolar lines; 0 where there is none."""
    affine: FloatArray
    """(n, 2, 2) derivative of the pixel by that in the first image."""


def _refine_pair(
    pair: PairGeometry, spline: Splines, uv_a: FloatArray, uv_b: FloatArray, options: FrontEndOptions
) -> _PairFit:
    affine, bend, along = _local_map(pair, uv_a, uv_b, options)
    magnification = np.sqrt(np.abs(np.linalg.det(affine)))
    usable = (magnification < _MAX_MAGNIFICATION) & (magnification > 1 / _MAX_MAGNIFICATION)
    usable &= _inside(uv_a, pair.camera_a) & _inside(uv_b, pair.camera_b)
    rows = np.flatnonzero(usable)
    image_a, image_b = spline(pair.a), spline(pair.b)
    own_a, own_affine, own_bend, position = uv_a[rows], affine[rows], bend[rows], uv_b[rows]
    reach, fit = np.zeros((len(rows), 2), dtype=np.int64), np.empty((len(rows), QUALITIES))
    in_parallel(
        lambda first, last: align_patches(
            first, last, image_a, image_b, own_a, own_affine, own_bend, reach, _STEPS, position, fit
        ),
        len(rows),
        grain=_GRAIN,
    )
    at_start, correlation, _, moved = fit[:, :4].T
    good = moved < _MAX_SHIFT_PX * np.maximum(magnification[rows], 1.0)
    good &= (correlation > _MIN_CORRELATION) & (correlation >= at_start)
    matched_px, refined, fit_px2 = uv_b.copy(), np.zeros(len(uv_b), dtype=bool), np.zeros((len(uv_b), 3))
    matched_px[rows], refined[rows], fit_px2[rows] = position, good, fit[:, 4:]
    return _PairFit(matched_px, usable, refined, fit_px2, along, affine)


def _local_map(
    pair: PairGeometry, uv_a: FloatArray, uv_b: FloatArray, options: FrontEndOptions
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How the pixel in b moves with that in a: first derivatives (n, 2, 2) and second ones (n, 2, 3).

    On a sphere around camera a through each point. The third are unit vectors (n, 2) along which the pixel in
    b moves with the depth, 0 where it does not.
    """
    b_T_a = pair.b_T_a(pair.no_correction)
    _, inverse_depth = epipolar_px(pair, pair.no_correction, uv_a, uv_b, options)
    depth_m = 1 / np.maximum(inverse_depth, 1 / FAR_M)

    def moved(du: float, dv: float) -> FloatArray:
        rays = pair.camera_a.unproject(uv_a + np.array([du, dv]))
        return pair.transfer(rays.origin_m + depth_m[:, None] * rays.direction, b_T_a)[0]

    affine, bend = local_map(moved)
    rays = pair.camera_a.unproject(uv_a)
    at = rays.origin_m + depth_m[:, None] * rays.direction
    _, d_uv, _ = pair.camera_b.project_with_jacobian(b_T_a.of(at))
    along = depth_m[:, None] * np.einsum("nij,nj->ni", d_uv, rays.direction @ b_T_a.R.T)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    return affine, bend, np.where(length > _LEAST_PARALLAX_PX, along / np.maximum(length, 1e-300), 0.0)


def _inside(uv_px: FloatArray, camera: Camera) -> BoolArray:
    size = np.array([camera.width_px, camera.height_px])
    margin = HALF_WIDTH_PX + 1
    return np.asarray(np.all((uv_px >= margin) & (uv_px <= size - 1 - margin), axis=1))
