"""The turn between two pictures from features that look alike, many of them wrongly."""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, skew, so3_exp
from pancam_graph.images.pointing._two_points import d_directions, directions, focal_scales, turns_of

__all__ = ["FocalRange", "PairTurn", "pair_turn"]

_DRAWS = 600
_NEAR_RAD = 8e-3
"""How far a point may stand beside its place: parallax of a short arm, and the lens."""
_FEWEST = 12
_FALSE_ALARMS = 1e-6
"""Largest expected number of pairs, of all that are compared, that agree as well by chance."""
_STEPS = 12


@dataclass(frozen=True, kw_only=True)
class FocalRange:
    """Focal lengths, over the told one, that are believed."""

    low: float
    high: float

    @property
    def fixed(self) -> bool:
        """Whether it is a single one."""
        return self.low == self.high


@dataclass(frozen=True, kw_only=True, eq=False)
class PairTurn:
    """The turn between pictures a and b, and the points that agree with it."""

    a: int
    b: int
    b_R_a: FloatArray
    """(3, 3)"""
    scale: float
    """Focal length over the told one."""
    sigma_scale: float
    """Its standard deviation, as a share; infinite where it was not sought."""
    plane_a: FloatArray
    """(n, 2) points that agree, on the plane z = 1 by the told focal length."""
    plane_b: FloatArray


def pair_turn(
    a: int,
    b: int,
    planes: tuple[FloatArray, FloatArray],
    focal: FocalRange,
    field: float,
    comparisons: int,
) -> PairTurn | None:
    """The turn on which most points (n, 2) of the planes z = 1 agree, or None where it may be chance.

    `field` is the solid angle of a picture, and `comparisons` how many pairs of pictures are tried. Pairs of
    points are drawn by a seed of the pictures' numbers: the same points give the same turn.

    Whether what agrees is chance: the expected number of turns, over all draws and pairs, on which as many
    points agree as do (number of false alarms; Moisan and Stival, IJCV 57, 2004).
    """
    plane_a, plane_b = planes
    n = len(plane_a)
    if n < _FEWEST:
        return None
    rng = np.random.default_rng([a, b])
    first = rng.integers(0, n, _DRAWS)
    second = (first + rng.integers(1, n, _DRAWS)) % n
    drawn = np.stack([first, second], axis=1)
    if focal.fixed:
        scale = np.full(_DRAWS, focal.low)
    else:
        drawn, scale = _with_scales(drawn, plane_a, plane_b, focal)
        if not len(drawn):
            return None
    rays_a, rays_b = directions(plane_a[drawn], scale[:, None]), directions(plane_b[drawn], scale[:, None])
    turns = turns_of(rays_a, rays_b)
    agreeing = _counts(plane_a, plane_b, turns, scale)
    best = int(agreeing.argmax())
    turn, s = turns[best], float(scale[best])
    sigma = np.inf
    for _ in range(_STEPS):
        turn, s, sigma = _step(plane_a, plane_b, turn, s, focal)
    agrees = _agree(plane_a, plane_b, turn, s)
    if not _beyond_chance(int(agrees.sum()), n, field, comparisons):
        return None
    return PairTurn(
        a=a, b=b, b_R_a=turn, scale=s, sigma_scale=sigma, plane_a=plane_a[agrees], plane_b=plane_b[agrees]
    )


def _with_scales(
    drawn: IntArray, plane_a: FloatArray, plane_b: FloatArray, focal: FocalRange
) -> tuple[IntArray, FloatArray]:
    """Draws with each focal length that is believed."""
    scales, real = focal_scales(plane_a[drawn], plane_b[drawn])
    row, root = np.nonzero(real & (scales >= focal.low) & (scales <= focal.high))
    return drawn[row], scales[row, root]


def _counts(plane_a: FloatArray, plane_b: FloatArray, turns: FloatArray, scale: FloatArray) -> IntArray:
    """On how many of the points each turn (m, 3, 3) with its focal length (m,) brings both pictures together.

    The cosine between a turned direction and the other is linear in the products of their coordinates.
    """
    of_scale = np.stack([np.ones_like(scale), np.ones_like(scale), scale], axis=1)
    scaled = turns * of_scale[:, :, None] * of_scale[:, None, :]
    one = np.ones((len(plane_a), 1))
    a, b = np.hstack([plane_a, one]), np.hstack([plane_b, one])
    dots = scaled.reshape(-1, 9) @ (b[:, :, None] * a[:, None, :]).reshape(-1, 9).T
    squares = [np.sum(plane**2, axis=1) + scale[:, None] ** 2 for plane in (plane_a, plane_b)]
    # Directions so far apart have a cosine of 1 - rad^2 / 2.
    near = dots > (1 - _NEAR_RAD**2 / 2) * np.sqrt(squares[0] * squares[1])
    return np.asarray(np.count_nonzero(near, axis=1))


def _agree(plane_a: FloatArray, plane_b: FloatArray, turn: FloatArray, scale: float) -> BoolArray:
    off = directions(plane_a, scale) @ turn.T - directions(plane_b, scale)
    return np.asarray(np.einsum("ni,ni->n", off, off) < _NEAR_RAD**2)


def _step(
    plane_a: FloatArray, plane_b: FloatArray, turn: FloatArray, scale: float, focal: FocalRange
) -> tuple[FloatArray, float, float]:
    """A Gauss-Newton step of the turn, and of the focal length where it is not fixed, Geman-McClure weights.

    Returns turn, focal length, and the standard deviation of the latter as a share.
    """
    a, b = directions(plane_a, scale), directions(plane_b, scale)
    turned = a @ turn.T
    off = turned - b
    weight = (_NEAR_RAD**2 / (_NEAR_RAD**2 + np.einsum("ni,ni->n", off, off))) ** 2
    # b_R_a Exp(w): the turned direction moves by -skew(turned) of the turn in b's axes.
    by_turn = -skew(turned)
    by_scale = d_directions(a, plane_a, scale) @ turn.T - d_directions(b, plane_b, scale)
    columns = [by_turn] if focal.fixed else [by_turn, by_scale[:, :, None]]
    J = np.concatenate(columns, axis=2)
    weighted = J * weight[:, None, None]
    information = np.einsum("nij,nik->jk", weighted, J) + 1e-12 * np.eye(J.shape[2])
    step = -np.linalg.solve(information, np.einsum("nij,ni->j", weighted, off))
    turn = so3_exp(step[:3]) @ turn
    if focal.fixed:
        return turn, scale, np.inf
    noise2 = np.einsum("n,ni,ni->", weight, off, off) / max(2 * weight.sum(), 1e-12)
    sigma = float(np.sqrt(np.linalg.inv(information)[3, 3] * noise2))
    return turn, float(np.clip(scale * np.exp(step[3]), focal.low, focal.high)), sigma


def _beyond_chance(agreeing: int, points: int, field: float, comparisons: int) -> bool:
    """Whether so many of the points agree on a turn that two of them fix, more than chance makes them."""
    if agreeing < _FEWEST:
        return False
    chance = np.pi * _NEAR_RAD**2 / field

    def log_choose(n: int, k: int) -> float:
        return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))

    log_alarms = (
        np.log(comparisons * points)
        + log_choose(points, agreeing)
        + log_choose(agreeing, 2)
        + (agreeing - 2) * np.log(chance)
    )
    return bool(log_alarms < np.log(_FALSE_ALARMS))
