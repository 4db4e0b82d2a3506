"""The rover drives: an estimate that follows stop by stop."""

import time
from collections.abc import Sequence
from pathlib import Path

import gtsam
import numpy as np

from pancam_graph._diagnose import listed
from pancam_graph.cameras import carry_to_pinhole
from pancam_graph.errors import InputError
from pancam_graph.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.landmarks import Landmarks
from pancam_graph.rigs import Rig
from pancam_graph.sharing import Sharing
from pancam_graph.smoother._batch import whole_traverse
from pancam_graph.smoother._closure import bridge, judged, loops
from pancam_graph.smoother._engine import Engine, Rounds
from pancam_graph.smoother._frame import orthonormal
from pancam_graph.smoother._ledger import Fate
from pancam_graph.smoother._localise import localise
from pancam_graph.smoother._map import Change, DriveMap
from pancam_graph.smoother._options import Closure, Estimate, SmootherOptions, Update
from pancam_graph.smoother._placing import Seen
from pancam_graph.smoother._sets import distinct
from pancam_graph.smoother._state import SmootherState
from pancam_graph.smoother._station import Postures, Station, copied
from pancam_graph.threads import blas_on_one_thread
from pancam_graph.traverse import Frame, Image, Observations, Stop, Traverse

__all__ = ["TraverseSmoother"]

_ENOUGH_PER_IMAGE = 60
"""Observations of an image that place a new stop well enough to linearise there."""
_TYPICAL_RANGE_M = 10.0


class TraverseSmoother:
    """Mast poses, angles and terrain points of a drive, brought up to date after every stop by iSAM2.

    The model is the rigid mast (`mast` with a hard tie). Stops may come in any order.
    """

    def __init__(self, rig: Rig, options: SmootherOptions | None = None) -> None:
        """Nothing is known yet."""
        self.rig, self.options = rig, options or SmootherOptions()
        self._sharing = (self.options.sharing or Sharing()).for_model("mast")
        self._drive = DriveMap(self.options.outlier_sigma)
        self._engine = Engine(self._drive, self.options)
        self._stop: dict[str, Station] = {}
        self._image_row: dict[str, int] = {}
        self._frame_ids: set[str] = set()

    # --- what is known ---

    @property
    def stops(self) -> tuple[str, ...]:
        """Ids of the stops, in the order in which they were added."""
        return tuple(self._stop)

    @property
    def images(self) -> tuple[str, ...]:
        """Ids of the images, in the order in which they were added."""
        return tuple(self._image_row)

    def values(self) -> gtsam.Values:
        """All variables where they are now, under the keys that a batch of the drive has."""
        return gtsam.Values(self._engine.estimate)

    @property
    def traverse(self) -> Traverse:
        """All stops with all observations, in the order in which they were added."""
        return whole_traverse(self._drive)

    @property
    def used(self) -> BoolArray:
        """(observations,) which of the traverse's take part."""
        return np.asarray(self._drive.ledger.fate == int(Fate.USED))

    @property
    def cost(self) -> float:
        """Half the sum of squares of everything that is used, priors included, as the last update left it."""
        return self._engine.cost if self._stop else 0.0

    def estimate(self) -> Estimate:
        """Where all stops are, and where all frames point."""
        values, stations = self._engine.estimate, self._drive.stations
        angles = [s.pan_tilt_rad(values) for s in stations]
        return Estimate(
            stops=self.stops,
            world_T_mast=tuple(s.world_T_mast(values) for s in stations),
            frames=tuple(f.id for s in stations for f in s.traverse.frames),
            pan_tilt_rad=np.concatenate([np.zeros((0, 2)), *angles]),
        )

    def covariance(self, stop: str) -> FloatArray:
        """Covariance (6, 6) of a stop's mast pose, rotation first, body frame; 0 where it is held."""
        return self._joint([self._station(stop)])

    def relative_covariance(self, stop_a: str, stop_b: str) -> FloatArray:
        """Covariance (6, 6) of a_T_b, where b's mast is as a's sees it; rotation first, in the frame of b."""
        a, b = self._station(stop_a), self._station(stop_b)
        if a is b:
            return np.zeros((6, 6))
        values = self._engine.estimate
        by_a = -b.world_T_mast(values).between(a.world_T_mast(values)).AdjointMap()
        jacobian = np.hstack([by_a, np.eye(6)])
        return np.asarray(jacobian @ self._joint([a, b]) @ jacobian.T)

    def _joint(self, stations: Sequence[Station]) -> FloatArray:
        """Joint covariance of mast poses; 0 where held."""
        free = [i for i, s in enumerate(stations) if s.mast is not None]
        out = np.zeros((6 * len(stations),) * 2)
        if free:
            with blas_on_one_thread():
                found = self._engine.covariance([m for i in free if (m := stations[i].mast) is not None])
            held = np.zeros(len(out), dtype=bool)
            for i, station in enumerate(stations):
                held[6 * i + station.held_of_mast] = True
            rows = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in free])
            out[np.ix_(rows, rows)] = found
            out[held], out[:, held] = 0.0, 0.0
        return out

    def _station(self, stop: str) -> Station:
        if stop not in self._stop:
            raise InputError(f"stop: expected one of {len(self._stop)} stops that were added, found {stop!r}")
        return self._stop[stop]

    # --- updates ---

    def add_stop(
        self,
        stop: Stop,
        frames: Sequence[Frame],
        images: Sequence[Image],
        observations: Observations | None = None,
        *,
        after: str | None = None,
    ) -> Update:
        """Add a stop with all its frames, images and observations.

        `observations.image` are rows of `images`; tracks have the same numbers over the whole drive. `after`
        is the stop from which odometry leads here; default: the one added last. Raises InputError, and
        changes nothing, where an id or a number makes no sense or was added before.
        """
        begin = time.perf_counter()
        entries = Traverse(
            name="",
            rig=self.rig,
            stops=(stop,),
            frames=tuple(frames),
            images=tuple(images),
            observations=observations,
        )
        self._require_new(entries)
        previous = self._station(after) if after is not None else next(reversed(self._stop.values()), None)
        station = Station(len(self._stop), entries, self._sharing, len(self._image_row))
        if previous is not None:
            self._join(station, previous)
        with blas_on_one_thread():
            rows = self._enter(station, observations)
            return self._placed(station, previous, rows, begin)

    def _join(self, station: Station, previous: Station) -> None:
        """Odometry from one station to another, if stops are known by that."""
        station.after = previous.number
        if self.options.telemetry == "absolute":
            return
        stop, other = station.traverse.stops[0], previous.traverse.stops[0]
        if station.mast is None or len(station.held_of_mast):
            raise InputError(
                f"stop {stop.id}: expected sigmas above 0, of the motion from {other.id}; found "
                f"{stop.sigma_rotation_rad} and {stop.sigma_translation_m}"
            )
        noise = gtsam.noiseModel.Diagonal.Sigmas(stop.sigmas)
        if previous.mast is None:
            station.motion = gtsam.PriorFactorPose3(station.mast, stop.world_T_mast, noise)
        else:
            moved = other.world_T_mast.between(stop.world_T_mast)
            station.motion = gtsam.BetweenFactorPose3(previous.mast, station.mast, moved, noise)

    def _require_new(self, entries: Traverse) -> None:
        stop = entries.stops[0]
        if stop.id in self._stop:
            raise InputError(
                f"stop {stop.id}: expected a stop that was not added before, found it added already"
            )
        for kind, ids, known in (
            ("frames", [f.id for f in entries.frames], self._frame_ids),
            ("images", [i.id for i in entries.images], self._image_row),
        ):
            for name in ids:
                if name in known:
                    raise InputError(
                        f"stop {stop.id}: {kind}: expected new ids, found {name!r} of another stop"
                    )

    def _enter(self, station: Station, observations: Observations | None) -> IntArray:
        """Make a station known; the ledger's rows of its observations."""
        t = station.traverse
        self._stop[station.id] = station
        self._frame_ids |= {f.id for f in t.frames}
        self._image_row |= {image.id: station.first_image + i for i, image in enumerate(t.images)}
        self._drive.add(station)
        if observations is None:
            return np.zeros(0, dtype=np.int64)
        return self._append(observations, observations.image + station.first_image)

    def _append(self, observations: Observations, image: IntArray) -> IntArray:
        eye = np.concatenate([s.traverse.image_eye for s in self._drive.stations])[image]
        carried, turn = np.empty((len(image), 2)), np.empty((len(image), 2, 2))
        valid = np.empty(len(image), dtype=bool)
        for i, one in enumerate(self.rig.eyes):
            own = eye == i
            range_m = np.full(int(own.sum()), _TYPICAL_RANGE_M)
            carried[own], turn[own], valid[own] = carry_to_pinhole(
                one.camera, observations.uv_px[own], range_m
            )
        whitening = observations.noise.whiten(turn)
        return self._drive.ledger.append(image, observations, carried, whitening, valid)

    def _placed(self, station: Station, previous: Station | None, rows: IntArray, begin: float) -> Update:
        """Find where a new stop is, and let it take part."""
        drive, engine = self._drive, self._engine
        rows = drive.ledger.with_fate(rows, Fate.WAITING)
        known, new = gtsam.Values(engine.estimate), gtsam.Values()
        start = station.start(self._guess(station, previous))
        for key in start.keys():  # noqa: SIM118  gtsam.Values is not a dictionary
            if not known.exists(key):
                copied(start, [key], new)
        known.insert(new)
        around = drive.near(previous.number) | {station.number} if previous is not None else {station.number}
        near, far = self._by_nearness(rows, {station.number: around})
        seen = self._sample(station, near)
        if seen is not None:
            found = localise(station, known, seen, self._local_priors(station, previous, known), robust=True)
            new.update(found.values)
            known.update(found.values)
        change = Change()
        drive.take_in(near, Postures(known), change, far)
        first = drive.stations[0].shared_priors() if station.number == 0 else []
        done = self._advanced(change, [*first, *station.factors(firm=False)], station, new)
        return self._closed(station, rows, far, change, done, begin)

    def _advanced(
        self,
        change: Change,
        factors: Sequence[gtsam.NonlinearFactor] = (),
        station: Station | None = None,
        values: gtsam.Values | None = None,
    ) -> list[Rounds]:
        """Bring the estimate up to date, and set aside what has come to lie behind its cameras."""
        drive, engine = self._drive, self._engine
        done = [engine.advance(change, factors, station, values)]
        late = Change()
        drive.drop_behind(Postures(engine.estimate), late)
        if late.touched or late.slots:
            change.rejected += late.rejected
            done.append(engine.advance(late))
        return done

    def _guess(self, station: Station, previous: Station | None) -> gtsam.Pose3:
        """Where odometry from the previous stop leads; without one, where telemetry has it."""
        said = station.traverse.stops[0].world_T_mast
        if previous is None or station.mast is None:
            return said
        moved = previous.traverse.stops[0].world_T_mast.between(said)
        return orthonormal(previous.world_T_mast(self._engine.estimate) * moved)

    def _local_priors(
        self, station: Station, previous: Station | None, values: gtsam.Values
    ) -> list[gtsam.NonlinearFactor]:
        """Priors of a station's own variables while the others are held."""
        between = station.motion
        if previous is None or previous.mast is None or not isinstance(between, gtsam.BetweenFactorPose3):
            return station.factors(firm=True)
        assert station.mast is not None  # odometry leads to masts that move
        moved = between.measured()
        own = copied(values, [previous.mast])
        held = gtsam.PriorFactorPose3(
            station.mast, orthonormal(own.atPose3(previous.mast) * moved), between.noiseModel()
        )
        return [held, *station.other_priors(firm=True)]

    def _by_nearness(self, rows: IntArray, around: dict[int, set[int]]) -> tuple[IntArray, IntArray]:
        """Rows of tracks that stations near their own see, and of tracks that are far off.

        `around` says which stations are near one, where that is not what shares landmarks with it. A track
        without a place is of where its first observations are.
        """
        drive, ledger = self._drive, self._drive.ledger
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

    def _sample(self, station: Station, rows: IntArray) -> Seen | None:
        """Tracks enough to say where a station is: with a place, or seen from there twice."""
        drive, track = self._drive, self._drive.ledger.track[rows]
        names, own, count = np.unique(track, return_inverse=True, return_counts=True)
        names = names[(count >= 2) | (drive.home(names) >= 0)]
        enough = _ENOUGH_PER_IMAGE * len(station.traverse.images)
        names = names[:: max(1, len(own) // enough)]
        rows = rows[np.isin(track, names)]
        return drive.excerpt(names, rows, station) if len(rows) and station.own else None

    def _closed(
        self,
        station: Station | None,
        rows: IntArray,
        far: IntArray,
        change: Change,
        done: list[Rounds],
        begin: float,
    ) -> Update:
        """Close loops with what sees tracks far off, and say what was done."""
        drive, engine, ledger = self._drive, self._engine, self._drive.ledger
        rejected, closures = change.rejected, list[Closure]()
        known = far[drive.home(ledger.track[far]) >= 0]
        for loop in loops(drive, known):
            values = engine.estimate
            covariance = self.relative_covariance(loop.anchor.id, loop.station.id)
            closure, found = judged(drive, loop, values, covariance, self.options)
            closures.append(closure)
            if not closure.accepted:
                ledger.set_fate(loop.rows, Fate.CLOSURE)
                rejected += len(loop.rows)
                continue
            factor = bridge(loop, values, found)
            if factor is not None:
                done.append(engine.bend(factor))
            change = Change()
            drive.take_in(loop.rows, Postures(engine.estimate), change, np.setdiff1d(far, loop.rows))
            done += self._advanced(change)
            rejected += change.rejected
        late = ledger.with_fate(np.setdiff1d(far, known), Fate.WAITING)
        # Pairs of rays across a loop say too little to be judged alone: they share the fate of the others.
        doubted = {c.stop for c in closures if not c.accepted} - {c.stop for c in closures if c.accepted}
        of_doubted = np.isin(drive.station_of(late), [self._stop[stop].number for stop in doubted])
        ledger.set_fate(late[of_doubted], Fate.CLOSURE)
        rejected += int(of_doubted.sum())
        late = late[~of_doubted]
        if len(late):
            change = Change()
            drive.take_in(late, Postures(engine.estimate), change, late[:0])
            if change.touched or change.slots:
                done += self._advanced(change)
            rejected += change.rejected
        return self._update(station, rows, rejected, done, tuple(closures), begin)

    def _update(
        self,
        station: Station | None,
        rows: IntArray,
        rejected: int,
        done: Sequence[Rounds],
        closures: tuple[Closure, ...],
        begin: float,
    ) -> Update:
        return Update(
            stop=None if station is None else station.id,
            observations=len(rows),
            rejected=rejected,
            blocks=sum(d.blocks for d in done),
            rounds=sum(d.rounds for d in done),
            relinearised=sum(d.relinearised for d in done),
            cost=self.cost,
            fell_back=any(d.fell_back for d in done),
            closures=closures,
            warnings=tuple(self._warnings(station, rows, closures)),
            seconds=time.perf_counter() - begin,
        )

    def _warnings(self, station: Station | None, rows: IntArray, closures: Sequence[Closure]) -> list[str]:
        drive, ledger, out = self._drive, self._drive.ledger, []
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
                    f"stop {c.stop}: {c.observations} observations of tracks at {c.other} are not believed: "
                    f"{why}"
                )
        # A place that a stop sees twice or more, and is not the one that the track has elsewhere.
        astray = drive.idle(distinct(ledger.track[rows]), Fate.OUTLIER)
        pairs = np.column_stack([ledger.track[astray], drive.station_of(astray)])
        pairs, counts = np.unique(pairs, axis=0, return_counts=True)
        track = distinct(pairs[counts >= 2, 0])
        if len(track):
            names = [str(t) for t in track]
            out.append(
                f"{listed(names, 'track')}: seen where other "
                "observations of the number have another place; left out"
            )
        return out

    def add_observations(self, observations: Observations) -> Update:
        """Add observations of images that were added before; `observations.image` are rows of `images`.

        Tracks far off that are seen again close a loop: they are believed if they agree on a pose of the stop
        that does not contradict the drive. Raises InputError, and changes nothing, for an image that was not
        added and for an image that has seen a track already.
        """
        begin = time.perf_counter()
        image = self._rows_of_images(observations)
        self._require_unseen(image, observations.track)
        with blas_on_one_thread():
            rows = self._drive.ledger.with_fate(self._append(observations, image), Fate.WAITING)
            near, far = self._by_nearness(rows, {})
            change = Change()
            self._drive.take_in(near, Postures(self._engine.estimate), change, far)
            return self._closed(None, rows, far, change, self._advanced(change), begin)

    def remove(self, observations: Observations) -> Update:
        """Take back observations: those with the same `image` (row of `images`) and `track`.

        Raises InputError, and changes nothing, for one that was not added.
        """
        begin = time.perf_counter()
        ledger = self._drive.ledger
        image = self._rows_of_images(observations)
        all_pairs, pairs = _pairs(ledger.image, ledger.track), _pairs(image, observations.track)
        there = np.flatnonzero(ledger.fate != int(Fate.REMOVED))
        order = there[np.argsort(all_pairs[there], kind="stable")]
        at = np.searchsorted(all_pairs[order], pairs).clip(max=max(len(order) - 1, 0))
        missing = all_pairs[order[at]] != pairs if len(order) else np.ones(len(pairs), dtype=bool)
        if missing.any():
            row = int(np.argmax(missing))
            raise InputError(
                f"observations: row {row}: expected an observation that was added, found image "
                f"{self.images[image[row]]!r} with track {observations.track[row]}"
            )
        rows = order[at]
        with blas_on_one_thread():
            used = ledger.with_fate(rows, Fate.USED)
            ledger.set_fate(rows, Fate.REMOVED)
            change = Change()
            self._drive.give_up(used, Postures(self._engine.estimate), change)
            done = self._advanced(change) if change.touched or change.slots else []
        return self._update(None, rows, change.rejected, done, (), begin)

    def _rows_of_images(self, observations: Observations) -> IntArray:
        n = len(self._image_row)
        wrong = (observations.image < 0) | (observations.image >= n)
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(
                f"observations: image, row {row}: expected a row of the {n} images of stops that were added, "
                f"found {observations.image[row]}"
            )
        return observations.image

    def _require_unseen(self, image: IntArray, track: IntArray) -> None:
        ledger = self._drive.ledger
        there = ledger.fate != int(Fate.REMOVED)
        pairs = _pairs(image, track)
        known = np.isin(pairs, _pairs(ledger.image[there], ledger.track[there]))
        if known.any():
            row = int(np.argmax(known))
            raise InputError(
                f"observations: row {row}: expected an image to see a track once, found image "
                f"{self.images[image[row]]!r}, track {track[row]} again"
            )

    # --- what is kept ---

    def state(self) -> SmootherState:
        """Everything, to go on from later. Raises InputError where no stop was added."""
        if not self._stop:
            raise InputError("smoother: expected at least one stop to keep, found none")
        drive, values, numbers = self._drive, self._engine.estimate, SmootherState.numbers
        blocks = [(name, block.placed) for name, block in sorted(drive.blocks.items())]
        keys = list(values.keys())
        parts = [numbers(values, key) for key in keys]
        none = np.zeros(0, dtype=np.int64)
        return SmootherState(
            traverse=whole_traverse(drive),
            options=self.options,
            after=np.array([s.after for s in drive.stations], dtype=np.int64),
            fate=drive.ledger.fate.astype(np.int64),
            track=np.concatenate([none, *(placed.track for _, placed in blocks)]),
            home=np.concatenate([none, *(np.full(len(placed.track), name) for name, placed in blocks)]),
            vector=np.concatenate([np.zeros((0, 4)), *(placed.landmarks.vector for _, placed in blocks)]),
            origin_m=np.concatenate([np.zeros((0, 3)), *(placed.landmarks.origin_m for _, placed in blocks)]),
            key=np.array(keys, dtype=np.int64),
            width=np.array([len(part) for part in parts], dtype=np.int64),
            value=np.concatenate([np.zeros(0), *parts]),
        )

    @staticmethod
    def of(state: SmootherState) -> "TraverseSmoother":
        """A smoother that goes on from a state: all is linearised where it was estimated to be."""
        t = state.traverse
        smoother = TraverseSmoother(t.rig, state.options)
        drive = smoother._drive
        with blas_on_one_thread():
            for number, stop in enumerate(t.stops):
                frames = tuple(t.frames[i] for i in np.flatnonzero(t.frame_stop == number))
                images = tuple(t.images[i] for i in np.flatnonzero(t.image_stop == number))
                own = Traverse(name="", rig=t.rig, stops=(stop,), frames=frames, images=images)
                station = Station(number, own, smoother._sharing, len(smoother._image_row))
                if (after := int(state.after[number])) >= 0:
                    smoother._join(station, drive.stations[after])
                smoother._enter(station, None)
            if t.observations is not None:
                smoother._append(t.observations, t.observations.image)
                drive.ledger.fate[:] = state.fate
            drive.restore(state.track, state.home, Landmarks(vector=state.vector, origin_m=state.origin_m))
            smoother._engine.restart(state.values())
        return smoother

    def save(self, path: Path | str) -> None:
        """Keep everything in a file (`.npz`), to go on from with `load`; an older one stays till it is whole.

        Raises InputError where there is nothing to keep or the file cannot be written.
        """
        from pancam_graph.io import save_smoother  # noqa: PLC0415  io imports this module

        save_smoother(self.state(), Path(path))

    @staticmethod
    def load(path: Path | str) -> "TraverseSmoother":
        """A smoother as it was saved. Raises InputError for a file of another version or a damaged one."""
        from pancam_graph.io import load_smoother  # noqa: PLC0415  io imports this module

        return TraverseSmoother.of(load_smoother(Path(path)))


def _pairs(image: IntArray, track: IntArray) -> IntArray:
    """One number for an image and a track."""
    return np.asarray(track * (1 << 24) + image)
