"""Observations of a few stations judged as `solve` judges those of a whole drive, where outliers are many.

The test of an update holds the cameras where the first localisation put them. Where many observations are
wrong, these have pulled the localisation away, so that adjustment and test must alternate.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import Traverse
from pancam_graph.initialise import Start
from pancam_graph.smoother._ledger import Fate
from pancam_graph.smoother._map import DriveMap
from pancam_graph.smoother._smoother_options import SmootherOptions
from pancam_graph.smoother._station import Station
from pancam_graph.solve import Screened, SolveOptions, prepare, screen

__all__ = ["Judgement", "judged_together", "many_are_wrong"]

_MANY = 0.2
"""Largest share of outliers among the tested observations of an update with which that test is trusted."""
_JUDGED = (Fate.WAITING, Fate.USED, Fate.OUTLIER, Fate.CHANCE)


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """Which observations of some stations to believe, and where the cameras are by these."""

    rows: IntArray
    """(n,) rows of the ledger that were judged."""
    accepted: BoolArray
    """(n,)"""
    by_chance: BoolArray
    """(n,) whether each is left out though it fits, since chance alone explains its links."""
    world_T_mast: dict[int, gtsam.Pose3]
    """Mast pose by number of the station."""
    pan_tilt_rad: dict[int, FloatArray]
    """Pan and tilt (frames, 2) by number of the station."""


def many_are_wrong(drive: DriveMap, rows: IntArray) -> bool:
    """Whether so many of the tested rows of an update are outliers that the test is in doubt."""
    fate = drive.ledger.fate[rows]
    n_wrong = int(np.sum(fate == int(Fate.OUTLIER)))
    return n_wrong > _MANY * (n_wrong + int(np.sum(fate == int(Fate.USED))))


def judged_together(
    drive: DriveMap, stations: Iterable[int], values: gtsam.Values, options: SmootherOptions, but: IntArray
) -> Judgement | None:
    """All observations of some stations, given by number, judged by an adjustment of these alone.

    It starts at `values`. Rows `but`, removed ones and rejected loop closures take no part. None where no
    track is seen twice, or where the stations alone are not determined.
    """
    members = [drive.stations[i] for i in sorted(stations)]
    ledger = drive.ledger
    rows = np.setdiff1d(np.flatnonzero(np.isin(ledger.fate, [int(f) for f in _JUDGED])), but)
    rows = rows[np.isin(drive.station_of(rows), [s.number for s in members])]
    traverse = _alone(drive, members, values, options)
    image = np.concatenate([s.first_image + np.arange(len(s.traverse.images)) for s in members])
    observations = ledger.observations.select(rows)
    place = np.zeros(int(image.max(initial=0)) + 1, dtype=np.int64)
    place[image] = np.arange(len(image))
    traverse = traverse.with_observations(replace(observations, image=place[observations.image]))
    start = Start(
        world_T_mast=tuple(s.world_T_mast(values) for s in members),
        pan_tilt_rad=np.concatenate([s.pan_tilt_rad(values) for s in members]),
    )
    assert options.outlier_sigma is not None  # without a cutoff nothing is an outlier
    wanted = SolveOptions(outlier_sigma=options.outlier_sigma, sharing=options.sharing, rig=options.rig)
    try:
        screened = screen(prepare(traverse, wanted, start))
    except SolveError:
        return None
    return _judgement(rows, members, screened)


def _alone(
    drive: DriveMap, members: list[Station], values: gtsam.Values, options: SmootherOptions
) -> Traverse:
    """The stations as a traverse; with odometry their priors are where `values` have them."""
    stops = [s.traverse.stops[0] for s in members]
    if options.telemetry == "odometry":
        stops = [replace(o, world_T_mast=s.world_T_mast(values)) for o, s in zip(stops, members, strict=True)]
    return Traverse(
        name="",
        rig=drive.rig,
        stops=tuple(stops),
        frames=tuple(frame for s in members for frame in s.traverse.frames),
        images=tuple(image for s in members for image in s.traverse.images),
    )


def _judgement(rows: IntArray, members: list[Station], screened: Screened) -> Judgement:
    """The outcome of a screening by rows of the ledger (observations,) and by station."""
    problem = screened.problem
    measured = problem.measurements.row
    state = problem.template.state(problem.values, np.zeros((0, 3)))
    ends = np.cumsum([len(s.traverse.frames) for s in members])[:-1]
    numbers = [s.number for s in members]
    return Judgement(
        rows=rows[measured],
        accepted=problem.accepted,
        by_chance=screened.by_chance[measured],
        world_T_mast=dict(zip(numbers, state.world_T_mast, strict=True)),
        pan_tilt_rad=dict(zip(numbers, np.split(state.pan_tilt_rad, ends), strict=True)),
    )
