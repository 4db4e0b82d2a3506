"""A stop moved onto an orbital picture: its view from above found there by the directions of its gradients.

Pictures from orbit and from the ground differ in light and contrast. What they share is where brightness
changes, and along which direction: gradients over their own length, with small ones faded out (orientation
correlation: Fitch, Kadyrov, Christmas and Kittler 2002), are correlated by FFT over all shifts, at turns in
even steps and then in steps four times as fine. From the best, least squares of brightness finds
the rest of shift and turn, and by how much the view lies farther out than the map. Its errors hang together
from pixel to pixel; the covariance (H^-1 B H^-1) counts parts of the view as independent, not pixels.
"""

from dataclasses import dataclass

import cv2
import gtsam
import numpy as np
import scipy
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.data import MapImage, StopPlacement, Surface
from pancam_graph.terrain._fused import Fused
from pancam_graph.terrain._levels import composed

__all__ = ["CELLS_PER_PIXEL", "Registration", "register_stop"]

_LEAST_CELLS = 400
"""Cells of the map that a view must cover."""
_LEAST_SIGMAS = 7.0
"""Height of the best correlation over those of all shifts, in their standard deviations, below which it may
be chance: of a million shifts and turns the highest is about 5."""
_SECOND = 0.8
"""Share of the best correlation that another place may reach."""
_APART_PX = 6
"""Pixels beyond which another place is not the same."""
CELLS_PER_PIXEL = 4
"""Cells of a view along a pixel of the map, at least, where the view has several sizes of them."""
_HIGH_PASS_PX = 8.0
"""Standard deviation of the blur that brightness is compared above of."""
_SECTORS, _RINGS = 12, 2
"""Parts of a view whose residuals are taken to be independent of each other."""
_ROUNDS = 30
_SHAPE_PX = 0.06
"""Sigma, pixels, of what shapes seen from the side and from above differ by all around, which no residual
tells: slopes that face the camera count more, and where the sun lights them the whole view seems to move
towards it. From four rendered stops (docs/terrain.md)."""
_OUTWARD_PX, _OUTWARD_SHARE = 0.3, 0.005
"""Sigmas, pixels and a share of the distance, of how much farther out things seem to stand from the side."""
_FINE = 4
_LOOSE_RAD, _LOOSE_M = 1.0, 100.0
"""Sigmas of what a map from above does not tell: roll and pitch, and height without a surface."""
_HELD = 1e-5
"""The same, radians and metres, where the world frame is that of the stop: as good as exact."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Registration:
    """How a stop moves onto a map: it turns about its place `at_m`, then shifts."""

    stop: str
    at_m: FloatArray
    """(2,) x and y of the mast before"""
    turn_rad: float
    """Anticlockwise seen from above."""
    shift_m: FloatArray
    """(2,) along x and y of the world"""
    covariance: FloatArray
    """(3, 3) of turn, and shift along x and y, rad and m"""
    height_m: float | None
    """What is to be added to heights of the stop; None: no surface was given."""
    sigma_height_m: float | None
    sigmas: float
    """Height of the correlation over those of other shifts, in their standard deviations."""
    second: float
    """Largest correlation at another place, as a share of the best."""

    def constraint(
        self, world_T_mast: gtsam.Pose3, *, robust: bool = True, held: bool = False
    ) -> StopPlacement:
        """The tie of a stop whose pose was this when its view was made, for another solve.

        `held`: roll and pitch, and without a surface the height, are those of this pose, as for a stop that
        the world frame is that of; else nothing is said of them.
        """
        rotation, place = world_T_mast.rotation().matrix(), world_T_mast.translation()
        up = 0.0 if self.height_m is None else self.height_m
        moved = gtsam.Pose3(
            gtsam.Rot3.Rz(self.turn_rad) * world_T_mast.rotation(),
            np.array([*(self.at_m + self.shift_m), place[2] + up]),
        )
        world = np.zeros((6, 6))  # of turns and shifts along the world's axes
        known = np.array([2, 3, 4])
        world[np.ix_(known, known)] = self.covariance
        world[[0, 1], [0, 1]] = (_HELD if held else _LOOSE_RAD) ** 2
        world[5, 5] = (self.sigma_height_m or (_HELD if held else _LOOSE_M)) ** 2
        body = np.kron(np.eye(2), (gtsam.Rot3.Rz(self.turn_rad).matrix() @ rotation).T)
        covariance = body @ world @ body.T
        return StopPlacement(
            stop=self.stop,
            world_T_mast=moved,
            covariance=(covariance + covariance.T) / 2,
            robust=robust,
        )


def register_stop(
    stop: str,
    view: Fused,
    at_m: FloatArray,
    map_image: MapImage,
    *,
    surface: Surface | None = None,
    search_m: float = 15.0,
    search_rad: float = 0.1,
) -> Registration:
    """Find a stop's view from above on a map of the same axes.

    `view` is the stop's terrain, `at_m` (2,) the place of its mast, about which it is turned by up to
    `search_rad` and then shifted by up to `search_m` along x and y. With a `surface`, heights are compared
    too. Raises InputError where the map does not cover the search, the view covers too few cells of the map,
    and where no place or more than one fits.
    """
    here = f"stop {stop}: map"
    pixel = float(np.abs(map_image.step_m).mean())
    view = composed(view, pixel / CELLS_PER_PIXEL)
    patch = _on_map(view, at_m, pixel)
    seen = np.isfinite(patch)
    if seen.sum() < _LEAST_CELLS:
        raise InputError(
            f"{here}: expected a view of {_LEAST_CELLS} of its pixels or more, found {seen.sum()}"
        )
    margin = int(np.ceil(search_m / pixel)) + 2
    around = _part(map_image, at_m, patch.shape[0] // 2 + margin, here)
    scores = _Scores(patch, around, margin)
    far = float(np.linalg.norm(np.argwhere(seen) - (np.array(patch.shape) - 1) / 2, axis=1).max())
    step = 1.0 / max(far, 1.0)
    best = _best(scores, np.arange(-search_rad, search_rad + step / 2, step))
    fine = step / _FINE * np.arange(-_FINE + 1, _FINE)
    peak = _best(scores, np.asarray(best.turn_rad + fine, dtype=float))
    if peak.sigmas < _LEAST_SIGMAS:
        raise InputError(
            f"{here}: expected a place that the view fits, found none within {search_m:g} m: the best "
            f"correlation is {peak.sigmas:.1f} sigma above chance, {_LEAST_SIGMAS:g} are needed"
        )
    if best.second > _SECOND:
        raise InputError(
            f"{here}: expected one place that the view fits, found two: the second reaches "
            f"{100 * best.second:.0f} % of the best"
        )
    turn, shift_px, covariance = _refined(patch, around, margin, peak)
    to_m = np.diag([1.0, pixel, -pixel])
    at = np.asarray(at_m, dtype=float)
    shift_m = shift_px * [pixel, -pixel]
    height = None if surface is None else _height(view, surface, at, turn, shift_m, here)
    return Registration(
        stop=stop,
        at_m=at,
        turn_rad=turn,
        shift_m=shift_m,
        covariance=to_m @ covariance @ to_m,
        height_m=None if height is None else height[0],
        sigma_height_m=None if height is None else height[1],
        sigmas=peak.sigmas,
        second=best.second,
    )


def _on_map(view: Fused, at_m: FloatArray, pixel_m: float) -> FloatArray:
    """A view in pixels of a map, an odd square about a place; NaN where half of a pixel is unseen."""
    grid, grey = view.grid, np.asarray(view.grey, dtype=np.float64)
    x, y = grid.middles()
    reach = max(np.abs(x - at_m[0]).max(), np.abs(y - at_m[1]).max())
    half = int(np.ceil(reach / pixel_m))
    seen = np.isfinite(grey)
    # Cells are averaged over a pixel's width before pixels are taken between them.
    width = max(pixel_m / grid.cell_m, 1.0)
    size = 2 * int(np.ceil(width)) + 1
    taps = np.clip(width / 2 + 0.5 - np.abs(np.arange(size) - size // 2), 0, 1)
    taps /= taps.sum()

    def averaged(a: FloatArray) -> NDArray[np.float32]:
        return np.asarray(
            cv2.sepFilter2D(a, -1, taps, taps, borderType=cv2.BORDER_CONSTANT), dtype=np.float32
        )

    share, filled = averaged(seen.astype(float)), averaged(np.where(seen, grey, 0.0))
    offset = pixel_m * (np.arange(2 * half + 1) - half)
    column, row = np.meshgrid(
        (at_m[0] + offset - x[0]) / grid.cell_m, (y[0] - at_m[1] + offset) / grid.cell_m
    )
    places = column.astype(np.float32), row.astype(np.float32)
    of = cv2.remap(share, *places, cv2.INTER_LINEAR), cv2.remap(filled, *places, cv2.INTER_LINEAR)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(of[0] > 0.5, of[1] / of[0], np.nan).astype(float)


def _part(map_image: MapImage, at_m: FloatArray, half: int, here: str) -> FloatArray:
    """The square of a map about a place, so that the place is the middle of its middle pixel."""
    at = (np.asarray(at_m) - map_image.first_m) / map_image.step_m
    rows, columns = map_image.grey.shape
    n = np.arange(2 * half + 1) - half
    column, row = np.meshgrid(
        at[0] + n * np.sign(map_image.step_m[0]), at[1] - n * np.sign(map_image.step_m[1])
    )
    if column.min() < 0 or row.min() < 0 or column.max() > columns - 1 or row.max() > rows - 1:
        raise InputError(f"{here}: expected it to cover the search about the stop, found its edge within it")
    grey = np.asarray(map_image.grey, dtype=np.float32)
    out = cv2.remap(grey, column.astype(np.float32), row.astype(np.float32), cv2.INTER_CUBIC)
    if not np.all(np.isfinite(out)):
        raise InputError(f"{here}: expected brightness all about the stop, found places without")
    return out.astype(float)


@dataclass(frozen=True, kw_only=True)
class _Peak:
    turn_rad: float
    shift_px: tuple[int, int]
    score: float
    sigmas: float
    second: float


class _Scores:
    """Correlations of a view, turned, with a map, over all shifts."""

    def __init__(self, patch: FloatArray, around: FloatArray, margin: int) -> None:
        self._patch, self._margin = patch, margin
        self._shape = tuple(scipy.fft.next_fast_len(n) for n in around.shape)
        field = _orientation(around, np.ones(around.shape, dtype=bool))
        self._of_map = scipy.fft.fft2(field, self._shape)
        self._power = scipy.fft.rfft2(np.abs(field) ** 2, self._shape)

    def at(self, turn_rad: float) -> FloatArray:
        """(2 margin + 1, 2 margin + 1) scores by shifts down and right, from -margin on."""
        turned, seen = _turned(self._patch, turn_rad)
        field = _orientation(turned, seen)
        cross = scipy.fft.ifft2(self._of_map * np.conj(scipy.fft.fft2(field, self._shape))).real
        weight = np.abs(field) > 0
        of_map = scipy.fft.irfft2(
            self._power * np.conj(scipy.fft.rfft2(weight.astype(float), self._shape)), self._shape
        )
        n = 2 * self._margin + 1
        norm = np.sum(np.abs(field) ** 2) * of_map[:n, :n].clip(1e-9)
        return np.asarray(cross[:n, :n] / np.sqrt(norm))


def _best(scores: _Scores, turns_rad: FloatArray) -> _Peak:
    found = [scores.at(float(turn)) for turn in turns_rad]
    tops = [float(one.max()) for one in found]
    k = int(np.argmax(tops))
    here = found[k]
    row, column = np.unravel_index(int(np.argmax(here)), here.shape)
    margin = here.shape[0] // 2
    others = np.max(found, axis=0)
    rows, columns = np.ogrid[: here.shape[0], : here.shape[1]]
    others[(rows - row) ** 2 + (columns - column) ** 2 <= _APART_PX**2] = -np.inf
    return _Peak(
        turn_rad=float(turns_rad[k]),
        shift_px=(int(column) - margin, int(row) - margin),
        score=tops[k],
        sigmas=float((tops[k] - here.mean()) / here.std()),
        second=float(others.max() / tops[k]),
    )


def _orientation(grey: FloatArray, seen: BoolArray) -> NDArray[np.complex128]:
    """Gradients over their length, faded where they are small; 0 beside what is not seen."""
    filled = np.where(seen, grey, 0.0)
    gradient = scipy.ndimage.gaussian_filter(filled, 1.0, order=(0, 1)) + 1j * scipy.ndimage.gaussian_filter(
        filled, 1.0, order=(1, 0)
    )
    inner = scipy.ndimage.binary_erosion(seen, iterations=4, border_value=1)
    length = np.abs(gradient)
    typical = float(np.median(length[inner])) if inner.any() else 1.0
    return np.where(inner, gradient / (length + typical + 1e-12), 0.0)


def _turned(patch: FloatArray, turn_rad: float) -> tuple[FloatArray, BoolArray]:
    """A view turned anticlockwise seen from above about its middle, and what is seen of it."""
    middle = (patch.shape[0] - 1) / 2
    matrix = cv2.getRotationMatrix2D((middle, middle), float(np.degrees(turn_rad)), 1.0)
    seen = np.isfinite(patch)
    size = patch.shape[::-1]
    share = cv2.warpAffine(seen.astype(np.float32), matrix, size, flags=cv2.INTER_LINEAR)
    filled = cv2.warpAffine(
        np.where(seen, patch, 0.0).astype(np.float32), matrix, size, flags=cv2.INTER_LINEAR
    )
    inside = np.asarray(share > 0.99)
    return np.where(inside, filled / np.maximum(share, 0.5), 0.0).astype(float), inside


def _refined(
    patch: FloatArray, around: FloatArray, margin: int, peak: _Peak
) -> tuple[float, FloatArray, FloatArray]:
    """Turn, shift (2,) right and down, and their covariance (3, 3), by least squares of brightness.

    The model: the view is a x map + b at each place, both without what is broader than some pixels. The view
    may lie farther out than the map, by a number of pixels and by a share of the distance, both known to be
    small: what is seen from the side seems to stand elsewhere, by as much all around.
    """
    seen = np.isfinite(patch)
    inner = scipy.ndimage.binary_erosion(seen, iterations=2, border_value=0)
    high = _high_pass(patch, seen)[inner]
    whole = _high_pass(around, np.ones(around.shape, dtype=bool))
    coefficients = scipy.ndimage.spline_filter(whole)
    middle = (patch.shape[0] - 1) / 2
    row, column = np.nonzero(inner)
    u, v = column - middle, row - middle  # right and down
    far = np.hypot(u, v)
    outward = np.stack([u, v]) / np.maximum(far, 1.0)
    state = np.array([peak.turn_rad, *peak.shift_px, 0.0, 0.0], dtype=float)
    residual, both = np.zeros(len(u)), np.zeros((len(u), 6))
    prior = np.array([_OUTWARD_PX, _OUTWARD_SHARE]) ** 2
    for _ in range(_ROUNDS):
        c, s = np.cos(state[0]), np.sin(state[0])
        # Anticlockwise from above with v down: right' = c u + s v, down' = -s u + c v.
        x, y = c * u + s * v, -s * u + c * v
        out_x, out_y = c * outward[0] + s * outward[1], -s * outward[0] + c * outward[1]
        place = np.array(
            [
                y + state[2] + state[3] * out_y + state[4] * y,
                x + state[1] + state[3] * out_x + state[4] * x,
            ]
        )
        place += middle + margin
        value = scipy.ndimage.map_coordinates(coefficients, place, prefilter=False)
        h = 0.5
        down, right = (
            (
                scipy.ndimage.map_coordinates(coefficients, place + h * e, prefilter=False)
                - scipy.ndimage.map_coordinates(coefficients, place - h * e, prefilter=False)
            )
            / (2 * h)
            for e in (np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]]))
        )
        gain = float(value @ high) / float(value @ value)
        residual = high - gain * value
        # Of right' by the turn it is y, of down' it is -x.
        turned, along = right * y - down * x, right * out_x + down * out_y
        both = np.column_stack(
            [gain * np.stack([turned, right, down, along, right * x + down * y], 1), value]
        )
        step = np.linalg.lstsq(both, residual, rcond=None)[0][:5]
        state = state + step
        if np.abs(step[:3] / [1 / max(middle, 1.0), 1.0, 1.0]).max() < 1e-4:
            break
    normal = np.linalg.inv(both.T @ both)
    covariance = (normal @ _meat(both, residual, inner, (u, v)) @ normal)[:5, :5]
    # What is known of the last two changes the others as far as they hang together.
    share = covariance[:, 3:] @ np.linalg.inv(covariance[3:, 3:] + np.diag(prior))
    state, covariance = state - share @ state[3:], covariance - share @ covariance[3:]
    # Of the whole circle or of a part of it, a shift of _SHAPE_PX looks like a turn at the mean distance.
    shape = np.diag([1 / np.sqrt(np.mean(far * far)), 1.0, 1.0]) * _SHAPE_PX
    return float(state[0]), state[1:3], covariance[:3, :3] + shape @ shape


def _high_pass(grey: FloatArray, seen: BoolArray) -> FloatArray:
    """Brightness less its mean around, of what is seen."""
    blur = scipy.ndimage.gaussian_filter
    mean = blur(np.where(seen, grey, 0.0), _HIGH_PASS_PX) / blur(seen.astype(float), _HIGH_PASS_PX).clip(1e-3)
    return np.where(seen, np.nan_to_num(grey) - mean, 0.0)


def _meat(
    jacobian: FloatArray, residual: FloatArray, inner: BoolArray, offset_px: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """J' C J, C being the covariance of the residuals: from the sums of J' r over parts of the view.

    Within a part (a sector and a ring) residuals may hang together in any way; parts count as independent
    (Liang and Zeger 1986), and few of them as few.
    """
    azimuth, distance = np.arctan2(offset_px[1], offset_px[0]), np.hypot(*offset_px)
    sector, ring = (
        np.searchsorted(np.quantile(values, np.arange(1, n) / n), values)
        for values, n in ((azimuth, _SECTORS), (distance, _RINGS))
    )
    part = sector * _RINGS + ring
    sums = np.stack(
        [np.bincount(part, weights=j * residual, minlength=_SECTORS * _RINGS) for j in jacobian.T]
    )
    used = int(np.count_nonzero(np.bincount(part)))
    return np.asarray(sums @ sums.T * (used / (used - jacobian.shape[1])))


def _height(
    view: Fused, surface: Surface, at_m: FloatArray, turn_rad: float, shift_m: FloatArray, here: str
) -> tuple[float, float]:
    """How much higher a surface is than the view's heights, moved onto it, and how much that scatters."""
    x, y = view.grid.middles()
    seen = np.isfinite(view.height_m)
    places = np.column_stack(
        [np.broadcast_to(x, seen.shape)[seen], np.broadcast_to(y[:, None], seen.shape)[seen]]
    )
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    moved = (places - at_m) @ np.array([[c, -s], [s, c]]).T + at_m + shift_m
    covered = surface.covers(moved)
    if not covered.any():
        raise InputError(f"{here}: expected a surface that covers the view, found none of its cells covered")
    row_column = ((moved[covered] - surface.first_m) / surface.step_m)[:, ::-1].T
    there = scipy.ndimage.map_coordinates(np.nan_to_num(surface.height_m), row_column, order=1)
    off = there - np.asarray(view.height_m, dtype=float)[seen][covered]
    middle = float(np.median(off))
    return middle, max(1.4826 * float(np.median(np.abs(off - middle))), 1e-3)
