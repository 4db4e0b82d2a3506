"""Loop closures: observations of a part of the drive far off, which a test accepts or rejects."""

from dataclasses import dataclass

import gtsam
import numpy as np
import scipy

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.smoother._localise import localise
from pancam_graph.smoother._map import DriveMap
from pancam_graph.smoother._sets import distinct
from pancam_graph.smoother._smoother_options import Closure, SmootherOptions
from pancam_graph.smoother._station import Station

__all__ = ["Loop", "bridge", "judged", "loops"]

_HELD_RAD = 1e-6
"""Sigma of a stop's angles, radians, while a loop closure places its mast: its own panorama determines
them."""
_LEAST_SIGMAS = np.repeat([1e-5, 1e-4], 3)
"""Lower limit of the sigmas between two stops of a drive, radians and metres."""
_INLIERS = 0.5
"""Least share of a closure's observations that must agree on one pose."""
_OUTLIER_CHANCE = 1e-5
"""Chance of a squared residual in sigmas that is larger than the limit of those that agree."""
_BRIDGE_SIGMAS = np.repeat([1e-4, 2e-3], 3)
"""Sigmas of the factor that pulls a stop to its anchor, radians and metres."""
_ENOUGH = 4000
"""Observations that suffice to test a closure; of more, a sample is taken."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Loop:
    """Observations of one station that see tracks of another part of the drive."""

    station: Station
    """The station that observes."""
    anchor: Station
    """The station of that part which shares most of the tracks."""
    rows: IntArray
    """(n,) rows of the ledger."""


def loops(drive: DriveMap, rows: IntArray) -> list[Loop]:
    """Group rows of tracks far off by their station and by the part of the drive that they observe."""
    out = []
    of_station = drive.station_of(rows)
    for number in distinct(of_station)[::-1].tolist():
        remaining = rows[of_station == number]
        while len(remaining):
            home = drive.home(drive.ledger.track[remaining])
            names, counts = np.unique(home, return_counts=True)
            part = drive.near(int(names[np.argmax(counts)]))
            mine = drive.seen_from(drive.ledger.track[remaining], part)
            if not mine.any():
                break
            anchor = _anchor(drive, remaining[mine], number)
            out.append(
                Loop(station=drive.stations[number], anchor=drive.stations[anchor], rows=remaining[mine])
            )
            remaining = remaining[~mine]
    return out


def _anchor(drive: DriveMap, rows: IntArray, number: int) -> int:
    """The station, other than `number`, that observes most of the tracks of these rows."""
    track, votes = distinct(drive.ledger.track[rows]), np.zeros(len(drive.stations), dtype=np.int64)
    home = drive.home(track)
    for name in distinct(home).tolist():
        placed = drive.blocks[name].placed
        m = placed.measurements
        shared = np.isin(placed.track, track)[m.landmark]
        votes += np.bincount(drive.station_of(m.row[shared]), minlength=len(votes))
    votes[number] = 0
    return int(np.argmax(votes))


def judged(
    drive: DriveMap, loop: Loop, values: gtsam.Values, covariance: FloatArray, options: SmootherOptions
) -> tuple[Closure, gtsam.Pose3]:
    """The test of a closure, and the pose world_T_mast of its station by the closure's observations.

    The pose is the optimum of the closure's observations and a prior: the pose of the station relative to the
    anchor by the drive so far, with `covariance` (6, 6) in the station's frame. For a right closure the
    squared deviation from this prior follows a chi-square distribution with six degrees of freedom.
    """
    station = loop.station
    here = station.world_T_mast(values)
    known = covariance + np.diag(_LEAST_SIGMAS**2)
    track, rows = distinct(drive.ledger.track[loop.rows]), loop.rows
    stride = max(1, len(rows) // _ENOUGH)
    track = track[::stride]
    rows = rows[np.isin(drive.ledger.track[rows], track)]
    seen = drive.excerpt(track, rows, station)
    inliers, closed_pose = 1.0, here
    square = 0.0
    if station.mast is not None:
        priors: list[gtsam.NonlinearFactor] = [
            gtsam.PriorFactorPose3(station.mast, here, gtsam.noiseModel.Gaussian.Covariance(known))
        ]
        priors += _held(station, values)
        located = localise(station, values, seen, priors, robust=True)
        closed_pose = located.values.atPose3(station.mast)
        error = here.localCoordinates(closed_pose)
        square = float(error @ np.linalg.solve(known, error))
        of_closure = np.isin(seen.placed.measurements.row, rows)
        limit = float(scipy.special.chdtri(2, _OUTLIER_CHANCE))
        inliers = float(np.mean(located.squares[of_closure] < limit))
    chance = float(scipy.special.chdtrc(6, square))
    return (
        Closure(
            stop=station.id,
            other=loop.anchor.id,
            observations=len(loop.rows),
            inliers=inliers,
            sigmas=float(np.sqrt(2) * scipy.special.erfcinv(chance))
            if chance > 0
            else float(np.sqrt(square)),
            shift_m=float(np.linalg.norm(closed_pose.translation() - here.translation())),
            accepted=inliers >= _INLIERS and chance >= options.closure_probability,
        ),
        closed_pose,
    )


def _held(station: Station, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
    """Tight priors on the variables of a station other than its mast, at their values."""
    out: list[gtsam.NonlinearFactor] = []
    for key in station.own_keys:
        if key != station.mast:
            value = values.atVector(key)
            out.append(
                gtsam.PriorFactorVector(key, value, gtsam.noiseModel.Isotropic.Sigma(len(value), _HELD_RAD))
            )
    return out


def bridge(loop: Loop, values: gtsam.Values, world_T_mast: gtsam.Pose3) -> gtsam.NonlinearFactor | None:
    """A tight factor from the anchor to the station of an accepted closure; None if the station is held."""
    noise, mast = gtsam.noiseModel.Diagonal.Sigmas(_BRIDGE_SIGMAS), loop.station.mast
    if mast is None:
        return None
    if loop.anchor.mast is None:
        return gtsam.PriorFactorPose3(mast, world_T_mast, noise)
    between = loop.anchor.world_T_mast(values).between(world_T_mast)
    return gtsam.BetweenFactorPose3(loop.anchor.mast, mast, between, noise)
