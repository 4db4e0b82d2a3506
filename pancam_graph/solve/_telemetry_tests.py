"""How far a solution moved from its telemetry, in units of what telemetry's stated errors and images allow.

A prior's correction e has the covariance S - C if everything is as stated: S is the prior's covariance, C
that of the solution. A suspected error along a (one entry, or one offset of many entries) is tested by
|a'z| / sqrt(a'Ka) with z = S^-1 e and K = S^-1 - S^-1 C S^-1, the w-test of data snooping (Baarda 1968); the
error itself is estimated as a'z / a'Ka.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, overload

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray, block_diagonal, pose_arrays
from pancam_graph.elimination import Covariance, Root
from pancam_graph.graph import FactorTemplate, Kind, index_of, kind_of
from pancam_graph.solve._covariance import Uncertainty
from pancam_graph.solve._growing_errors import GrowingErrors, growing_errors
from pancam_graph.solve._problem import Problem

__all__ = [
    "MAST_ENTRIES",
    "Correction",
    "Errors",
    "StopTelemetry",
    "Suspected",
    "entry_errors",
    "leg_errors",
    "telemetry_of",
    "total",
]

MAST_ENTRIES = ("roll", "pitch", "heading", "x", "y", "z")
"""Entries of a mast pose's tangent, in the mast's own frame."""
_BLIND = 1e-6
"""Share of an error that shows in the correction, below which images say nothing of it."""
_HARDLY_SHOWN = 0.25
"""The same share where ranges of far terrain are expected ones: the solution is then not of least variance,
and S - C is not the covariance of small corrections."""
_MOST_STOPS = 100
"""Legs are tested in drives of up to this many stops: the joint covariance of all stops is dense."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StopTelemetry:
    """Corrections of one stop's mast and angles, those entries alone that telemetry does not hold."""

    stop: int
    entry: tuple[str, ...]
    """(n,) `pan`, `tilt`, or one of `MAST_ENTRIES`."""
    frame: IntArray
    """(n,) row of the frame that an angle belongs to; -1 for entries of the mast."""
    column: IntArray
    """(n,) among the columns of the stop's group of variables."""
    correction: FloatArray
    """(n,) estimate less telemetry, radians or metres."""
    sigma: FloatArray
    """(n,) of the prior, radians or metres."""
    whitening: FloatArray | None
    """(n, n) that turns errors of telemetry to unit variance; None where they are independent."""
    by_shared: FloatArray | None
    """(n, k) Jacobian of `correction` by all variables that stops share; None where it depends on none."""
    posterior: FloatArray
    """(n, n) covariance of the solution, of the corrections."""

    @property
    def whitened(self) -> FloatArray:
        """(n,) corrections; their covariance would be I if images were all."""
        if self.whitening is None:
            return np.asarray(self.correction / self.sigma)
        return np.asarray(self.whitening @ self.correction)

    def spread(self) -> FloatArray:
        """(n, n) covariance of `whitened` if all errors are as stated."""
        w, eye = self.whitening, np.eye(len(self.sigma))
        if w is None:
            return np.asarray(eye - self.posterior / np.outer(self.sigma, self.sigma))
        return np.asarray(eye - w @ self.posterior @ w.T)

    def pull(self) -> FloatArray:
        """(n,) z = S^-1 e."""
        return self.back(self.whitened)

    def shown(self) -> FloatArray:
        """(n, n) K = S^-1 - S^-1 C S^-1, the covariance of `pull`."""
        return self.back(self.back(self.spread()).T)

    def back(self, m: FloatArray) -> FloatArray:
        """W' m, of W that whitens."""
        if self.whitening is None:
            return np.asarray((m.T / self.sigma).T)
        return np.asarray(self.whitening.T @ m)

    def moved(self, x: FloatArray, begin: IntArray) -> FloatArray:
        """(n,) changes of the corrections where all variables change by x; `begin` (groups + 1,)."""
        own = x[begin[self.stop] + self.column]
        return own if self.by_shared is None else np.asarray(own + self.by_shared @ x[begin[-2] : begin[-1]])

    def told(self, along: FloatArray) -> FloatArray:
        """S^-1 a of an error along a (n,), or of several (n, k)."""
        if self.whitening is None:
            return np.asarray((along.T / self.sigma**2).T)
        return np.asarray(self.whitening.T @ (self.whitening @ along))


@dataclass(frozen=True, kw_only=True, eq=False)
class Correction:
    """One suspected error of telemetry, and how strongly the solution speaks for it."""

    entry: str
    """As in `StopTelemetry.entry`, or `leg x`, `leg y`, `leg z`."""
    stop: int
    """Row of the stop; of a leg the one at its end."""
    frame: int | None
    """Row of the frame; None if the error is one of the stop, or common to its frames."""
    is_common: bool
    """Whether all frames of the stop share it."""
    size: float
    """Correction, radians or metres; of a common one the mean."""
    error: float
    """Estimate of the suspected error, radians or metres."""
    shown: float
    """Information on the error, one over its variance: a'Ka."""
    sigmas: float
    """Size of the test, absolute: a standard normal number if telemetry is as stated."""
    along: Mapping[int, FloatArray]
    """By stop, the suspected error's share (n,) in each entry of its `StopTelemetry`."""


class _Tested(Protocol):
    """Errors of one stop, or of all legs, that telemetry is tested for."""

    @property
    def sigmas(self) -> FloatArray:
        """(n,) as in `Correction`."""

    def correction(self, i: int) -> Correction:
        """The i-th error."""


class Errors(Sequence[Correction]):
    """Errors that telemetry is tested for; a `Correction` is made when it is asked for."""

    def __init__(self, parts: Sequence[_Tested]) -> None:
        self._parts = parts
        self._end = np.cumsum([len(part.sigmas) for part in parts])
        self.sigmas = np.concatenate([np.zeros(0), *(part.sigmas for part in parts)])
        """(n,) as in `Correction`."""

    def __len__(self) -> int:
        return len(self.sigmas)

    @overload
    def __getitem__(self, i: int) -> Correction: ...
    @overload
    def __getitem__(self, i: slice) -> Sequence[Correction]: ...
    def __getitem__(self, i: int | slice) -> Correction | Sequence[Correction]:
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(len(self)))]
        if not 0 <= i < len(self):
            raise IndexError(f"error {i} of {len(self)}")
        part = int(np.searchsorted(self._end, i, side="right"))
        return self._parts[part].correction(i - int(self._end[part]) + len(self._parts[part].sigmas))

    def __add__(self, more: "Errors") -> "Errors":
        return Errors([*self._parts, *more._parts])

    @property
    def largest(self) -> Correction:
        """The one that the solution speaks for most strongly. Raises ValueError where there is none."""
        return self[int(np.argmax(self.sigmas))]


@dataclass(frozen=True, kw_only=True, eq=False)
class Suspected:
    """All errors of telemetry that a solution is tested for."""

    telemetry: list[StopTelemetry]
    angles: Errors
    """Of pans and tilts, single and common to a stop."""
    stops: Errors
    """Of stops, and of legs."""
    growing: GrowingErrors | None
    """Of all lengths; None where telemetry holds the places of all stops."""
    root: Root
    """Square root of the system that the covariances are of."""

    @staticmethod
    def of(problem: Problem, u: Uncertainty, *, is_far: bool) -> "Suspected":
        """Those of a solution whose covariances are known; `is_far`: at expected ranges of far terrain."""
        assert u.variables is not None  # the caller has looked
        assert u.masts is not None
        telemetry, root = telemetry_of(problem, u.variables), u.masts.root
        least = _HARDLY_SHOWN if is_far else _BLIND
        angles, stops = entry_errors(telemetry, least)
        stops += leg_errors(problem, telemetry, root, least)
        growing = growing_errors(problem, root, least)
        return Suspected(telemetry=telemetry, angles=angles, stops=stops, growing=growing, root=root)


def telemetry_of(problem: Problem, covariance: Covariance) -> list[StopTelemetry]:
    """Corrections of all stops at a problem's values; `covariance` is that of its variables."""
    template, link = problem.template, problem.template.linkage
    held = template.held_by_group
    parts: dict[int, list[_Prior]] = {}
    for factor in problem.factors.telemetry:
        keys = list(factor.keys())
        kinds = [kind_of(key) for key in keys]
        own = [key for key, kind in zip(keys, kinds, strict=True) if kind is not Kind.ENCODERS]
        if kinds != [Kind.MAST] and set(map(kind_of, own)) != {Kind.ANGLES}:
            continue  # a motion between two stops
        assert isinstance(factor, gtsam.NoiseModelFactor)  # every prior is one
        stop, entry, frame = _entries(template, own)
        noise = factor.noiseModel()
        sigma = np.asarray(noise.sigmas())
        parts.setdefault(stop, []).append(
            _Prior(
                entry=entry,
                frame=frame,
                column=np.concatenate([np.arange(c.start, c.stop) for c in map(link.columns_of, own)]),
                correction=np.asarray(factor.unwhitenedError(problem.values)),
                sigma=sigma,
                whitening=_correlated(noise),
                by_shared=_by_shared(factor, problem) if len(own) < len(keys) else None,
            )
        )
    none = np.zeros(0, dtype=np.int64)
    shared = link.n_groups - 1
    return [_of_stop(s, of, held.get(s, none), covariance, shared) for s, of in sorted(parts.items())]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Prior:
    """One prior of telemetry."""

    entry: tuple[str, ...]
    frame: IntArray
    column: IntArray
    correction: FloatArray
    sigma: FloatArray
    whitening: FloatArray | None
    by_shared: FloatArray | None
    """As in `StopTelemetry`."""


def _by_shared(factor: gtsam.NoiseModelFactor, problem: Problem) -> FloatArray:
    """Jacobian (n, k) of a prior's residual by the k columns of what stops share."""
    link, keys = problem.template.linkage, list(factor.keys())
    jacobians = gtsam.JacobianVector([np.zeros((0, 0))] * len(keys))
    residual = factor.unwhitenedError(problem.values, jacobians)
    out = np.zeros((len(residual), int(link.dim[link.group == link.n_groups - 1].sum())))
    for key, jacobian in zip(keys, jacobians, strict=True):
        if kind_of(key) is Kind.ENCODERS:
            out[:, link.columns_of(key)] = jacobian
    return out


def _correlated(noise: gtsam.noiseModel.Base) -> FloatArray | None:
    """The whitening matrix of noise whose components are not independent."""
    if isinstance(noise, gtsam.noiseModel.Diagonal) or not isinstance(noise, gtsam.noiseModel.Gaussian):
        return None
    return np.asarray(noise.R())


def _of_stop(
    stop: int, priors: Sequence[_Prior], held: IntArray, covariance: Covariance, shared: int
) -> StopTelemetry:
    """All priors of a stop, without the `held` columns of its variables; `shared` is the last group."""
    column, sigma = (np.concatenate([getattr(p, name) for p in priors]) for name in ("column", "sigma"))
    free = np.flatnonzero(~np.isin(column, held)) if len(held) else np.arange(len(column))
    whitening = None
    if any(p.whitening is not None for p in priors):
        # A held entry has no correlation with others.
        blocks = [
            np.diag(1 / np.where(p.sigma > 0, p.sigma, 1.0)) if p.whitening is None else p.whitening
            for p in priors
        ]
        whitening = block_diagonal(blocks)[np.ix_(free, free)]
    entry = [name for p in priors for name in p.entry]
    posterior = covariance.block(stop, stop)[np.ix_(column[free], column[free])]
    by_shared = None
    if (k := max((p.by_shared.shape[1] for p in priors if p.by_shared is not None), default=0)) > 0:
        parts = [np.zeros((len(p.entry), k)) if p.by_shared is None else p.by_shared for p in priors]
        by_shared = np.concatenate(parts)[free]
        cross = covariance.block(stop, shared)[column[free]] @ by_shared.T
        posterior = posterior + cross + cross.T + by_shared @ covariance.block(shared, shared) @ by_shared.T
    return StopTelemetry(
        stop=stop,
        entry=tuple(entry[i] for i in free),
        frame=np.concatenate([p.frame for p in priors])[free],
        column=column[free],
        correction=np.concatenate([p.correction for p in priors])[free],
        sigma=sigma[free],
        whitening=whitening,
        by_shared=by_shared,
        posterior=posterior,
    )


def _entries(template: FactorTemplate, keys: Sequence[int]) -> tuple[int, tuple[str, ...], IntArray]:
    """Stop of some variables, and the name and frame of each of their components."""
    if kind_of(keys[0]) is Kind.MAST:
        return index_of(keys[0]), MAST_ENTRIES, np.full(6, -1)
    frames = np.concatenate([template.angle_frames(key) for key in keys])
    return int(template.traverse.frame_stop[frames[0]]), ("pan", "tilt") * len(frames), np.repeat(frames, 2)


def entry_errors(telemetry: Sequence[StopTelemetry], least: float = _BLIND) -> tuple[Errors, Errors]:
    """Each entry by itself, and a common offset of the pans, and of the tilts, of each stop.

    Those of pans and tilts, and those of stops. Left out are errors of which no more than the share `least`
    shows in the correction.
    """
    angles, stops = [], []
    for one in telemetry:
        is_angle, names = one.frame >= 0, np.array(one.entry)
        single = np.eye(len(names))
        common = [(names == name).astype(float) for name in ("pan", "tilt")]
        of_angles = np.vstack([single[is_angle], *(shape for shape in common if shape.sum() > 1)])
        z, K = one.pull(), one.shown()
        angles.append(_entry_errors(one, of_angles, z, K, least))
        stops.append(_entry_errors(one, single[~is_angle], z, K, least))
    return Errors(angles), Errors(stops)


def _entry_errors(
    one: StopTelemetry, shapes: FloatArray, z: FloatArray, K: FloatArray, least: float
) -> "_EntryErrors":
    """Errors along shapes (k, n) of a stop's entries, as far as they show.

    z (n,) and K (n, n) are the stop's `pull` and `shown`.
    """
    shown = np.einsum("ki,ki->k", shapes @ K, shapes)
    told = np.einsum("ki,ki->k", shapes, one.told(shapes.T).T)
    shows = shown > least * told
    shapes, shown = shapes[shows], shown[shows]
    return _EntryErrors(
        of=one, shape=shapes, size=shapes @ one.correction / shapes.sum(axis=1), pull=shapes @ z, shown=shown
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _ShownErrors:
    """How far k errors of telemetry show; fields as in `Correction`."""

    size: FloatArray
    pull: FloatArray
    """(k,) a'z"""
    shown: FloatArray

    @property
    def sigmas(self) -> FloatArray:
        """(k,) as in `Correction`."""
        return np.asarray(np.abs(self.pull) / np.sqrt(self.shown))


@dataclass(frozen=True, kw_only=True, eq=False)
class _EntryErrors(_ShownErrors):
    """Errors of entries of one stop's telemetry; fields as in `Correction`."""

    of: StopTelemetry
    shape: FloatArray
    """(k, n) share in each entry"""

    def correction(self, i: int) -> Correction:
        """The i-th error."""
        entries = np.flatnonzero(self.shape[i])
        frame, is_common = int(self.of.frame[entries[0]]), len(entries) > 1
        return Correction(
            entry=self.of.entry[entries[0]],
            stop=self.of.stop,
            frame=None if is_common or frame < 0 else frame,
            is_common=is_common,
            size=float(self.size[i]),
            error=float(self.pull[i] / self.shown[i]),
            shown=float(self.shown[i]),
            sigmas=float(self.sigmas[i]),
            along={self.of.stop: self.shape[i]},
        )


def total(telemetry: Sequence[StopTelemetry]) -> tuple[float, float]:
    """RMS of all corrections over what is expected of them, and its degrees of freedom.

    The square of the first times the second is about chi-square distributed with that many degrees of
    freedom (Satterthwaite's approximation; corrections of different stops count as independent). (0, 0)
    where images say nothing of telemetry.
    """
    spreads = [one.spread() for one in telemetry]
    squares = sum(float(one.whitened @ one.whitened) for one in telemetry)
    expected = sum(float(np.trace(spread)) for spread in spreads)
    variance = sum(float(np.sum(spread**2)) for spread in spreads)
    if expected <= _BLIND or variance <= 0:
        return 0.0, 0.0
    return float(np.sqrt(squares / expected)), expected**2 / variance


def leg_errors(
    problem: Problem, telemetry: Sequence[StopTelemetry], root: Root, least: float = _BLIND
) -> Errors:
    """A shift of all stops after a leg against all before it, for each leg; the entries are `leg x` to `z`.

    In the directions of the world's axes; `root` is that of the solution's system, and `least` as for
    `entry_errors`. None in drives of fewer than two stops, or of very many.
    """
    stops = problem.template.traverse.stops
    n = len(stops)
    if not 2 <= n <= _MOST_STOPS:
        return Errors([])
    world_R, _ = pose_arrays([stop.world_T_mast for stop in stops])
    # By leg and axis, in the order of the legs: whitened shifts of all positions, and of all columns.
    begin = np.concatenate([[0], np.cumsum(root.structure.dim)])
    shifts, columns = np.zeros((n - 1, 3, n, 3)), np.zeros((int(begin[-1]), n - 1, 3))
    correction = np.zeros((n, 3))
    for one in telemetry:
        s, rows = one.stop, _position_rows(one)
        if not rows.stop:
            continue
        sigma = one.sigma[rows]
        correction[s] = one.correction[rows] / sigma
        shifts[:s, :, s] = world_R[s] / sigma
        columns[begin[s] + one.column[rows], :s] = (world_R[s] / sigma**2).T[:, None]
    h = shifts.reshape(-1, 3 * n)
    told = np.einsum("ki,ki->k", h, h)
    # A position's errors depend on no others, so that D = I - C of whitened corrections.
    half = root.forward(columns.reshape(len(columns), len(h)))
    shown = told - np.einsum("ik,ik->k", half, half)
    leg = np.flatnonzero(shown > least * told)
    pull = (h @ correction.ravel())[leg]
    return Errors(
        [
            _LegErrors(
                telemetry=telemetry,
                world_R=world_R,
                leg=leg,
                size=pull / told[leg],
                pull=pull,
                shown=shown[leg],
            )
        ]
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _LegErrors(_ShownErrors):
    """Shifts of all stops after a leg; fields as in `Correction`."""

    telemetry: Sequence[StopTelemetry]
    world_R: FloatArray
    """(stops, 3, 3) of the masts as telemetry has them"""
    leg: IntArray
    """(k,) three times the row of the stop before, and the axis"""

    def correction(self, i: int) -> Correction:
        """The i-th error."""
        before, axis = divmod(int(self.leg[i]), 3)
        along = {}
        for one in self.telemetry:
            rows = _position_rows(one)
            if one.stop > before and rows.stop:
                along[one.stop] = np.zeros(len(one.entry))
                along[one.stop][rows] = self.world_R[one.stop][axis]
        return Correction(
            entry=("leg x", "leg y", "leg z")[axis],
            stop=before + 1,
            frame=None,
            is_common=False,
            size=float(self.size[i]),
            error=float(self.pull[i] / self.shown[i]),
            shown=float(self.shown[i]),
            sigmas=float(self.sigmas[i]),
            along=along,
        )


def _position_rows(one: StopTelemetry) -> slice:
    """Rows of a stop's x, y and z; none where telemetry holds them."""
    begin = one.entry.index("x") if "x" in one.entry else 0
    return slice(begin, begin + 3 * ("x" in one.entry))
