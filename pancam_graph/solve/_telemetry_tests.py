"""How far a solution moved from its telemetry, in units of what telemetry's stated errors and images allow.

A prior's correction e, in units of its sigma, has the covariance D = I - S^-1 C S^-1 if everything is as
stated: S has the sigmas, C is the covariance of the solution. A suspected error of the form h (one entry, or
one offset of many entries) is tested by |h'e| / sqrt(h'Dh), the w-test of data snooping (Baarda 1968); for
errors of independent telemetry it is the most powerful one.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray, pose_arrays
from pancam_graph.elimination import Covariance, JointCovariance
from pancam_graph.graph import FactorTemplate, Kind, index_of, kind_of
from pancam_graph.solve._problem import Problem

__all__ = [
    "Correction",
    "StopTelemetry",
    "corrections",
    "leg_corrections",
    "telemetry_of",
    "total",
]

MAST_ENTRIES = ("roll", "pitch", "heading", "x", "y", "z")
"""Entries of a mast pose's tangent, in the mast's own frame."""
_BLIND = 1e-6
"""Variance of a correction, in units of the prior's, below which images say nothing of the entry."""
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
    sigma: FloatArray
    """(n,) of the prior, radians or metres."""
    whitened: FloatArray
    """(n,) corrections in units of their sigmas."""
    spread: FloatArray
    """(n, n) covariance of `whitened` if all errors are as stated."""


@dataclass(frozen=True, kw_only=True)
class Correction:
    """One suspected error of telemetry, and how strongly the solution speaks for it."""

    entry: str
    """As in `StopTelemetry.entry`."""
    stop: int
    frame: int | None
    """Row of the frame; None if the error is one of the stop, or common to its frames."""
    is_common: bool
    """Whether all frames of the stop share it."""
    size: float
    """Correction, radians or metres; of a common one the mean."""
    sigmas: float
    """Size of the test, absolute: a standard normal number if telemetry is as stated."""


def telemetry_of(problem: Problem, covariance: Covariance) -> list[StopTelemetry]:
    """Corrections of all stops at a problem's values; `covariance` is that of its variables."""
    template = problem.template
    found: dict[int, list[tuple[int, tuple[str, ...], IntArray, FloatArray, FloatArray]]] = {}
    for factor in problem.factors.telemetry:
        keys = list(factor.keys())
        if len(keys) != 1 or kind_of(keys[0]) not in {Kind.MAST, Kind.ANGLES}:
            continue  # a motion between two stops
        assert isinstance(factor, gtsam.NoiseModelFactor)  # every prior is one
        stop, entry, frame = _entries(template, keys[0])
        sigma = np.asarray(factor.noiseModel().sigmas())
        found.setdefault(stop, []).append(
            (keys[0], entry, frame, sigma, np.asarray(factor.unwhitenedError(problem.values)))
        )
    out = []
    for stop, parts in sorted(found.items()):
        link = template.linkage
        columns = np.concatenate([np.arange(c.start, c.stop) for p in parts for c in [link.columns_of(p[0])]])
        entry = tuple(name for p in parts for name in p[1])
        frame, sigma, error = (np.concatenate([p[k] for p in parts]) for k in (2, 3, 4))
        free = np.flatnonzero(sigma > 0)
        columns, sigma = columns[free], sigma[free]
        block = covariance.block(stop, stop)[np.ix_(columns, columns)]
        out.append(
            StopTelemetry(
                stop=stop,
                entry=tuple(entry[i] for i in free),
                frame=frame[free],
                sigma=sigma,
                whitened=error[free] / sigma,
                spread=np.eye(len(free)) - block / np.outer(sigma, sigma),
            )
        )
    return out


def _entries(template: FactorTemplate, key: int) -> tuple[int, tuple[str, ...], IntArray]:
    """Stop of a variable, and the name and frame of each of its components."""
    if kind_of(key) is Kind.MAST:
        return index_of(key), MAST_ENTRIES, np.full(6, -1)
    frames = template.angle_frames(key)
    return int(template.traverse.frame_stop[frames[0]]), ("pan", "tilt") * len(frames), np.repeat(frames, 2)


def corrections(telemetry: Sequence[StopTelemetry]) -> Iterator[Correction]:
    """Each entry by itself, and a common offset of the pans, and of the tilts, of each stop."""
    for one in telemetry:
        variance = np.diag(one.spread)
        for i in np.flatnonzero(variance > _BLIND):
            frame = int(one.frame[i])
            yield Correction(
                entry=one.entry[i],
                stop=one.stop,
                frame=None if frame < 0 else frame,
                is_common=False,
                size=float(one.whitened[i] * one.sigma[i]),
                sigmas=float(abs(one.whitened[i]) / np.sqrt(variance[i])),
            )
        for name in ("pan", "tilt"):
            rows = np.flatnonzero(np.array(one.entry) == name)
            if len(rows) < 2:
                continue
            shape = 1 / one.sigma[rows]
            shape /= np.linalg.norm(shape)
            variance_of_offset = float(shape @ one.spread[np.ix_(rows, rows)] @ shape)
            if variance_of_offset <= _BLIND:
                continue
            yield Correction(
                entry=name,
                stop=one.stop,
                frame=None,
                is_common=True,
                size=float(np.mean(one.whitened[rows] * one.sigma[rows])),
                sigmas=float(abs(shape @ one.whitened[rows]) / np.sqrt(variance_of_offset)),
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


def leg_corrections(problem: Problem, masts: JointCovariance) -> list[Correction]:
    """A shift of all stops after a leg against all before it, for each leg; the entries are `leg x` to `z`.

    In the directions of the world's axes. None in drives of fewer than two free stops, or of very many.
    """
    stops = problem.template.traverse.stops
    n = len(stops)
    if not 2 <= n <= _MOST_STOPS:
        return []
    e, D, world_R = _positions(problem, masts)
    sigma = np.array([stop.sigma_translation_m for stop in stops])
    out = []
    for after in range(1, n):
        for axis, name in enumerate(("leg x", "leg y", "leg z")):
            shape = np.zeros((n, 3))
            later = np.flatnonzero(sigma[after:] > 0) + after
            shape[later] = world_R[later][:, axis] / sigma[later, None]
            h = shape.ravel()
            if not h.any():
                continue
            h /= np.linalg.norm(h)
            variance = float(h @ D @ h)
            if variance > _BLIND:
                out.append(
                    Correction(
                        entry=name,
                        stop=after,
                        frame=None,
                        is_common=False,
                        size=float(h @ e / np.linalg.norm(shape)),
                        sigmas=float(abs(h @ e) / np.sqrt(variance)),
                    )
                )
    return out


def _positions(problem: Problem, masts: JointCovariance) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Corrections of all positions (3 stops,), their covariance if all is as stated, and world_R_mast."""
    stops, values = problem.template.traverse.stops, problem.values
    n = len(stops)
    world_R, _ = pose_arrays([stop.world_T_mast for stop in stops])
    e, C = np.zeros((n, 3)), np.zeros((n, 3, n, 3))
    begin = np.concatenate([[0], np.cumsum(masts.root.structure.dim)])
    sigma = np.array([stop.sigma_translation_m for stop in stops])
    free = [i for i, place in enumerate(masts.places) if place is not None and sigma[i] > 0]
    estimated = problem.template.masts(values)
    for i in free:
        place = masts.places[i]
        assert place is not None  # as `free` says
        start = place.columns.start
        columns = masts.root.inverse_columns(place.group, slice(start + 3, start + 6))
        e[i] = stops[i].world_T_mast.localCoordinates(estimated[i])[3:] / sigma[i]
        for j in free:
            other = masts.places[j]
            assert other is not None  # as `free` says
            first = int(begin[other.group]) + other.columns.start + 3
            C[j, :, i] = columns[first : first + 3] / (sigma[i] * sigma[j])
    D = -C
    for i in free:
        D[i, :, i] += np.eye(3)
    return e.ravel(), D.reshape(3 * n, 3 * n), world_R
