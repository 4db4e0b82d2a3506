"""A cross-validation as an entry of `solution.json`; null in place of what is not finite."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import CrossValidation, Sigmas, Splitting, Spread, Traverse
from pancam_graph.io import Entry

__all__ = ["CrossValidationEntry"]


class SpreadEntry(Entry):
    """Scatter of a number between solutions of halves, for one way of halving."""

    sigma: float | None
    ratio: float | None
    """RMS step from the whole solution to a half's over its formal sigma; null where telemetry decides."""
    difference: float | None
    """Difference between the solutions of the two halves; RMS over the halvings."""


class SigmaEntry(Entry):
    """Standard deviations of a number, in its unit."""

    formal: float | None
    honest: float | None
    random: SpreadEntry
    upper_lower: SpreadEntry


class FrameSigmasEntry(Entry):
    """Sigmas of a frame's angles."""

    id: str
    pan_rad: SigmaEntry
    tilt_rad: SigmaEntry


class PairSigmasEntry(Entry):
    """Sigmas of the angles of a frame less those of another."""

    frames: list[str]
    """Ids of the two frames."""
    tracks: int
    """Number of tracks that both frames see."""
    pan_rad: SigmaEntry
    tilt_rad: SigmaEntry


class StopSigmasEntry(Entry):
    """Sigmas of a mast pose in the body frame, by axis."""

    id: str
    rotation_rad: list[SigmaEntry]
    translation_m: list[SigmaEntry]


class HalfScoreEntry(Entry):
    """Tracks of one half, placed with its own cameras and with those of the other half; RMS, pixels."""

    splitting: Splitting
    halving: int
    half: Literal["first", "second", "upper", "lower"]
    tracks: int
    scored: int
    observations: int
    own_px: float | None
    own_expected_px: float | None
    other_px: float | None
    other_expected_px: float | None


class CrossValidationEntry(Entry):
    """`cross_validation` of `solution.json`."""

    halvings: int
    seed: int
    seconds: float
    frames: list[FrameSigmasEntry]
    pairs: list[PairSigmasEntry]
    stops: list[StopSigmasEntry]
    scores: list[HalfScoreEntry]
    warnings: list[str]

    @staticmethod
    def of(validation: CrossValidation, traverse: Traverse) -> "CrossValidationEntry":
        """The entry of a cross-validation of a traverse."""
        ids = [f.id for f in traverse.frames]
        return CrossValidationEntry(
            halvings=validation.halvings,
            seed=validation.seed,
            seconds=validation.seconds,
            frames=[
                FrameSigmasEntry(id=name, pan_rad=pan, tilt_rad=tilt)
                for name, (pan, tilt) in zip(ids, _entries(validation.pointing), strict=True)
            ],
            pairs=[
                PairSigmasEntry(frames=[ids[i], ids[j]], tracks=int(n), pan_rad=pan, tilt_rad=tilt)
                for (i, j), n, (pan, tilt) in zip(
                    validation.pairs.tolist(),
                    validation.pair_tracks,
                    _entries(validation.relative_pointing),
                    strict=True,
                )
            ],
            stops=[
                StopSigmasEntry(id=stop.id, rotation_rad=list(row[:3]), translation_m=list(row[3:]))
                for stop, row in zip(traverse.stops, _entries(validation.stops), strict=True)
            ],
            scores=[
                HalfScoreEntry(
                    splitting=s.splitting,
                    halving=s.halving,
                    half=s.half,
                    tracks=s.tracks,
                    scored=s.scored,
                    observations=s.observations,
                    own_px=_number(s.own_px),
                    own_expected_px=_number(s.own_expected_px),
                    other_px=_number(s.other_px),
                    other_expected_px=_number(s.other_expected_px),
                )
                for s in validation.scores
            ],
            warnings=list(validation.warnings),
        )


def _entries(sigmas: Sigmas) -> list[Sequence[SigmaEntry]]:
    """Entries of n things, each of k numbers."""

    def columns(spread: Spread) -> list[FloatArray]:
        return [spread.sigma, spread.ratio, spread.difference]

    table = np.stack(
        [sigmas.formal, sigmas.honest, *columns(sigmas.random), *columns(sigmas.upper_lower)], axis=-1
    )
    return [[_entry(*numbers) for numbers in row] for row in table.tolist()]


def _entry(formal: float, honest: float, *spreads: float) -> SigmaEntry:
    random, upper_lower = (
        SpreadEntry(sigma=_number(s), ratio=_number(r), difference=_number(d))
        for s, r, d in (spreads[:3], spreads[3:])
    )
    return SigmaEntry(formal=_number(formal), honest=_number(honest), random=random, upper_lower=upper_lower)


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
