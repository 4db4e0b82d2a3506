"""One update of a drive: rounds of iSAM2, loop closures, and the summary for the caller."""

import time
from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.geometry import IntArray
from pancam_graph.graph import Kind, kind_of
from pancam_graph.smoother._closure import Loop, bridge, judged, loops
from pancam_graph.smoother._covariances import relative_covariance
from pancam_graph.smoother._engine import Engine, Rounds
from pancam_graph.smoother._judgement import judged_together, many_are_wrong
from pancam_graph.smoother._ledger import Fate, left_out
from pancam_graph.smoother._map import Change, DriveMap
from pancam_graph.smoother._smoother_options import Closure, SmootherOptions, Update
from pancam_graph.smoother._station import Postures, Station, copied
from pancam_graph.smoother._warnings import warnings_of

__all__ = ["UpdateRun"]


class UpdateRun:
    """An update in progress and the record of its work; its time counts from construction."""

    def __init__(
        self, drive: DriveMap, engine: Engine, options: SmootherOptions, station: Station | None = None
    ) -> None:
        """`station` is the new one, if the update adds one."""
        self._begin = time.perf_counter()
        self._drive, self._engine, self._options, self._station = drive, engine, options, station
        self.rows: IntArray = np.zeros(0, dtype=np.int64)
        """(n,) rows of the ledger that are added or removed"""
        self._rejected = 0
        self._rounds: list[Rounds] = []
        self._closures: list[Closure] = []

    def take_in(
        self,
        rows: IntArray,
        values: gtsam.Values,
        change: Change,
        far: IntArray,
        around: set[int],
        start: gtsam.Values,
    ) -> gtsam.Values:
        """Assign observations to landmarks and reject outliers; returns the values to go on from.

        Where too many are outliers, the stations `around`, given by number, are judged together, from
        `start`, and a new station is put where that has it. Rows `far` take no part.
        """
        drive, options, ledger = self._drive, self._options, self._drive.ledger
        before = ledger.fate.copy()
        drive.take_in(rows, Postures(values), change, far)
        if options.outlier_sigma is None or not many_are_wrong(drive, self.rows):
            return values
        judgement = judged_together(drive, around, start, options, far)
        if judgement is None:
            return values
        if self._station is not None:
            moved = self._station.start(
                judgement.world_T_mast[self._station.number], judgement.pan_tilt_rad[self._station.number]
            )
            own = [k for k in self._station.own_keys if kind_of(k) in {Kind.MAST, Kind.ANGLES, Kind.FLEX}]
            values = gtsam.Values(values)
            values.update(copied(moved, own))
        drive.use(judgement.rows, judgement.accepted, judgement.by_chance, Postures(values), change)
        change.rejected = int(np.sum(left_out(ledger.fate) & ~left_out(before)))
        return values

    def advance(
        self,
        change: Change,
        factors: Sequence[gtsam.NonlinearFactor] = (),
        values: gtsam.Values | None = None,
    ) -> None:
        """Update the estimate, then reject observations of landmarks that have moved behind their cameras.

        `values` are initial values of the new station's variables; None: no station is new.
        """
        station = None if values is None else self._station
        self._rounds.append(self._engine.advance(change, factors, station, values))
        late = Change()
        self._drive.drop_behind(Postures(self._engine.estimate), late)
        if late.touched or late.slots:
            self._rounds.append(self._engine.advance(late))
            self._rejected += late.rejected
        self._rejected += change.rejected

    def advance_if_changed(self, change: Change) -> None:
        """Call `advance`, unless no block has changed."""
        if change.touched or change.slots:
            self.advance(change)
        else:
            self._rejected += change.rejected

    def close_loops(self, far: IntArray) -> None:
        """Test rows of known tracks far off as loop closures, then add the rows of unknown tracks."""
        drive, engine, ledger = self._drive, self._engine, self._drive.ledger
        known = far[drive.home(ledger.track[far]) >= 0]
        for loop in loops(drive, known):
            self._close(loop, far)
        late = ledger.with_fate(np.setdiff1d(far, known), Fate.WAITING)
        # Two rays across a loop are too few for a test: they are rejected where the stop's closures were.
        believed = {c.stop for c in self._closures if c.accepted}
        doubted = {c.stop for c in self._closures if not c.accepted} - believed
        numbers = [station.number for station in drive.stations if station.id in doubted]
        of_doubted = np.isin(drive.station_of(late), numbers)
        ledger.set_fate(late[of_doubted], Fate.CLOSURE)
        self._rejected += int(of_doubted.sum())
        late = late[~of_doubted]
        if len(late):
            change = Change()
            drive.take_in(late, Postures(engine.estimate), change, late[:0])
            self.advance_if_changed(change)

    def _close(self, loop: Loop, far: IntArray) -> None:
        """Test one loop closure, and add its observations if it is accepted."""
        drive, engine = self._drive, self._engine
        covariance = relative_covariance(engine, loop.anchor, loop.station)
        closure, pose = judged(drive, loop, engine.estimate, covariance, self._options)
        self._closures.append(closure)
        if not closure.accepted:
            drive.ledger.set_fate(loop.rows, Fate.CLOSURE)
            self._rejected += len(loop.rows)
            return
        factor = bridge(loop, engine.estimate, pose)
        if factor is not None:
            self._rounds.append(engine.bend(factor))
        change = Change()
        drive.take_in(loop.rows, Postures(engine.estimate), change, np.setdiff1d(far, loop.rows))
        self.advance(change)

    def finished(self) -> Update:
        """Summary of the update."""
        station, rounds = self._station, self._rounds
        return Update(
            stop=None if station is None else station.id,
            observations=len(self.rows),
            rejected=self._rejected,
            blocks=sum(r.blocks for r in rounds),
            rounds=sum(r.rounds for r in rounds),
            relinearised=sum(r.relinearised for r in rounds),
            cost=self._engine.cost,
            fell_back=any(r.fell_back for r in rounds),
            closures=tuple(self._closures),
            warnings=tuple(warnings_of(self._drive, station, self.rows, self._closures)),
            seconds=time.perf_counter() - self._begin,
        )
