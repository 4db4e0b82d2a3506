"""Pans, tilts, rolls of mounts and focal lengths that bring the points of pairs of pictures together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, axes_across, pan_tilt_rotation, rx
from pancam_graph.images.pointing._pair_turns import PairTurn
from pancam_graph.images.pointing._two_points import d_directions, directions
from pancam_graph.rigs import Rig

__all__ = ["HeadFit", "HeadState", "Points", "Priors", "agreeing", "fit_head", "residuals"]

_MOST_POINTS = 80
"""Points of a pair that are used."""
_WORTH = 20
"""How many points a pair counts as: their errors, of lens and of features, are alike."""
_NOISE_RAD = 1e-3
_INVERSE_DEPTH, _SPREAD = 0.1, 0.5
"""Start and root mean square of the inverse depths of points, per metre: they are the scale of the scene."""
_NEAREST = 2.0
"""Largest inverse depth, per metre."""
_BEYOND = -0.1
"""Least one, beyond infinity: errors of far points have both signs, and a bound at 0 bends focal lengths."""
_OUTLIER = 3.0
"""Scale of the Cauchy weights, in standard deviations."""
_WIDENINGS = (40.0, 20.0, 10.0, 5.0, 2.0, 1.0)
"""Factors of that scale, from what a ring that does not close yet leaves."""
_NEAR_WIDENINGS = (2.0, 1.0)
"""The same from a fit of the same pictures on."""
_STEPS = 30
_DAMPING, _MOST_DAMPING = 1e-4, 1e6
"""First and last share of the information's diagonal that is added to it."""
_SAME_COST = 1e-5
"""Share of the cost by which a step must lower it, for another to follow."""
_DEPTH_STEPS = 5
_GAUGE_RAD = 1e-6
_AGREES = 5.0
"""Median of the residuals of a pair, in standard deviations, up to which it belongs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadState:
    """What is sought."""

    pan_rad: FloatArray
    """(frames,)"""
    tilt_rad: FloatArray
    """(frames,)"""
    roll_rad: FloatArray
    """(eyes,) turn of each mount about the head's forward axis, over what the rig says."""
    log_scale: FloatArray
    """(eyes,) logarithm of each focal length over the told one."""
    shift_m: FloatArray
    """(eyes, 3) shift of each mount, along the head's axes, over what the rig says."""

    @staticmethod
    def of(pan_rad: FloatArray, tilt_rad: FloatArray, log_scale: FloatArray) -> "HeadState":
        """A state with the mounts as told."""
        eyes = len(log_scale)
        return HeadState(
            pan_rad=pan_rad,
            tilt_rad=tilt_rad,
            roll_rad=np.zeros(eyes),
            log_scale=log_scale,
            shift_m=np.zeros((eyes, 3)),
        )

    def moved(self, step: FloatArray) -> "HeadState":
        """The state after a step, pans first."""
        frames, eyes = len(self.pan_rad), len(self.roll_rad)
        pan, tilt, roll, scale, shift = np.split(step, np.cumsum([frames, frames, eyes, eyes]))
        return HeadState(
            pan_rad=self.pan_rad + pan,
            tilt_rad=self.tilt_rad + tilt,
            roll_rad=self.roll_rad + roll,
            log_scale=self.log_scale + scale,
            shift_m=self.shift_m + shift.reshape(eyes, 3),
        )

    def over_the_rig(self) -> FloatArray:
        """What each number exceeds the rig's by, in the order of `moved`; 0 for pans and tilts."""
        angles = np.zeros(2 * len(self.pan_rad))
        return np.concatenate([angles, self.roll_rad, self.log_scale, self.shift_m.ravel()])


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """Points that pairs of pictures share: n rows."""

    plane: tuple[FloatArray, FloatArray]
    """(n, 2) in the planes z = 1 of either picture, by the told focal length."""
    frame: tuple[IntArray, IntArray]
    eye: tuple[IntArray, IntArray]
    pair: IntArray
    """(n,) which pair."""
    worth: FloatArray
    """(n,) weight of a point among those of its pair."""

    @staticmethod
    def of(pairs: Sequence[PairTurn], frame: IntArray, eye: IntArray, most: int = _MOST_POINTS) -> "Points":
        """Of pairs of pictures with the numbers of their frames and eyes, at most so many of each."""
        chosen = []
        for pair in pairs:
            every = max(1, -(-len(pair.plane_a) // most))
            chosen.append(np.arange(0, len(pair.plane_a), every))
        sizes = [len(rows) for rows in chosen]
        of = np.repeat(np.arange(len(pairs)), sizes)
        a, b = (np.array([getattr(p, name) for p in pairs])[of] for name in ("a", "b"))
        return Points(
            plane=(
                np.concatenate([p.plane_a[rows] for p, rows in zip(pairs, chosen, strict=True)]),
                np.concatenate([p.plane_b[rows] for p, rows in zip(pairs, chosen, strict=True)]),
            ),
            frame=(frame[a], frame[b]),
            eye=(eye[a], eye[b]),
            pair=of,
            worth=np.minimum(1.0, _WORTH / np.array(sizes, dtype=float))[of],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadFit:
    """The best state and how well it is known."""

    state: HeadState
    sigma: HeadState
    """Standard deviations of each number, in the gauge of the first frame's pan."""
    wrong: IntArray
    """Pairs whose points do not come together."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Looks:
    """Where points are seen from one side: n lines of sight in the mast frame, and how they move."""

    direction: FloatArray
    """(n, 3)"""
    d_direction: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    """(n, 3) each by pan, tilt, roll, logarithm of the scale."""
    centre_m: FloatArray
    """(n, 3)"""
    d_centre: tuple[FloatArray, FloatArray, FloatArray]
    """By pan and tilt (n, 3), and by the shift of the mount (n, 3, 3)."""

    @staticmethod
    def of(rig: Rig, state: HeadState, points: Points, side: int) -> "_Looks":
        frame, eye, plane = points.frame[side], points.eye[side], points.plane[side]
        axis = rig.pan_T_tilt.rotation().matrix()
        pan = pan_tilt_rotation(state.pan_rad[frame], 0.0)
        stage = pan @ axis
        head = stage @ pan_tilt_rotation(0.0, state.tilt_rad[frame])
        rolled = np.array([rx(roll) for roll in state.roll_rad])
        mounts = rolled @ np.array([e.head_T_camera.rotation().matrix() for e in rig.eyes])
        arms = np.array([e.head_T_camera.translation() for e in rig.eyes]) + state.shift_m
        mast_R_camera = head @ mounts[eye]
        scale = np.exp(state.log_scale)[eye]
        rays = directions(plane, scale)
        direction = (mast_R_camera @ rays[:, :, None])[:, :, 0]
        by_scale = (mast_R_camera @ d_directions(rays, plane, scale)[:, :, None])[:, :, 0]
        arm = (head @ arms[eye][:, :, None])[:, :, 0]
        centre = (pan @ rig.pan_T_tilt.translation()) + arm
        up = np.array([0.0, 0.0, 1.0])
        tilt_axis = -stage[:, :, 1]
        return _Looks(
            direction=direction,
            d_direction=(
                np.cross(up, direction),
                np.cross(tilt_axis, direction),
                np.cross(head[:, :, 0], direction),
                by_scale,
            ),
            centre_m=centre,
            d_centre=(np.cross(up, centre), np.cross(tilt_axis, arm), head),
        )


def residuals(
    rig: Rig, state: HeadState, points: Points, inverse_depth: FloatArray, axes: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences (n, 2) of the directions in which either picture sees a point, over their noise.

    `inverse_depth` (n,) is from the first picture, per metre; `axes` (n, 2, 3) are those along which
    directions are compared. Returns also the Jacobian (n, 2, 2 frames + 5 eyes) by pans, tilts, rolls,
    logarithms of scales and shifts, and that by the inverse depth (n, 2).
    """
    n, frames, eyes = len(points.pair), len(state.pan_rad), len(rig.eyes)
    a, b = (_Looks.of(rig, state, points, side) for side in (0, 1))
    apart = a.centre_m - b.centre_m
    towards = a.direction + inverse_depth[:, None] * apart
    length = np.linalg.norm(towards, axis=1, keepdims=True)
    seen = towards / length
    off = (axes @ (seen - b.direction)[:, :, None])[:, :, 0] / _NOISE_RAD
    # How the direction from b moves with that from a, and with the centres.
    across = axes - (axes @ seen[:, :, None]) * seen[:, None, :]
    across = across / (length[:, :, None] * _NOISE_RAD)
    J = np.zeros((n, 2, 2 * frames + 5 * eyes))
    rows = np.arange(n)
    nearness = inverse_depth[:, None]
    for looks, sign, side in ((a, 1.0, 0), (b, -1.0, 1)):
        frame, eye = points.frame[side], points.eye[side]
        columns = (frame, frames + frame, 2 * frames + eye, 2 * frames + eyes + eye)
        for k, (column, turned) in enumerate(zip(columns, looks.d_direction, strict=True)):
            if side == 0:
                J[rows, :, column] += (across @ turned[:, :, None])[:, :, 0]
            else:
                J[rows, :, column] -= (axes @ turned[:, :, None])[:, :, 0] / _NOISE_RAD
            if k < 2:
                moved = sign * nearness * looks.d_centre[k]
                J[rows, :, column] += (across @ moved[:, :, None])[:, :, 0]
        shifted = sign * nearness[:, :, None] * (across @ looks.d_centre[2])
        for k in range(3):
            J[rows, :, 2 * frames + 2 * eyes + 3 * eye + k] += shifted[:, :, k]
    return off, J, (across @ apart[:, :, None])[:, :, 0]


@dataclass(frozen=True, kw_only=True, eq=False)
class _System:
    """The linearised problem, points eliminated."""

    off: FloatArray
    weight: FloatArray
    information: FloatArray
    gradient: FloatArray
    J: FloatArray
    by_depth: FloatArray
    per_depth: FloatArray
    """(n,) variance of each inverse depth by itself; 0 where it stays at the end of its range."""
    depth_gradient: FloatArray
    cost: float
    """Cauchy's, with that of the inverse depths."""

    @staticmethod
    def of(rig: Rig, state: HeadState, points: Points, inverse_depth: FloatArray, scale: float) -> "_System":
        looks = _Looks.of(rig, state, points, 1).direction
        off, J, by_depth = residuals(rig, state, points, inverse_depth, axes_across(looks))
        square = np.einsum("ni,ni->n", off, off) / scale**2
        weight = points.worth / (1 + square)
        cost = points.worth @ (scale**2 * np.log1p(square) + (inverse_depth / _SPREAD) ** 2)
        depth_information = weight * np.einsum("ni,ni->n", by_depth, by_depth) + points.worth / _SPREAD**2
        depth_gradient = (
            weight * np.einsum("ni,ni->n", by_depth, off) + points.worth * inverse_depth / _SPREAD**2
        )
        held = (inverse_depth <= _BEYOND) & (depth_gradient > 0)
        held |= (inverse_depth >= _NEAREST) & (depth_gradient < 0)
        per_depth = np.where(held, 0.0, 1 / depth_information)
        # Each point's inverse depth is eliminated (Schur complement of a diagonal block).
        coupled = weight[:, None] * np.einsum("nij,ni->nj", J, by_depth)
        weighted = J * weight[:, None, None]
        flat = J.reshape(-1, J.shape[2])
        information = weighted.reshape(flat.shape).T @ flat
        information -= (coupled * per_depth[:, None]).T @ coupled
        gradient = np.einsum("nij,ni->j", weighted, off) - coupled.T @ (depth_gradient * per_depth)
        return _System(
            off=off,
            weight=weight,
            information=information,
            gradient=gradient,
            J=J,
            by_depth=by_depth,
            per_depth=per_depth,
            depth_gradient=depth_gradient,
            cost=float(cost),
        )

    def depth_step(self, step: FloatArray) -> FloatArray:
        """Change (n,) of the inverse depths that goes with a step of the state."""
        moved = self.weight * np.einsum("ni,nij,j->n", self.by_depth, self.J, step)
        return np.asarray(-(self.depth_gradient + moved) * self.per_depth)


@dataclass(frozen=True, kw_only=True)
class Priors:
    """How well the rig is known: standard deviations, 0 holds."""

    roll_rad: float
    scale: float
    shift_m: float


def fit_head(rig: Rig, start: HeadState, points: Points, priors: Priors, *, near: bool = False) -> HeadFit:
    """The state at which most points come together; the first frame's pan stays.

    Points are some metres away, each at a distance of its own, so that those beside the arms' directions tell
    these too. Weights are Cauchy's, whose scale shrinks: a ring that does not close yet is not taken for
    wrong pairs; `near` says that the start closes it. Exact without noise and at known distances; else
    distances and arms have one scale in common, which their priors settle.
    """
    frames, eyes = len(start.pan_rad), len(rig.eyes)
    sigma = np.concatenate(
        [
            [_GAUGE_RAD],
            np.full(2 * frames - 1, 1e4),
            np.full(eyes, priors.roll_rad),
            np.full(eyes, priors.scale),
            np.full(3 * eyes, priors.shift_m),
        ]
    )
    free = sigma > 0
    prior = np.where(free, 1 / np.where(free, sigma, 1.0), 0.0) ** 2
    state, inverse_depth = start, np.full(len(points.pair), _INVERSE_DEPTH)
    for widening in _NEAR_WIDENINGS if near else _WIDENINGS:
        state, inverse_depth = _descended(rig, state, points, inverse_depth, prior, widening * _OUTLIER)
    system = _System.of(rig, state, points, inverse_depth, _OUTLIER)
    information = system.information + np.diag(prior)
    variance = np.zeros(len(prior))
    variance[free] = np.diag(np.linalg.inv(information[np.ix_(free, free)]))
    length = np.linalg.norm(system.off, axis=1)
    noise2 = max(1.0, float(np.sum(system.weight * length**2) / max(2 * np.sum(system.weight), 1e-12)))
    zero = replace(start, **{name: np.zeros_like(value) for name, value in vars(start).items()})
    typical = np.array([np.median(length[points.pair == k]) for k in range(points.pair.max() + 1)])
    return HeadFit(
        state=state, sigma=zero.moved(np.sqrt(variance * noise2)), wrong=np.flatnonzero(typical > _AGREES)
    )


def _descended(
    rig: Rig, state: HeadState, points: Points, inverse_depth: FloatArray, prior: FloatArray, scale: float
) -> tuple[HeadState, FloatArray]:
    """State and inverse depths at the least cost with one scale of the weights (Levenberg-Marquardt).

    `prior` is the information of each number of the state about the rig as told; 0 holds it.
    """
    free, damping = prior > 0, _DAMPING
    system = _System.of(rig, state, points, inverse_depth, scale)
    told = state.over_the_rig()
    cost = system.cost + prior @ told**2
    for _ in range(_STEPS):
        information = (system.information + np.diag(prior))[np.ix_(free, free)]
        damped = information + damping * np.diag(np.diag(information))
        step = np.zeros(len(prior))
        step[free] = -np.linalg.solve(damped, (system.gradient + prior * told)[free])
        moved = state.moved(step)
        depth_moved = np.clip(inverse_depth + system.depth_step(step), _BEYOND, _NEAREST)
        tried = _System.of(rig, moved, points, depth_moved, scale)
        tried_cost = tried.cost + prior @ moved.over_the_rig() ** 2
        if tried_cost >= cost:
            damping *= 10.0
            if damping > _MOST_DAMPING:
                break
            continue
        done = cost - tried_cost < _SAME_COST * cost
        state, inverse_depth, system, cost = moved, depth_moved, tried, tried_cost
        told, damping = state.over_the_rig(), damping / 10.0
        if done:
            break
    return state, inverse_depth


def agreeing(rig: Rig, state: HeadState, points: Points) -> BoolArray:
    """Which points (n,) come together at some distance, within a few standard deviations."""
    looks = _Looks.of(rig, state, points, 1).direction
    axes = axes_across(looks)
    inverse_depth = np.full(len(points.pair), _INVERSE_DEPTH)
    for _ in range(_DEPTH_STEPS):
        off, _J, by_depth = residuals(rig, state, points, inverse_depth, axes)
        slope = np.einsum("ni,ni->n", by_depth, by_depth)
        step = -np.einsum("ni,ni->n", by_depth, off) / np.maximum(slope, 1e-9)
        inverse_depth = np.clip(inverse_depth + np.where(slope > 1, step, 0.0), 0.0, _NEAREST)
    off, _J, _d = residuals(rig, state, points, inverse_depth, axes)
    return np.asarray(np.linalg.norm(off, axis=1) < _OUTLIER)
