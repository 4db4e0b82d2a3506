"""Loop closures: a part of the drive that odometry had left behind is seen again, or so it is said."""

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
"""Sigma of angles while a stop is placed by a loop closure: these its own panorama knows."""
_LEAST_SIGMAS = np.repeat([1e-5, 1e-4], 3)
"""Radians and metres: no drive is taken to be known better."""
_INLIERS = 0.5
"""Share of the observations that must agree on one pose."""
_OUTLIER_CHANCE = 1e-5
"""Chance of a squared residual in sigmas that is larger than the limit of those that agree."""
_BRIDGE_SIGMAS = np.repeat([1e-4, 2e-3], 3)
_ENOUGH = 4000
"""Observations that judge a closure."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Loop:
    """Observations of one station that see tracks of another part of the drive."""

    station: Station
    anchor: Station
    """The station of that part which shares most of the tracks."""
    rows: IntArray


def loops(drive: DriveMap, rows: IntArray) -> list[Loop]:
    """Rows that see known tracks far off, by station and by the part of the drive that they belong to."""
    out = []
    of_station = drive.station_of(rows)
    for number in distinct(of_station)[::-1].tolist():
        own = rows[of_station == number]
        while len(own):
            home = drive.home(drive.ledger.track[own])
            names, counts = np.unique(home, return_counts=True)
            part = drive.near(int(names[np.argmax(counts)]))
            mine = drive.seen_from(drive.ledger.track[own], part)
            if not mine.any():
                break
            anchor = _anchor(drive, own[mine], number)
            out.append(Loop(station=drive.stations[number], anchor=drive.stations[anchor], rows=own[mine]))
            own = own[~mine]
    return out


def _anchor(drive: DriveMap, rows: IntArray, number: int) -> int:
    """The station that shares most of the tracks of these rows with another."""
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
    """Whether a closure can be believed, and the pose of its station that it says.

    The pose is the one that its observations and the drive want together, as far as the drive knows where the
    station is relative to the anchor: `covariance` (6, 6) in the station's frame. A right closure contradicts
    the drive by a chi-square of six.
    """
    station = loop.station
    here = station.world_T_mast(values)
    known = covariance + np.diag(_LEAST_SIGMAS**2)
    track, rows = distinct(drive.ledger.track[loop.rows]), loop.rows
    stride = max(1, len(rows) // _ENOUGH)
    track = track[::stride]
    rows = rows[np.isin(drive.ledger.track[rows], track)]
    seen = drive.excerpt(track, rows, station)
    inliers, found = 1.0, here
    square = 0.0
    if station.mast is not None:
        priors: list[gtsam.NonlinearFactor] = [
            gtsam.PriorFactorPose3(station.mast, here, gtsam.noiseModel.Gaussian.Covariance(known))
        ]
        priors += _held(station, values)
        located = localise(station, values, seen, priors, robust=True)
        found = located.values.atPose3(station.mast)
        error = here.localCoordinates(found)
        square = float(error @ np.linalg.solve(known, error))
        own = np.isin(seen.placed.measurements.row, rows)
        limit = float(scipy.special.chdtri(2, _OUTLIER_CHANCE))
        inliers = float(np.mean(located.squares[own] < limit))
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
            shift_m=float(np.linalg.norm(found.translation() - here.translation())),
            accepted=inliers >= _INLIERS and chance >= options.closure_probability,
        ),
        found,
    )


def _held(station: Station, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
    """Everything of a station but its mast, about where it is."""
    out: list[gtsam.NonlinearFactor] = []
    for key in station.own:
        if key != station.mast:
            value = values.atVector(key)
            out.append(
                gtsam.PriorFactorVector(key, value, gtsam.noiseModel.Isotropic.Sigma(len(value), _HELD_RAD))
            )
    return out


def bridge(loop: Loop, values: gtsam.Values, found: gtsam.Pose3) -> gtsam.NonlinearFactor | None:
    """What joins the station of a believed closure to the anchor while the drive bends; None if held."""
    noise, mast = gtsam.noiseModel.Diagonal.Sigmas(_BRIDGE_SIGMAS), loop.station.mast
    if mast is None:
        return None
    if loop.anchor.mast is None:
        return gtsam.PriorFactorPose3(mast, found, noise)
    between = loop.anchor.world_T_mast(values).between(found)
    return gtsam.BetweenFactorPose3(loop.anchor.mast, mast, between, noise)
