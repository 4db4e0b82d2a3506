"""Observations of a stop split into those of landmarks near by and those that may close a loop."""

import numpy as np

from pancam_graph.base.geometry import IntArray
from pancam_graph.smoother._ledger import Fate
from pancam_graph.smoother._map import DriveMap
from pancam_graph.smoother._placing import Seen
from pancam_graph.smoother._sets import distinct
from pancam_graph.smoother._station import Station

__all__ = ["by_nearness", "sample"]

_ENOUGH_PER_IMAGE = 60
"""Observations per image that suffice to localise a new stop before it is linearised."""


def by_nearness(drive: DriveMap, rows: IntArray, around: dict[int, set[int]]) -> tuple[IntArray, IntArray]:
    """Split rows into those of tracks observed from stations near their own, and all others.

    `around` gives the numbers of stations near a station; default: those that share landmarks with it. A
    track without a landmark belongs to the station that observed it first.
    """
    ledger = drive.ledger
    track, station = ledger.track[rows], drive.station_of(rows)
    is_near = np.zeros(len(rows), dtype=bool)
    unknown = drive.home(track) < 0
    waiting = drive.idle(distinct(track[unknown]), Fate.WAITING)
    names, name_of_waiting = np.unique(ledger.track[waiting], return_inverse=True)
    first = np.full(len(names), len(drive.stations))
    np.minimum.at(first, name_of_waiting, drive.station_of(waiting))
    first_of = np.full(len(rows), -1)
    first_of[unknown] = first[np.searchsorted(names, track[unknown])]
    for number in distinct(station).tolist():
        mine = station == number
        near = around.get(number) or drive.near(number)
        is_near[mine & ~unknown] = drive.seen_from(track[mine & ~unknown], near)
        is_near[mine & unknown] = np.isin(first_of[mine & unknown], list(near))
    return rows[is_near], rows[~is_near]


def sample(drive: DriveMap, station: Station, rows: IntArray) -> Seen | None:
    """A sample of tracks that localises a station: with a landmark, or observed from it twice."""
    if not len(rows):
        return None
    track = drive.ledger.track[rows]
    names, name_of_row, count = np.unique(track, return_inverse=True, return_counts=True)
    names = names[(count >= 2) | (drive.home(names) >= 0)]
    enough = _ENOUGH_PER_IMAGE * len(station.traverse.images)
    names = names[:: max(1, len(name_of_row) // enough)]
    rows = rows[np.isin(track, names)]
    return drive.excerpt(names, rows, station) if len(rows) and station.own_keys else None
