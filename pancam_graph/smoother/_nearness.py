"""Which observations of a stop are of what its neighbours see, and which may close a loop."""

import numpy as np

from pancam_graph.base.geometry import IntArray
from pancam_graph.smoother._ledger import Fate
from pancam_graph.smoother._map import DriveMap
from pancam_graph.smoother._placing import Seen
from pancam_graph.smoother._sets import distinct
from pancam_graph.smoother._station import Station

__all__ = ["by_nearness", "sample"]

_ENOUGH_PER_IMAGE = 60
"""Observations of an image that place a new stop well enough to linearise there."""


def by_nearness(drive: DriveMap, rows: IntArray, around: dict[int, set[int]]) -> tuple[IntArray, IntArray]:
    """Rows of tracks that stations near their own see, and of tracks that are far off.

    `around` says which stations are near one, where that is not what shares landmarks with it. A track
    without a place is of where its first observations are.
    """
    ledger = drive.ledger
    track, station = ledger.track[rows], drive.station_of(rows)
    is_near = np.zeros(len(rows), dtype=bool)
    unknown = drive.home(track) < 0
    waiting = drive.idle(distinct(track[unknown]), Fate.WAITING)
    names, own = np.unique(ledger.track[waiting], return_inverse=True)
    first = np.full(len(names), len(drive.stations))
    np.minimum.at(first, own, drive.station_of(waiting))
    first_of = np.full(len(rows), -1)
    first_of[unknown] = first[np.searchsorted(names, track[unknown])]
    for number in distinct(station).tolist():
        mine = station == number
        near = around.get(number) or drive.near(number)
        is_near[mine & ~unknown] = drive.seen_from(track[mine & ~unknown], near)
        is_near[mine & unknown] = np.isin(first_of[mine & unknown], list(near))
    return rows[is_near], rows[~is_near]


def sample(drive: DriveMap, station: Station, rows: IntArray) -> Seen | None:
    """Tracks enough to say where a station is: with a place, or seen from there twice."""
    track = drive.ledger.track[rows]
    names, own, count = np.unique(track, return_inverse=True, return_counts=True)
    names = names[(count >= 2) | (drive.home(names) >= 0)]
    enough = _ENOUGH_PER_IMAGE * len(station.traverse.images)
    names = names[:: max(1, len(own) // enough)]
    rows = rows[np.isin(track, names)]
    return drive.excerpt(names, rows, station) if len(rows) and station.own else None
