"""Robust correction of a pair's relative geometry, and each match's distance from its epipolar line."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._pairs import FAR_M, PairGeometry, Relative, move_pixels

__all__ = ["PairFit", "epipolar_px", "fit_pair"]

_STEPS_PER_OCTAVE = 2
_FINAL_STEPS = 4
_MAX_SAMPLE = 1500
_NOISE_PX = 0.3
_FINEST_SCALE_PX = 0.5
_DEPTH_CANDIDATES = 7
_DEPTH_STEPS = 2
_FINAL_DEPTH_STEPS = 6
_MIN_PARALLAX_PX = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class PairFit:
    """Corrections p of a pair's geometry (see `PairGeometry`) by its matches."""

    p: FloatArray
    """Corrections."""
    root: FloatArray
    """Square root of their covariance, `root @ root.T`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Lines:
    """Lines of sight of n features of a, and where b saw the same things."""

    origin_m: FloatArray
    direction: FloatArray
    uv_b: FloatArray
    noise: FloatArray
    """(n,) standard deviation in b of noise of one pixel per coordinate in both images."""

    @staticmethod
    def of(geometry: PairGeometry, uv_a: FloatArray, uv_b: FloatArray) -> "_Lines":
        rays = geometry.camera_a.unproject(uv_a)
        return _Lines(
            origin_m=rays.origin_m,
            direction=rays.direction,
            uv_b=uv_b,
            noise=np.hypot(1.0, geometry.magnification(uv_a)),
        )

    def points_m(self, inverse_depth: FloatArray) -> FloatArray:
        return self.origin_m + self.direction / np.maximum(inverse_depth, 1 / FAR_M)[:, None]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Misfit:
    """Distances between the pixels of b and the projections of a's lines of sight at some depths."""

    residual_px: FloatArray
    """(n, 2) measured minus projected."""
    d_uv: FloatArray
    """(n, 2, 3) derivative of the projection by the point in the frame of b."""
    slope: FloatArray
    """(n, 2) derivative of the residual by the inverse depth."""
    seen: BoolArray
    """(n,) whether the point is in front of b and in its camera's domain; else the rest means nothing."""

    @staticmethod
    def of(geometry: PairGeometry, b_T_a: Relative, lines: _Lines, inverse_depth: FloatArray) -> "_Misfit":
        uv, d_uv, seen = geometry.camera_b.project_with_jacobian(b_T_a.of(lines.points_m(inverse_depth)))
        d_point = lines.direction @ b_T_a.R.T / np.maximum(inverse_depth, 1 / FAR_M)[:, None] ** 2
        slope = (d_uv @ d_point[:, :, None])[:, :, 0]
        return _Misfit(residual_px=lines.uv_b - uv, d_uv=d_uv, slope=slope, seen=seen)

    def along(self, inverse_depth: FloatArray, nearest: float) -> FloatArray:
        """Direction (n, 2), of length 1, in which a change of depth can reduce a residual; see `_across`.

        That is along the epipolar line; 0 where the inverse depth is at the end of its range, 0 to `nearest`,
        or moves nothing (no baseline).
        """
        length = np.sqrt(_dot(self.slope, self.slope))
        downhill = _dot(self.slope, self.residual_px)
        stuck = ((inverse_depth <= 0) & (downhill > 0)) | ((inverse_depth >= nearest) & (downhill < 0))
        stuck |= length * nearest < _MIN_PARALLAX_PX
        return np.where(stuck[:, None], 0.0, self.slope / np.maximum(length, 1e-12)[:, None])


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])


def _across(along: FloatArray, values: FloatArray) -> FloatArray:
    """The part (n, 2, ...) of values of that shape across directions (n, 2)."""
    along = along.reshape(along.shape + (1,) * (values.ndim - 2))
    return np.asarray(values - along * (along[:, :1] * values[:, :1] + along[:, 1:] * values[:, 1:]))


def fit_pair(
    geometry: PairGeometry,
    uv_a: FloatArray,
    uv_b: FloatArray,
    start: PairFit,
    start_scale_px: float,
    options: FrontEndOptions,
) -> PairFit:
    """Corrections that bring most matches onto their epipolar lines, with telemetry as a prior.

    `uv_a`, `uv_b` are (n, 2) matched pixels, of which many may be wrong: weights follow Geman and McClure
    with a scale that shrinks from `start_scale_px` to half a pixel (graduated non-convexity: Blake and
    Zisserman 1987), so that nothing is drawn at random. The prior is centred on p = 0 with
    `geometry.sigma`; `start.p` is only the start.
    """
    every = max(1, -(-len(uv_a) // _MAX_SAMPLE))
    lines = _Lines.of(geometry, uv_a[::every], uv_b[::every])
    prior = np.diag(geometry.sigma)[:, geometry.sigma > 0]
    columns = prior.shape[1]
    q = np.linalg.lstsq(prior, start.p, rcond=None)[0]
    octaves = max(0.0, float(np.log2(start_scale_px / _FINEST_SCALE_PX)))
    shrinking = start_scale_px * 0.5 ** np.arange(0, octaves, 1 / _STEPS_PER_OCTAVE)
    information = np.eye(columns)
    nearest = 1 / options.min_depth_m
    # The corrections are small: the pose's derivatives are those at the start.
    d_b_T_a = geometry.d_b_T_a(start.p, prior)
    inverse_depth = _nearest_candidate(geometry, geometry.b_T_a(start.p), lines, nearest)
    for scale in [*shrinking, *[_FINEST_SCALE_PX] * _FINAL_STEPS]:
        b_T_a = geometry.b_T_a(prior @ q)
        inverse_depth, misfit = _refine_depths(geometry, b_T_a, lines, inverse_depth, nearest, _DEPTH_STEPS)
        along = misfit.along(inverse_depth, nearest)
        r = _across(along, misfit.residual_px) / lines.noise[:, None]
        moved = move_pixels(lines.points_m(inverse_depth), misfit.d_uv, d_b_T_a)
        J = -_across(along, moved) / lines.noise[:, None, None]
        weight = (scale**2 / (scale**2 + _dot(r, r))) ** 2 / _NOISE_PX**2
        # A correction of many degrees may turn points behind b, where derivatives are huge and mean nothing:
        # with them the prior is lost to rounding and the system singular.
        weight = np.where(misfit.seen, weight, 0.0)
        rows = J.reshape(-1, columns)
        weighted = (weight[:, None, None] * J).reshape(-1, columns).T
        information = np.eye(columns) + weighted @ rows
        gradient = q + weighted @ r.ravel()
        q = q - np.linalg.solve(information, gradient)
    return PairFit(p=prior @ q, root=prior @ np.linalg.inv(np.linalg.cholesky(information)).T)


def epipolar_px(
    geometry: PairGeometry, p: FloatArray, uv_a: FloatArray, uv_b: FloatArray, options: FrontEndOptions
) -> tuple[FloatArray, FloatArray]:
    """Distances (n,) of matched pixels (n, 2) from their epipolar lines, and the inverse depths of these.

    The distance (n,) is that of the pixel in b from the line of sight of the pixel in a, whose depth may
    be anything from `options.min_depth_m` to infinity; it is divided by what one pixel of noise in both
    images would cause, and infinite for a line of sight that b cannot see. Inverse depths (n,) are per metre
    from camera a.
    """
    lines = _Lines.of(geometry, uv_a, uv_b)
    b_T_a, nearest = geometry.b_T_a(p), 1 / options.min_depth_m
    inverse_depth = _nearest_candidate(geometry, b_T_a, lines, nearest)
    inverse_depth, misfit = _refine_depths(geometry, b_T_a, lines, inverse_depth, nearest, _FINAL_DEPTH_STEPS)
    missed = _across(misfit.along(inverse_depth, nearest), misfit.residual_px)
    return np.where(misfit.seen, np.sqrt(_dot(missed, missed)) / lines.noise, np.inf), inverse_depth


def _nearest_candidate(geometry: PairGeometry, b_T_a: Relative, lines: _Lines, nearest: float) -> FloatArray:
    """Inverse depths (n,), out of a few, whose pixels in b are nearest to the matched ones."""
    best, best_distance = np.zeros(len(lines.uv_b)), np.full(len(lines.uv_b), np.inf)
    for candidate in np.linspace(0, 1, _DEPTH_CANDIDATES) ** 2 * nearest:
        trial = np.full(len(best), candidate)
        pixel, seen = geometry.transfer(lines.points_m(trial), b_T_a)
        off = lines.uv_b - pixel
        distance = np.where(seen, _dot(off, off), np.inf)
        better = distance < best_distance
        best[better], best_distance[better] = candidate, distance[better]
    return best


def _refine_depths(
    geometry: PairGeometry,
    b_T_a: Relative,
    lines: _Lines,
    inverse_depth: FloatArray,
    nearest: float,
    steps: int,
) -> tuple[FloatArray, _Misfit]:
    """Inverse depths (n,) after Gauss-Newton steps towards the matched pixels, and the misfit there."""
    misfit = _Misfit.of(geometry, b_T_a, lines, inverse_depth)
    for _ in range(steps):
        slope = misfit.slope
        length2 = np.maximum(_dot(slope, slope), 1e-12)
        step = np.where(misfit.seen, -_dot(slope, misfit.residual_px) / length2, 0.0)
        inverse_depth = np.clip(inverse_depth + np.clip(step, -nearest / 3, nearest / 3), 0.0, nearest)
        misfit = _Misfit.of(geometry, b_T_a, lines, inverse_depth)
    return inverse_depth, misfit
