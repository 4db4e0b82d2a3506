"""The content of a drive: stations, observations, and landmarks in blocks by the stop that saw them first."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from pancam_graph.base.geometry import BoolArray, IntArray
from pancam_graph.base.threads import each
from pancam_graph.data import Sharing
from pancam_graph.elimination import Room
from pancam_graph.graph import (
    FactorList,
    GivenFactor,
    HardTemplate,
    UserFactors,
    check_given,
    given_factors,
    seated,
)
from pancam_graph.landmarks import Landmarks, residuals
from pancam_graph.rigs import Rig
from pancam_graph.smoother._block import LandmarkBlock
from pancam_graph.smoother._ledger import Fate, Ledger
from pancam_graph.smoother._placing import Placed, Seen, believed, combined, gathered, placed_anew
from pancam_graph.smoother._sets import distinct
from pancam_graph.smoother._station import Patch, Postures, Station

__all__ = ["Change", "DriveMap"]


@dataclass(kw_only=True)
class Change:
    """Changes of blocks by an update, before iSAM2 has them."""

    touched: set[int] = field(default_factory=set)
    """Names of blocks whose observations changed."""
    slots: list[int] = field(default_factory=list)
    """Slots of factors in iSAM2 whose blocks were removed."""
    rejected: int = 0
    """Number of observations that became outliers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rebuilt:
    """Result of rebuilding a block."""

    seen: Seen
    """All candidate observations, and whether each is accepted."""
    stays: BoolArray
    """(landmarks,) whether two or more observations are accepted."""
    block: LandmarkBlock | None
    """The block of these landmarks; None if no landmark is left."""


class DriveMap:
    """Stations, observations and blocks. A block is named by the number of the station that saw it first."""

    def __init__(self, rig: Rig, sharing: Sharing, outlier_sigma: float | None) -> None:
        self.rig, self.sharing = rig, sharing
        self._outlier_sigma, self._room = outlier_sigma, Room()
        self.stations: list[Station] = []
        self.ledger = Ledger()
        self.blocks: dict[int, LandmarkBlock] = {}
        self.given: list[GivenFactor] = []
        """The caller's factors, on the keys that the caller knows."""
        self.seated: list[gtsam.NonlinearFactor] = []
        """The same factors on the drive's variables."""
        self.image_station = np.zeros(0, dtype=np.int64)
        """(images,) number of each image's station, over the whole drive"""
        self._first_with: dict[int, int] = {}
        """Number of the first station, by the key of each variable of the rig that stops share."""
        self._track, self._home = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)

    def add(self, station: Station) -> None:
        """Add a station, whose number must be the number of stations so far."""
        self.stations.append(station)
        for key in station.shared_keys:
            self._first_with.setdefault(key, station.number)
        numbers = np.full(len(station.traverse.images), station.number)
        self.image_station = np.concatenate([self.image_station, numbers])

    def factors(self, *, firm: bool) -> list[gtsam.NonlinearFactor]:
        """All factors but those of landmarks and of the caller; see `Station.factors`."""
        shared = (factor for s in self.stations for factor in self.shared_priors(s))
        return [*shared, *(factor for s in self.stations for factor in s.factors(firm=firm))]

    def shared_priors(self, station: Station) -> FactorList:
        """Priors of the rig's shared variables that this station is the first of the drive to have."""
        first = self._first_with
        return station.shared_priors(
            {k for k in station.shared_keys if first[k] == station.number},
            {k for k in first if first[k] < station.number},
        )

    def take_factors(
        self, template: HardTemplate, own: HardTemplate, factors: UserFactors, values: gtsam.Values
    ) -> FactorList:
        """Add the caller's factors, on a template of the whole drive; return them on the drive's variables.

        That template may have stops, frames and images in another order than `own`, which has them as added.

        `values` are those of the drive. Raises InputError, and changes nothing, for a factor that cannot be
        evaluated there.
        """
        given = given_factors(factors, template.keys)
        name = {key: own.owners[owner] for owner, key in template.owners.items()}
        seats = {key: seat.on(name) for key, seat in template.seats(given).items()}
        check_given(given, seats, values)
        new: FactorList = [factor for one in given if (factor := seated(one, seats)) is not None]
        self.given += given
        self.seated += new
        return new

    def station_of(self, rows: IntArray) -> IntArray:
        """Number (n,) of the station of each row of the ledger."""
        return self.image_station[self.ledger.image[rows]]

    def home(self, track: IntArray) -> IntArray:
        """Name (n,) of the block of each track; -1 for tracks without a landmark."""
        at = np.searchsorted(self._track, track).clip(max=max(len(self._track) - 1, 0))
        if not len(self._track):
            return np.full(len(track), -1)
        return np.where(self._track[at] == track, self._home[at], -1)

    def near(self, number: int) -> set[int]:
        """Numbers of the stations that share landmarks with station `number`, itself included."""
        out = {number}
        for block in self.blocks.values():
            if number in block.patch.place:
                out |= block.patch.place.keys()
        return out

    def restore(self, track: IntArray, home: IntArray, landmarks: Landmarks) -> None:
        """Rebuild the blocks of a saved drive from its landmarks (landmarks,) and observations in use."""
        used, none = self.ledger.all_with(Fate.USED), np.zeros(0, dtype=np.int64)
        order = np.argsort(track)
        self._track, self._home = track[order], home[order]
        of_row = self.home(self.ledger.track[used])
        for name in distinct(home).tolist():
            rows, of_block = used[of_row == name], home == name
            numbers = distinct(self.station_of(rows))
            patch = Patch([self.stations[i] for i in numbers])
            placed = gathered(self.ledger, self.image_station, patch, None, rows, none).placed
            at = np.flatnonzero(of_block)[np.argsort(track[of_block])]
            where = Landmarks(vector=landmarks.vector[at], origin_m=landmarks.origin_m[at])
            self.blocks[name] = LandmarkBlock(replace(placed, landmarks=where), self._room)

    def idle(self, track: IntArray, *fates: Fate) -> IntArray:
        """Rows of the ledger of these tracks that have one of these fates."""
        rows = np.concatenate([self.ledger.all_with(fate) for fate in fates])
        return rows[np.isin(self.ledger.track[rows], track)]

    def near_blocks(self, track: IntArray) -> set[int]:
        """Numbers of the stations that observe any block of these tracks."""
        home = self.home(track)
        return {s for name in distinct(home[home >= 0]).tolist() for s in self.blocks[name].patch.place}

    def take_in(self, rows: IntArray, cameras: Postures, change: Change, but: IntArray) -> None:
        """Assign observations to landmarks, known or new, and rebuild their blocks.

        Waiting observations of the same tracks take part too, except the rows `but`.
        """
        ledger = self.ledger
        track = distinct(ledger.track[rows])
        rows = distinct(rows, np.setdiff1d(self.idle(track, Fate.WAITING, Fate.OUTLIER), but))
        # Outliers at the same stops may have been rejected for lack of other observations: they are tested
        # again.
        around = self.near_blocks(track) | set(self.station_of(rows).tolist())
        out = ledger.all_with(Fate.OUTLIER)
        rows = distinct(rows, out[np.isin(self.station_of(out), list(around))])
        of_row = self._home_or_first(rows)
        self._rebuild(
            [(name, rows[of_row == name], rows[:0]) for name in distinct(of_row[of_row >= 0]).tolist()],
            cameras,
            change,
        )

    def _home_or_first(self, rows: IntArray) -> IntArray:
        """Block (n,) that each row belongs to: its track's, or a new one by the first station that sees it.

        -1 where the track has no landmark and only one row.
        """
        track = distinct(self.ledger.track[rows])
        track_of_row = np.searchsorted(track, self.ledger.track[rows])
        enough = np.bincount(track_of_row, minlength=len(track)) >= 2
        home, first = self.home(track), np.full(len(track), len(self.stations))
        np.minimum.at(first, track_of_row, self.station_of(rows))
        return np.asarray(np.where(home >= 0, home, np.where(enough, first, -1))[track_of_row])

    def use(
        self, rows: IntArray, accepted: BoolArray, by_chance: BoolArray, cameras: Postures, change: Change
    ) -> None:
        """Use those of some rows (n,) that are `accepted` (n,), and not the others, as they were judged.

        Later updates do not test again what is left out `by_chance` (n,). Rows of tracks that other stations
        use too, which had no part in the judgement, are tested against what these see.
        """
        ledger = self.ledger
        used = ledger.all_with(Fate.USED)
        others = used[~np.isin(self.station_of(used), distinct(self.station_of(rows)))]
        elsewhere = distinct(ledger.track[others])
        was_used = ledger.fate[rows] == int(Fate.USED)
        new, lost = rows[accepted & ~was_used], rows[~accepted & was_used]
        ledger.set_fate(rows[~accepted], Fate.OUTLIER)
        ledger.set_fate(rows[by_chance], Fate.CHANCE)
        ledger.set_fate(new, Fate.WAITING)
        new = distinct(new, self.idle(ledger.track[new], Fate.WAITING))
        of_new, of_lost = self._home_or_first(new), self.home(ledger.track[lost])
        names = distinct(of_new[of_new >= 0], of_lost).tolist()
        new_elsewhere = np.isin(ledger.track[new], elsewhere)
        lost_elsewhere = np.isin(ledger.track[lost], elsewhere)
        for tested in (True, False):
            mine, gone = new_elsewhere != tested, lost_elsewhere != tested
            parts = [(b, new[mine & (of_new == b)], lost[gone & (of_lost == b)]) for b in names]
            parts = [part for part in parts if len(part[1]) or len(part[2])]
            self._rebuild(parts, cameras, change, tested=tested)

    def give_up(self, rows: IntArray, cameras: Postures, change: Change) -> None:
        """Rebuild blocks without these rows, whose fate is set already.

        Outliers of their tracks are tested again.
        """
        ledger = self.ledger
        track = distinct(ledger.track[rows])
        idle = self.idle(track, Fate.OUTLIER)
        home, home_idle = self.home(ledger.track[rows]), self.home(ledger.track[idle])
        names = distinct(home[home >= 0]).tolist()
        self._rebuild([(b, idle[home_idle == b], rows[home == b]) for b in names], cameras, change)

    def drop_behind(self, cameras: Postures, change: Change) -> None:
        """Reject observations by cameras that their landmark now lies behind."""
        for name in [name for name, block in self.blocks.items() if block.system.any_behind]:
            block = self.blocks[name]
            placed, views = block.placed, block.patch.views(cameras)
            everywhere = np.ones(len(placed.track), dtype=bool)
            seen = Seen(
                placed=placed,
                touched=everywhere,
                fresh=~everywhere,
                accepted=np.ones(len(placed.measurements.row), dtype=bool),
            )
            placed = placed_anew(seen, views).placed
            _, in_front = residuals(placed.landmarks, placed.measurements, views)
            lost = placed.measurements.row[~in_front]
            if len(lost):
                self.ledger.set_fate(lost, Fate.OUTLIER)
                change.rejected += len(lost)
                self._rebuild([(name, lost[:0], lost)], cameras, change)
            else:  # placed anew, every landmark is in front
                block.replace(placed)
                change.touched.add(name)

    def _rebuild(
        self,
        parts: Sequence[tuple[int, IntArray, IntArray]],
        cameras: Postures,
        change: Change,
        *,
        tested: bool = False,
    ) -> None:
        """Rebuild blocks, given for each its name, the rows to add and the rows to remove.

        `tested`: the rows are no outliers, and only those by cameras that their landmark lies behind go.
        """
        cutoff = None if tested else self._outlier_sigma
        names: list[int] = []
        work: list[tuple[Placed | None, Patch, IntArray, IntArray]] = []
        for name, rows, lost in parts:
            block = self.blocks.pop(name, None)
            before = () if block is None else block.patch.stations
            more = np.setdiff1d(self.station_of(rows), [s.number for s in before])
            patch = Patch([*before, *(self.stations[i] for i in more)])
            if block is not None:
                patch = patch if len(more) else block.patch
                if block.slot >= 0:
                    change.slots.append(block.slot)
            cameras.of_all(patch.stations)
            names.append(name)
            work.append((None if block is None else block.placed, patch, rows, lost))
        rebuilt = each(lambda one: self._rebuilt(*one, cameras, cutoff), work)
        for name, (*_, lost), made in zip(names, work, rebuilt, strict=True):
            self._settle(name, made, change)
            self._set_home(np.setdiff1d(self.ledger.track[lost], made.seen.placed.track), -1)

    def _rebuilt(
        self,
        known: Placed | None,
        patch: Patch,
        rows: IntArray,
        lost: IntArray,
        cameras: Postures,
        cutoff_sigma: float | None,
    ) -> "_Rebuilt":
        """The rebuilt block; the state of the drive is not changed."""
        seen = gathered(self.ledger, self.image_station, patch, known, rows, lost)
        if not len(seen.placed.track):
            return _Rebuilt(seen=seen, stays=np.zeros(0, dtype=bool), block=None)
        views = patch.views(cameras)
        seen = believed(placed_anew(seen, views), views, cutoff_sigma)
        placed, m = seen.placed, seen.placed.measurements
        stays = np.bincount(m.landmark, seen.accepted, minlength=m.n_landmarks) >= 2
        used = seen.accepted & stays[m.landmark]
        block = None
        if stays.any():
            block = LandmarkBlock(placed if used.all() else placed.part(stays, used), self._room)
        return _Rebuilt(seen=seen, stays=stays, block=block)

    def _settle(self, name: int, made: "_Rebuilt", change: Change) -> None:
        """Record the fates of a rebuilt block's observations, and store the block."""
        placed, accepted, fate = made.seen.placed, made.seen.accepted, self.ledger.fate
        m = placed.measurements
        idle = np.where(accepted, int(Fate.WAITING), int(Fate.OUTLIER))
        change.rejected += int(np.sum(~accepted & (fate[m.row] != int(Fate.OUTLIER))))
        fate[m.row] = np.where(accepted & made.stays[m.landmark], int(Fate.USED), idle)
        self._set_home(placed.track[~made.stays], -1)
        self._set_home(placed.track[made.stays], name)
        change.touched.discard(name)
        if made.block is not None:
            self.blocks[name] = made.block
            change.touched.add(name)

    def _set_home(self, track: IntArray, name: int) -> None:
        at = np.searchsorted(self._track, track)
        known = np.zeros(len(track), dtype=bool)
        if len(self._track):
            known = self._track[at.clip(max=len(self._track) - 1)] == track
        self._home[at[known]] = name
        self._track = np.insert(self._track, at[~known], track[~known])
        self._home = np.insert(self._home, at[~known], name)

    def seen_from(self, track: IntArray, stations: set[int]) -> BoolArray:
        """(n,) whether each track is observed from any of the stations; False for one without a landmark."""
        out, home = np.zeros(len(track), dtype=bool), self.home(track)
        for name in distinct(home[home >= 0]).tolist():
            block, of_block = self.blocks[name], np.flatnonzero(home == name)
            if block.patch.place.keys() <= stations:
                out[of_block] = True
                continue
            placed = block.placed
            of_image = np.repeat(
                [s.number in stations for s in block.patch.stations], np.diff(block.patch.image_begin)
            )
            m = placed.measurements
            any_of = np.bincount(m.landmark, of_image[m.image], minlength=m.n_landmarks) > 0
            out[of_block] = any_of[np.searchsorted(placed.track, track[of_block])]
        return out

    def excerpt(self, track: IntArray, rows: IntArray, free: Station) -> Seen:
        """Some tracks (ascending) with all observations and new rows, in a patch with one free station."""
        home = self.home(track)
        parts = []
        for name in distinct(home[home >= 0]).tolist():
            placed = self.blocks[name].placed
            which = np.isin(placed.track, track, assume_unique=True)
            parts.append(placed.part(which, which[placed.measurements.landmark]))
        images = [p.measurements.row for p in parts]
        numbers = distinct(np.concatenate([self.station_of(r) for r in (rows, *images)]))
        stations = [self.stations[i] for i in numbers if i != free.number]
        patch = Patch([*stations, free], free)
        known = combined(self.ledger, self.image_station, patch, parts) if parts else None
        return gathered(self.ledger, self.image_station, patch, known, rows, rows[:0])

    def whole(self) -> Placed:
        """All landmarks, as all stations see them."""
        parts = [block.placed for block in self.blocks.values()]
        return combined(self.ledger, self.image_station, Patch(self.stations), parts)
