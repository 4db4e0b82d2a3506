"""Warnings of an update."""

from collections.abc import Sequence

import numpy as np

from pancam_graph.base.geometry import IntArray
from pancam_graph.smoother._ledger import Fate
from pancam_graph.smoother._map import DriveMap
from pancam_graph.smoother._sets import distinct
from pancam_graph.smoother._smoother_options import Closure
from pancam_graph.smoother._station import Station
from pancam_graph.solve import listed

__all__ = ["warnings_of"]


def warnings_of(
    drive: DriveMap, station: Station | None, rows: IntArray, closures: Sequence[Closure]
) -> list[str]:
    """Warnings of an update with these rows of the ledger, of a new station or of none."""
    ledger, out = drive.ledger, list[str]()
    if station is not None and len(drive.stations) > 1 and drive.near(station.number) == {station.number}:
        out.append(
            f"stop {station.id}: no track connects it to another stop; its place is what odometry says"
        )
    for c in closures:
        if not c.accepted:
            why = (
                f"only {c.inliers:.0%} of them agree on one pose"
                if c.inliers < 1 and c.sigmas < 4
                else f"they contradict the drive by {c.sigmas:.1f} sigma ({c.shift_m:.2f} m), "
                f"{c.inliers:.0%} agree"
            )
            out.append(
                f"stop {c.stop}: {c.observations} observations of tracks at {c.other} are not believed: {why}"
            )
    # Tracks that a stop observes twice or more, all as outliers: it probably sees another point.
    outliers = drive.idle(distinct(ledger.track[rows]), Fate.OUTLIER)
    pairs = np.column_stack([ledger.track[outliers], drive.station_of(outliers)])
    pairs, counts = np.unique(pairs, axis=0, return_counts=True)
    track = distinct(pairs[counts >= 2, 0])
    if len(track):
        names = [str(t) for t in track]
        out.append(
            f"{listed(names, 'track')}: seen where other "
            "observations of the number have another place; left out"
        )
    return out
