"""Sub-pixel positions by least-squares matching of the patches around the features of a track."""

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from scipy import ndimage

from pancam_graph.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.images._options import FrontEndOptions
from pancam_graph.images._pairs import FAR_M, PairGeometry
from pancam_graph.images._verify import epipolar_px
from pancam_graph.io.image_files import GreyImage
from pancam_graph.traverse import Traverse

__all__ = ["refine_tracks"]

_BLUR_PX = 0.7
_HALF_WIDTH_PX = 6
_WEIGHT_PX = 4.0
_STEPS = 6
_CHUNK = 500
_CACHED_IMAGES = 8
_CONVERGED_PX = 0.01
_MAX_SHIFT_PX = 1.0
_MIN_CORRELATION = 0.8
_MAX_MAGNIFICATION = 2.0


def refine_tracks(
    traverse: Traverse,
    images: Sequence[GreyImage | None],
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

    @lru_cache(maxsize=_CACHED_IMAGES)
    def spline(row: int) -> FloatArray:
        grey = images[row]
        assert grey is not None  # it has features
        return np.asarray(ndimage.spline_filter(ndimage.gaussian_filter(grey.astype(float), _BLUR_PX), 3))

    refined = np.zeros(len(image), dtype=bool)
    found = uv_px.copy()
    first = np.searchsorted(track, track)
    other = np.flatnonzero(first != np.arange(len(track)))
    pairs = np.column_stack([image[first[other]], image[other]])
    for a, b in np.unique(pairs, axis=0):
        pair = PairGeometry(traverse, int(a), int(b), options.mount_sigma_rad)
        rows = other[(pairs[:, 0] == a) & (pairs[:, 1] == b)]
        for part in np.array_split(rows, -(-len(rows) // _CHUNK)):
            uv_b, good = _refine_pair(pair, spline, uv_px[first[part]], uv_px[part], options)
            found[part[good]] = uv_b[good]
            refined[part[good]] = refined[first[part[good]]] = True
    return found, refined


def _refine_pair(
    pair: PairGeometry,
    spline: Callable[[int], FloatArray],
    uv_a: FloatArray,
    uv_b: FloatArray,
    options: FrontEndOptions,
) -> tuple[FloatArray, BoolArray]:
    side = np.arange(-_HALF_WIDTH_PX, _HALF_WIDTH_PX + 1.0)
    offset = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    weight = np.exp(-0.5 * np.sum(offset**2, axis=1) / _WEIGHT_PX**2)
    weight /= weight.sum()
    affine = _affine(pair, uv_a, uv_b, options)
    magnification = np.sqrt(np.abs(np.linalg.det(affine)))
    usable = (magnification < _MAX_MAGNIFICATION) & (magnification > 1 / _MAX_MAGNIFICATION)
    affine = np.where(usable[:, None, None], affine, np.eye(2))
    usable &= _inside(uv_a, spline(pair.a)) & _inside(uv_b, spline(pair.b))

    around = uv_a[:, None] + offset
    template, contrast = _normalised(_sample(spline(pair.a), around), weight)
    gradient = np.stack(
        [
            _sample(spline(pair.a), around + half) - _sample(spline(pair.a), around - half)
            for half in 0.5 * np.eye(2)
        ],
        -1,
    )
    gradient = gradient / contrast[:, None, None] @ np.linalg.inv(affine)
    # Columns: two of shift, four of the affine map; gain and offset are taken out as the normalisation does.
    jacobian = np.concatenate([gradient, gradient[..., :1] * offset, gradient[..., 1:] * offset], axis=-1)
    jacobian -= np.einsum("k,nki->ni", weight, jacobian)[:, None]
    jacobian -= template[..., None] * np.einsum("k,nk,nki->ni", weight, template, jacobian)[:, None]
    weighted = np.swapaxes(jacobian, 1, 2) * weight
    normal = weighted @ jacobian
    normal += 1e-9 * (1 + np.trace(normal, axis1=1, axis2=2))[:, None, None] * np.eye(6)
    inverse = np.linalg.inv(normal)

    position, start_correlation, correlation = uv_b.copy(), np.full(len(uv_b), -1.0), np.full(len(uv_b), -1.0)
    active = np.flatnonzero(usable)
    for step in range(_STEPS + 1):
        around = position[active, None] + offset @ np.swapaxes(affine[active], 1, 2)
        patch, _ = _normalised(_sample(spline(pair.b), around), weight)
        correlation[active] = np.einsum("k,nk,nk->n", weight, patch, template[active])
        if step == 0:
            start_correlation[active] = correlation[active]
        if step == _STEPS or not len(active):
            break
        error = (patch - template[active])[..., None]
        change = -(inverse[active] @ (weighted[active] @ error))[..., 0]
        position[active] += np.clip(change[:, :2], -_MAX_SHIFT_PX, _MAX_SHIFT_PX)
        affine[active] += np.clip(change[:, 2:].reshape(-1, 2, 2), -0.1, 0.1)
        active = active[np.linalg.norm(change[:, :2], axis=1) > _CONVERGED_PX]
    moved = np.linalg.norm(position - uv_b, axis=1)
    good = usable & (moved < _MAX_SHIFT_PX * np.maximum(magnification, 1.0))
    good &= (correlation > _MIN_CORRELATION) & (correlation >= start_correlation)
    return position, good


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


def _inside(uv_px: FloatArray, image: FloatArray) -> BoolArray:
    size = np.array(image.shape[::-1])
    margin = _HALF_WIDTH_PX + 1
    return np.asarray(np.all((uv_px >= margin) & (uv_px <= size - 1 - margin), axis=1))


def _sample(spline: FloatArray, uv_px: FloatArray) -> FloatArray:
    """Brightness at pixels (n, k, 2) of an image given by its cubic spline coefficients, (n, k)."""
    at = [uv_px[..., 1], uv_px[..., 0]]
    return np.asarray(ndimage.map_coordinates(spline, at, order=3, prefilter=False, mode="nearest"))


def _normalised(patch: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Patches (n, k) of weighted mean 0 and variance 1, and their standard deviations (n,) before."""
    centred = patch - (patch @ weight)[:, None]
    spread = np.sqrt(np.maximum((centred**2) @ weight, 1e-12))
    return centred / spread[:, None], spread
