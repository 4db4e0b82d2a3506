"""Sub-pixel positions by least-squares matching of the patches around the features of a track."""

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.threads import in_parallel
from pancam_graph.cameras import Camera
from pancam_graph.data import Traverse
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._pairs import FAR_M, PairGeometry
from pancam_graph.images._patches import HALF_WIDTH_PX, align_patches
from pancam_graph.images._splines import Splines
from pancam_graph.images._verify import epipolar_px

__all__ = ["refine_tracks"]

_STEPS = 6
_GRAIN = 256
_MAX_SHIFT_PX = 1.0
_MIN_CORRELATION = 0.8
_MAX_MAGNIFICATION = 2.0


def refine_tracks(
    traverse: Traverse,
    spline: Splines,
    image: IntArray,
    track: IntArray,
    uv_px: FloatArray,
    options: FrontEndOptions,
) -> tuple[FloatArray, BoolArray]:
    """Better positions (n, 2), and which observations (n,) have one, in columns sorted by track.

    The first observation of each track stays; the others move so that the brightness around them fits
    that around the first, under an affine map that starts from the camera models, and any gain and offset
    (least-squares matching: Gruen 1985). A feature stays as it was found where the patches look unlike,
    where it would move by more than a pixel, near the image's edge, and between images whose scales
    differ by more than a factor of 2.
    """
    refined = np.zeros(len(image), dtype=bool)
    refined_px = uv_px.copy()
    first = np.searchsorted(track, track)
    other = np.flatnonzero(first != np.arange(len(track)))
    pairs = np.column_stack([image[first[other]], image[other]])
    for a, b in np.unique(pairs, axis=0):
        pair = PairGeometry(traverse, int(a), int(b), options.mount_sigma_rad)
        rows = other[(pairs[:, 0] == a) & (pairs[:, 1] == b)]
        uv_b, good = _refine_pair(pair, spline, uv_px[first[rows]], uv_px[rows], options)
        refined_px[rows[good]] = uv_b[good]
        refined[rows[good]] = refined[first[rows[good]]] = True
    return refined_px, refined


def _refine_pair(
    pair: PairGeometry, spline: Splines, uv_a: FloatArray, uv_b: FloatArray, options: FrontEndOptions
) -> tuple[FloatArray, BoolArray]:
    affine = _affine(pair, uv_a, uv_b, options)
    magnification = np.sqrt(np.abs(np.linalg.det(affine)))
    usable = (magnification < _MAX_MAGNIFICATION) & (magnification > 1 / _MAX_MAGNIFICATION)
    usable &= _inside(uv_a, pair.camera_a) & _inside(uv_b, pair.camera_b)
    rows = np.flatnonzero(usable)
    image_a, image_b = spline(pair.a), spline(pair.b)
    own_a, own_affine, position = uv_a[rows], affine[rows], uv_b[rows]
    reach, fit = np.zeros((len(rows), 2), dtype=np.int64), np.empty((len(rows), 5))
    in_parallel(
        lambda first, last: align_patches(
            first, last, image_a, image_b, own_a, own_affine, reach, _STEPS, position, fit
        ),
        len(rows),
        grain=_GRAIN,
    )
    at_start, correlation, _, moved, _ = fit.T
    good = moved < _MAX_SHIFT_PX * np.maximum(magnification[rows], 1.0)
    good &= (correlation > _MIN_CORRELATION) & (correlation >= at_start)
    matched_px, refined = uv_b.copy(), np.zeros(len(uv_b), dtype=bool)
    matched_px[rows], refined[rows] = position, good
    return matched_px, refined


def _affine(pair: PairGeometry, uv_a: FloatArray, uv_b: FloatArray, options: FrontEndOptions) -> FloatArray:
    """Derivative (n, 2, 2) of the pixel in b by that in a, on a sphere around camera a through each point."""
    b_T_a = pair.b_T_a(pair.no_correction)
    _, inverse_depth = epipolar_px(pair, pair.no_correction, uv_a, uv_b, options)
    depth_m = 1 / np.maximum(inverse_depth, 1 / FAR_M)
    pixels = []
    for shift in ([0.0, 0.0], [1.0, 0.0], [0.0, 1.0]):
        rays = pair.camera_a.unproject(uv_a + shift)
        pixels.append(pair.transfer(rays.origin_m + depth_m[:, None] * rays.direction, b_T_a)[0])
    return np.stack([pixels[1] - pixels[0], pixels[2] - pixels[0]], -1)


def _inside(uv_px: FloatArray, camera: Camera) -> BoolArray:
    size = np.array([camera.width_px, camera.height_px])
    margin = HALF_WIDTH_PX + 1
    return np.asarray(np.all((uv_px >= margin) & (uv_px <= size - 1 - margin), axis=1))
