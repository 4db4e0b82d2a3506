"""Cases of the benchmark: drives with known truth, made by the package's simulator."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.peer import write_peer
from pancam_graph import SimulationOptions, simulate, write_traverse
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import IntArray
from pancam_graph.data import RigTreatment
from pancam_graph.rigs import RigUncertainty, mer_navcam

__all__ = ["CASES", "DEFAULT_CASES", "GROWTH", "Case", "Files", "Size", "chosen_cases", "make"]

_START_ERROR_M = 0.1
"""How far from the truth, per axis, landmarks start for engines that cannot triangulate."""

GROWTH = ("long10", "long80")
"""Two drives that differ in length alone, by a factor of 8: the time per observation and iteration must
hardly differ."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A simulated traverse, the engines that solve it, and how often they do."""

    name: str
    options: SimulationOptions
    engines: tuple[str, ...]
    """Names of the engines that solve it unless the user names others."""
    repeats: int
    """Warm solves, of which the fastest counts."""
    seed: int = 0
    rig: RigTreatment = "held"
    """What every engine does with the rig; an estimated one has the uncertainty that the Ceres program
    knows."""


@dataclass(frozen=True, kw_only=True)
class Size:
    """Counts of a simulated case."""

    stops: int
    images: int
    tracks: int
    observations: int
    stops_per_track: float
    """Mean number of stops whose images see a track."""


@dataclass(frozen=True, kw_only=True)
class Files:
    """Files of a case."""

    traverse: Path
    """Folder with traverse.json."""
    start_m: Path
    """(tracks, 3) landmarks near the truth, for engines that cannot triangulate; a row per track number."""
    peer: Path
    """The same problem as text, for the Ceres program."""
    rig: RigTreatment
    """What every engine does with the rig."""


def _degrees(*tilts: float) -> tuple[float, ...]:
    return tuple(np.deg2rad(tilts).tolist())


# Navcam all around. A track may be seen from any side and from up to eight times nearer, so that it is
# seen by as many stops as the reach allows. This is what makes long drives hard to solve.
_ALL_AROUND = SimulationOptions(pans=18, noise_px=0.5, min_views=3, max_turn_rad=np.pi, max_zoom=8.0)
_SMALL = replace(
    _ALL_AROUND, stops=3, tilts_rad=_degrees(-9), points_per_image=35, detection=0.35, reach_m=40.0
)
_MID = replace(
    _ALL_AROUND,
    stops=10,
    tilts_rad=_degrees(-6, -23),
    points_per_image=58,
    detection=0.12,
    link_stops=9,
    reach_m=18.0,
)
_LONG = replace(_MID, stops=40, spacing_m=8.0, points_per_image=41, detection=0.08, link_stops=5)
_PEERS = ("eliminated", "ceres", "pycolmap")
_ESTIMATING = ("eliminated", "ceres")
_PEERS_RIG = replace(
    RigUncertainty.exact(),
    focal=2e-3,
    principal_point_px=5.0,
    mount_rad=5e-4,
    mount_m=1e-3,
    tilt_axis_rad=5e-4,
    tilt_axis_m=1e-3,
    source="priors of the Ceres program",
)

CASES = {
    case.name: case
    for case in (
        Case(
            name="small", options=_SMALL, engines=("eliminated", "explicit", "ceres", "pycolmap"), repeats=5
        ),
        Case(name="mid", options=_MID, engines=_PEERS, repeats=3),
        Case(name="long", options=_LONG, engines=_PEERS, repeats=3),
        Case(name="small-rig", options=_SMALL, engines=_ESTIMATING, repeats=5, rig="estimated"),
        Case(name="mid-rig", options=_MID, engines=_ESTIMATING, repeats=3, rig="estimated"),
        Case(name="long10", options=replace(_LONG, stops=10), engines=("eliminated",), repeats=3),
        Case(name="long80", options=replace(_LONG, stops=80), engines=("eliminated",), repeats=3),
        Case(name="drive300", options=replace(_LONG, stops=300), engines=("eliminated",), repeats=1),
    )
}
"""The cases by name."""

DEFAULT_CASES = tuple(name for name in CASES if name != "drive300")


def chosen_cases(
    names: list[str], *, engines: list[str] | None = None, repeats: int | None = None
) -> tuple[Case, ...]:
    """Cases by name, in the order of CASES, with other engines or numbers of repeats where given.

    Raises InputError for fewer than one repeat.
    """
    if repeats is not None and repeats < 1:
        raise InputError(f"--repeats: expected 1 or more, found {repeats}")
    return tuple(
        replace(case, engines=tuple(engines or case.engines), repeats=repeats or case.repeats)
        for name, case in CASES.items()
        if name in names
    )


def make(case: Case, folder: Path) -> tuple[Files, Size]:
    """Simulate a case and write it into a new folder: the traverse, and beside it what the peers read."""
    rig = replace(mer_navcam(), uncertainty=_PEERS_RIG)
    simulation = simulate(rig, case.options, seed=case.seed)
    traverse, landmarks_m = simulation.traverse, simulation.truth.landmarks_m
    observations = traverse.observations
    assert observations is not None  # simulated traverses have them
    files = Files(
        traverse=folder / "traverse",
        start_m=folder / "start_m.npy",
        peer=folder / "peer.txt",
        rig=case.rig,
    )
    folder.mkdir(parents=True)
    write_traverse(traverse, files.traverse)
    start_m = landmarks_m + np.random.default_rng(case.seed).normal(0, _START_ERROR_M, landmarks_m.shape)
    np.save(files.start_m, start_m)
    write_peer(traverse, start_m, files.peer)
    size = Size(
        stops=len(traverse.stops),
        images=len(traverse.images),
        tracks=len(landmarks_m),
        observations=len(observations),
        stops_per_track=_stops_per_track(traverse.image_stop[observations.image], observations.track),
    )
    return files, size


def _stops_per_track(stop: IntArray, track: IntArray) -> float:
    pairs = np.unique(track * (int(stop.max()) + 1) + stop)
    return len(pairs) / len(np.unique(track))
