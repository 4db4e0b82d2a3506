"""What of a traverse's telemetry was let go, in numbers and in words."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import IntArray, wrap_angle
from pancam_graph.data import State, Traverse
from pancam_graph.graph import LetGo
from pancam_graph.solve._telemetry_tests import MAST_ENTRIES, Correction

__all__ = ["Part", "letting_go", "most_let_go", "parts_let_go", "sentence"]

_WIDER = 3.0
"""Sigma that telemetry is let go to, in units of its estimated error: the prior then hardly pulls. Of several
errors that look alike each is as large as its estimate at most: there it is 1."""
_FEW = 3
"""Parts of telemetry that may be let go in any drive ..."""
_SHARE = 0.1
"""... and the share of its entries in long ones."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of telemetry that was let go."""

    what: str
    """In words: `the pan of frame00004`."""
    size: float
    """Estimate less telemetry, radians or metres; of several entries the mean; of a shift its length."""
    sigma: float
    """Of that, as telemetry states it."""
    is_length: bool
    """Whether it is in metres."""


def letting_go(traverse: Traverse, errors: Sequence[Correction]) -> LetGo:
    """The priors to let go where telemetry has the suspected errors, or some of them."""
    out = LetGo.nothing(traverse)
    for c in errors:
        sigma = (_WIDER if len(errors) == 1 else 1.0) * abs(c.error)
        if c.entry in {"pan", "tilt"}:
            k = int(c.entry == "tilt")
            where = out.common_rad if c.is_common else out.angles_rad
            row = c.stop if c.frame is None else c.frame
            where[row, k] = max(where[row, k], sigma)
            continue
        # Of a leg all later stops: what they share is to have that sigma.
        stops = sorted(c.along)
        sigma *= np.sqrt(len(stops))
        entries = {"heading": [2], "roll": [0, 1], "pitch": [0, 1]}.get(c.entry, [3, 4, 5])
        place = np.ix_(stops, entries)
        out.stops[place] = np.maximum(out.stops[place], sigma)
    return out


def most_let_go(traverse: Traverse) -> int:
    """How many parts of a traverse's telemetry may be let go before nothing of it is believed."""
    return max(_FEW, int(_SHARE * (2 * len(traverse.frames) + 6 * len(traverse.stops))))


def parts_let_go(traverse: Traverse, let_go: LetGo, state: State) -> list[Part]:
    """What was let go, at a state; stops whose positions were let go one after the other are one part."""
    if not let_go:
        return []
    return [*_angles(traverse, let_go, state), *_stops(traverse, let_go, state)]


def _angles(t: Traverse, let_go: LetGo, state: State) -> Iterator[Part]:
    moved = np.asarray(wrap_angle(state.pan_tilt_rad - t.pan_tilt_rad))
    sigmas = t.pan_tilt_sigmas_rad
    for k, name in enumerate(("pan", "tilt")):
        for f in np.flatnonzero(let_go.angles_rad[:, k]):
            yield Part(
                what=f"the {name} of {t.frames[f].id}",
                size=float(moved[f, k]),
                sigma=float(sigmas[f, k]),
                is_length=False,
            )
        for s in np.flatnonzero(let_go.common_rad[:, k]):
            frames = (t.frame_stop == s) & (sigmas[:, k] > 0)
            yield Part(
                what=f"every {name} at {t.stops[s].id}, in common,",
                size=float(np.mean(moved[frames, k])),
                sigma=float(np.mean(sigmas[frames, k]) / np.sqrt(frames.sum())),
                is_length=False,
            )


def _stops(t: Traverse, let_go: LetGo, state: State) -> Iterator[Part]:
    pairs = [(stop.world_T_mast, pose) for stop, pose in zip(t.stops, state.world_T_mast, strict=True)]
    moved = np.array([told.localCoordinates(pose) for told, pose in pairs])
    shift = np.array([pose.translation() - told.translation() for told, pose in pairs])
    for s, stop in enumerate(t.stops):
        for k in np.flatnonzero(let_go.stops[s, :3]):
            what = f"the {MAST_ENTRIES[k]} of {stop.id}"
            yield Part(what=what, size=float(moved[s, k]), sigma=stop.sigma_rotation_rad, is_length=False)
    for run in _runs(np.flatnonzero(let_go.stops[:, 3:].any(axis=1))):
        ids = [t.stops[s].id for s in run]
        yield Part(
            what=f"the position of {ids[0]}" + (f" and of all stops up to {ids[-1]}" if len(ids) > 1 else ""),
            size=float(np.linalg.norm(np.mean(shift[run], axis=0))),
            sigma=float(np.mean([t.stops[s].sigma_translation_m for s in run]) / np.sqrt(len(run))),
            is_length=True,
        )


def _runs(rows: IntArray) -> list[IntArray]:
    """Rows (n,) split where one does not follow the other."""
    return [run for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(run)]


def sentence(part: Part) -> str:
    """A part that was let go, as people read it."""
    size = f"{part.size:+.3g} m" if part.is_length else f"{np.degrees(part.size):+.3g} degrees"
    return f"{part.what} disagrees with the images by {size} ({abs(part.size) / part.sigma:.3g} sigma)"
