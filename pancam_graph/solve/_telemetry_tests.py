"""How far a solution moved from its telemetry, in units of what telemetry's stated errors and images allow.

A prior's correction e has the covariance S - C if everything is as stated: S is the prior's covariance, C
that of the solution. A suspected error along a (one entry, or one offset of many entries) is tested by
|a'z| / sqrt(a'Ka) with z = S^-1 e and K = S^-1 - S^-1 C S^-1, the w-test of data snooping (Baarda 1968); the
error itself is estimated as a'z / a'Ka.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypedDict

import gtsam
import numpy as np
import scipy

from pancam_graph.base.geometry import FloatArray, IntArray, pose_arrays
from pancam_graph.elimination import Covariance, JointCovariance, Root
from pancam_graph.graph import FactorTemplate, Kind, index_of, kind_of
from pancam_graph.solve._covariance import Uncertainty
from pancam_graph.solve._problem import Problem

__all__ = [
    "MAST_ENTRIES",
    "Correction",
    "StopTelemetry",
    "Suspected",
    "corrections",
    "leg_corrections",
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
    posterior: FloatArray
    """(n, n) covariance of the solution."""

    @property
    def whitened(self) -> FloatArray:
        """(n,) corrections; their covariance would be I if images were all."""
        if self.whitening is None:
            return np.asarray(self.correction / self.sigma)
        return np.asarray(self.whitening @ self.correction)

    @cached_property
    def spread(self) -> FloatArray:
        """(n, n) covariance of `whitened` if all errors are as stated."""
        w, eye = self.whitening, np.eye(len(self.sigma))
        if w is None:
            return np.asarray(eye - self.posterior / np.outer(self.sigma, self.sigma))
        return np.asarray(eye - w @ self.posterior @ w.T)

    @cached_property
    def pull(self) -> FloatArray:
        """(n,) z = S^-1 e."""
        return self.back(self.whitened)

    @cached_property
    def shown(self) -> FloatArray:
        """(n, n) K = S^-1 - S^-1 C S^-1, the covariance of `pull`."""
        return self.back(self.back(self.spread).T)

    def back(self, m: FloatArray) -> FloatArray:
        """W' m, of W that whitens."""
        if self.whitening is None:
            return np.asarray((m.T / self.sigma).T)
        return np.asarray(self.whitening.T @ m)

    def told(self, along: FloatArray) -> FloatArray:
        """S^-1 a of an error along a (n,)."""
        if self.whitening is None:
            return np.asarray(along / self.sigma**2)
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Suspected:
    """All errors of telemetry that a solution is tested for."""

    telemetry: list[StopTelemetry]
    angles: list[Correction]
    """Of pans and tilts, single and common to a stop."""
    stops: list[Correction]
    """Of stops, and of legs."""
    root: Root
    """Square root of the system that the covariances are of."""

    @staticmethod
    def of(problem: Problem, u: Uncertainty, *, is_far: bool) -> "Suspected":
        """Those of a solution whose covariances are known; `is_far`: at expected ranges of far terrain."""
        assert u.variables is not None  # the caller has looked
        assert u.masts is not None
        telemetry = telemetry_of(problem, u.variables)
        least = _HARDLY_SHOWN if is_far else _BLIND
        single = list(corrections(telemetry, least))
        angles = [c for c in single if c.entry in {"pan", "tilt"}]
        stops = [c for c in single if c.entry not in {"pan", "tilt"}]
        stops += leg_corrections(problem, telemetry, u.masts, least)
        return Suspected(telemetry=telemetry, angles=angles, stops=stops, root=u.masts.root)


def telemetry_of(problem: Problem, covariance: Covariance) -> list[StopTelemetry]:
    """Corrections of all stops at a problem's values; `covariance` is that of its variables."""
    template, link = problem.template, problem.template.linkage
    held = link.by_group(template.held_columns().items())
    parts: dict[int, list[_Prior]] = {}
    for factor in problem.factors.telemetry:
        keys = list(factor.keys())
        kinds = [kind_of(key) for key in keys]
        if kinds != [Kind.MAST] and set(kinds) != {Kind.ANGLES}:
            continue  # a motion between two stops
        assert isinstance(factor, gtsam.NoiseModelFactor)  # every prior is one
        stop, entry, frame = _entries(template, keys)
        noise = factor.noiseModel()
        sigma = np.asarray(noise.sigmas())
        parts.setdefault(stop, []).append(
            _Prior(
                entry=entry,
                frame=frame,
                column=np.concatenate([np.arange(c.start, c.stop) for c in map(link.columns_of, keys)]),
                correction=np.asarray(factor.unwhitenedError(problem.values)),
                sigma=sigma,
                whitening=_correlated(noise),
            )
        )
    none = np.zeros(0, dtype=np.int64)
    return [_of_stop(s, of_stop, held.get(s, none), covariance) for s, of_stop in sorted(parts.items())]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Prior:
    """One prior of telemetry."""

    entry: tuple[str, ...]
    frame: IntArray
    column: IntArray
    correction: FloatArray
    sigma: FloatArray
    whitening: FloatArray | None
    """As in `StopTelemetry`."""


def _correlated(noise: gtsam.noiseModel.Base) -> FloatArray | None:
    """The whitening matrix of noise whose components are not independent."""
    if isinstance(noise, gtsam.noiseModel.Diagonal) or not isinstance(noise, gtsam.noiseModel.Gaussian):
        return None
    return np.asarray(noise.R())


def _of_stop(stop: int, priors: Sequence[_Prior], held: IntArray, covariance: Covariance) -> StopTelemetry:
    """All priors of a stop, without the `held` columns of its variables."""
    column, sigma = (np.concatenate([getattr(p, name) for p in priors]) for name in ("column", "sigma"))
    free = np.flatnonzero(~np.isin(column, held))
    whitening = None
    if any(p.whitening is not None for p in priors):
        # A held entry has no correlation with others.
        blocks = [
            np.diag(1 / np.where(p.sigma > 0, p.sigma, 1.0)) if p.whitening is None else p.whitening
            for p in priors
        ]
        whitening = np.asarray(scipy.linalg.block_diag(*blocks)[np.ix_(free, free)])
    entry = [name for p in priors for name in p.entry]
    return StopTelemetry(
        stop=stop,
        entry=tuple(entry[i] for i in free),
        frame=np.concatenate([p.frame for p in priors])[free],
        column=column[free],
        correction=np.concatenate([p.correction for p in priors])[free],
        sigma=sigma[free],
        whitening=whitening,
        posterior=covariance.block(stop, stop)[np.ix_(column[free], column[free])],
    )


def _entries(template: FactorTemplate, keys: Sequence[int]) -> tuple[int, tuple[str, ...], IntArray]:
    """Stop of some variables, and the name and frame of each of their components."""
    if kind_of(keys[0]) is Kind.MAST:
        return index_of(keys[0]), MAST_ENTRIES, np.full(6, -1)
    frames = np.concatenate([template.angle_frames(key) for key in keys])
    return int(template.traverse.frame_stop[frames[0]]), ("pan", "tilt") * len(frames), np.repeat(frames, 2)


def corrections(telemetry: Sequence[StopTelemetry], least: float = _BLIND) -> Iterator[Correction]:
    """Each entry by itself, and a common offset of the pans, and of the tilts, of each stop.

    Left out are errors of which no more than the share `least` shows in the correction.
    """
    for one in telemetry:
        n, names = len(one.entry), np.array(one.entry)
        for i in range(n):
            frame = int(one.frame[i])
            if found := _along(one, np.eye(n)[i], least):
                yield Correction(
                    entry=one.entry[i],
                    stop=one.stop,
                    frame=None if frame < 0 else frame,
                    is_common=False,
                    **found,
                )
        for name in ("pan", "tilt"):
            shape = (names == name).astype(float)
            if shape.sum() > 1 and (found := _along(one, shape, least)):
                yield Correction(entry=name, stop=one.stop, frame=None, is_common=True, **found)


class _Found(TypedDict):
    size: float
    error: float
    shown: float
    sigmas: float
    along: Mapping[int, FloatArray]


def _along(one: StopTelemetry, shape: FloatArray, least: float) -> _Found | None:
    """The test of an error along a shape (n,) of one stop's entries; None where too little of it shows."""
    shown = float(shape @ one.shown @ shape)
    if shown <= least * float(shape @ one.told(shape)):
        return None
    pull = float(shape @ one.pull)
    return _Found(
        size=float(shape @ one.correction / shape.sum()),
        error=pull / shown,
        shown=shown,
        sigmas=abs(pull) / np.sqrt(shown),
        along={one.stop: shape},
    )


def total(telemetry: Sequence[StopTelemetry]) -> tuple[float, float]:
    """RMS of all corrections over what is expected of them, and its degrees of freedom.

    The square of the first times the second is about chi-square distributed with that many degrees of
    freedom (Satterthwaite's approximation; corrections of different stops count as independent). (0, 0)
    where images say nothing of telemetry.
    """
    squares = sum(float(one.whitened @ one.whitened) for one in telemetry)
    expected = sum(float(np.trace(one.spread)) for one in telemetry)
    variance = sum(float(np.sum(one.spread**2)) for one in telemetry)
    if expected <= _BLIND or variance <= 0:
        return 0.0, 0.0
    return float(np.sqrt(squares / expected)), expected**2 / variance


def leg_corrections(
    problem: Problem, telemetry: Sequence[StopTelemetry], masts: JointCovariance, least: float = _BLIND
) -> list[Correction]:
    """A shift of all stops after a leg against all before it, for each leg; the entries are `leg x` to `z`.

    In the directions of the world's axes; `least` as for `corrections`. None in drives of fewer than two
    stops, or of very many.
    """
    stops = problem.template.traverse.stops
    n = len(stops)
    if not 2 <= n <= _MOST_STOPS:
        return []
    e, D, sigma = _positions(telemetry, masts, n)
    world_R, _ = pose_arrays([stop.world_T_mast for stop in stops])
    out = []
    for after in range(1, n):
        for axis, name in enumerate(("leg x", "leg y", "leg z")):
            shift = np.where(sigma > 0, world_R[:, axis], 0.0)
            shift[:after] = 0.0
            h = np.divide(shift, sigma, out=np.zeros_like(shift), where=sigma > 0).ravel()
            variance, along = float(h @ D @ h), dict[int, FloatArray]()
            if variance <= least * float(h @ h):
                continue
            for one in telemetry:
                if shift[one.stop].any():
                    along[one.stop] = np.zeros(len(one.entry))
                    along[one.stop][_position_rows(one)] = shift[one.stop]
            out.append(
                Correction(
                    entry=name,
                    stop=after,
                    frame=None,
                    is_common=False,
                    size=float(h @ e / (h @ h)),
                    error=float(h @ e / variance),
                    shown=variance,
                    sigmas=float(abs(h @ e) / np.sqrt(variance)),
                    along=along,
                )
            )
    return out


def _position_rows(one: StopTelemetry) -> slice:
    """Rows of a stop's x, y and z; none where telemetry holds them."""
    begin = one.entry.index("x") if "x" in one.entry else 0
    return slice(begin, begin + 3 * ("x" in one.entry))


def _positions(
    telemetry: Sequence[StopTelemetry], masts: JointCovariance, n: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Corrections of positions (3 n,) over their sigmas, their covariance if all is as stated, the sigmas.

    The sigma (n, 3) of a position that telemetry holds is 0. A position's errors depend on no others.
    """
    e, C, sigma = np.zeros((n, 3)), np.zeros((n, 3, n, 3)), np.zeros((n, 3))
    begin = np.concatenate([[0], np.cumsum(masts.root.structure.dim)])
    rows = {one.stop: _position_rows(one) for one in telemetry}
    free = [one for one in telemetry if rows[one.stop].stop]
    columns = {one.stop: one.column[rows[one.stop]] for one in free}
    for one in free:
        sigma[one.stop] = one.sigma[rows[one.stop]]
        e[one.stop] = one.correction[rows[one.stop]] / sigma[one.stop]
    for one in free:
        i, of_one = one.stop, columns[one.stop]
        inverse = masts.root.inverse_columns(i, slice(int(of_one[0]), int(of_one[-1]) + 1))
        for other in free:
            j = other.stop
            C[j, :, i] = inverse[begin[j] + columns[j]] / np.outer(sigma[j], sigma[i])
    D = -C
    for one in free:
        D[one.stop, :, one.stop] += np.eye(3)
    return e.ravel(), D.reshape(3 * n, 3 * n), sigma
