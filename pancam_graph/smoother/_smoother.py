"""The smoother of a drive: an estimate that is updated after every stop."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError, SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.options import options_of
from pancam_graph.base.threads import blas_on_one_thread
from pancam_graph.data import Constraint, DrivePart, Frame, Image, Observations, Stop, Traverse
from pancam_graph.graph import GraphKeys, HardTemplate, UserFactors, read_variable, stop_constraints
from pancam_graph.io import prefixed
from pancam_graph.landmarks import CameraViews, Landmarks, lines_of_sight
from pancam_graph.rigs import Rig
from pancam_graph.smoother._batch import whole_template, whole_traverse
from pancam_graph.smoother._covariances import joint_covariance, relative_covariance
from pancam_graph.smoother._engine import Engine
from pancam_graph.smoother._file import load_smoother, save_smoother
from pancam_graph.smoother._ledger import Fate
from pancam_graph.smoother._localise import localise
from pancam_graph.smoother._map import Change, DriveMap
from pancam_graph.smoother._nearness import by_nearness, sample
from pancam_graph.smoother._odometry import guess, join, local_priors
from pancam_graph.smoother._sets import distinct
from pancam_graph.smoother._smoother_options import Estimate, SmootherOptions, Update
from pancam_graph.smoother._state import SmootherState, state_of
from pancam_graph.smoother._state_checks import require_consistent
from pancam_graph.smoother._station import Postures, Station, copied
from pancam_graph.smoother._update_run import UpdateRun

__all__ = ["TraverseSmoother"]


class TraverseSmoother:
    """Mast poses, angles and terrain points of a drive, brought up to date after every stop by iSAM2.

    The model is the rigid mast (`mast` with a hard tie). Stops may come in any order.
    """

    def __init__(self, rig: Rig, options: SmootherOptions | None = None) -> None:
        """Begin an empty drive of a rover with this rig."""
        self.rig, self.options = rig, options_of(SmootherOptions, options, "TraverseSmoother")
        self._sharing = self.options.sharing_of(rig)
        self._drive = DriveMap(rig, self._sharing, self.options.outlier_sigma)
        self._engine = Engine(self._drive, self.options)
        self._stop: dict[str, Station] = {}
        self._image_row: dict[str, int] = {}
        self._frame_ids: set[str] = set()

    # --- estimates ---

    @property
    def stops(self) -> tuple[str, ...]:
        """Ids of the stops, in the order in which they were added."""
        return tuple(self._stop)

    @property
    def images(self) -> tuple[str, ...]:
        """Ids of the images, in the order in which they were added."""
        return tuple(self._image_row)

    def values(self) -> gtsam.Values:
        """Estimates of all variables, under the keys of a batch template of the drive."""
        return gtsam.Values(self._engine.estimate)

    def values_on(self, template: HardTemplate) -> gtsam.Values:
        """Estimates of all variables under the keys of a template of the drive in another order."""
        own, out = self._template.owners, gtsam.Values()
        for owner, key in template.owners.items():
            out.insert(key, read_variable(self._engine.estimate, own[owner]))
        return out

    @property
    def traverse(self) -> Traverse:
        """All stops with all observations, in the order in which they were added."""
        return whole_traverse(self._drive)

    @property
    def used(self) -> BoolArray:
        """(observations,) whether each observation of `traverse` takes part."""
        return np.asarray(self._drive.ledger.fate == int(Fate.USED))

    @property
    def fate(self) -> IntArray:
        """(observations,) what became of each observation of `traverse`, as values of `Fate`."""
        return self._drive.ledger.fate.astype(np.int64)

    @property
    def n_factors(self) -> int:
        """Number of the caller's factors (`add_factors`), ties on stops and frames among them."""
        return len(self._drive.given)

    @property
    def cost(self) -> float:
        """Half the sum of squares of everything that is used, priors included, as the last update left it."""
        return self._engine.cost if self._stop else 0.0

    def estimate(self) -> Estimate:
        """Estimated mast poses of all stops and angles of all frames."""
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
        return joint_covariance(self._engine, [self._station(stop)])

    def relative_covariance(self, stop_a: str, stop_b: str) -> FloatArray:
        """Covariance (6, 6) of a_T_b, the pose of b's mast in a's frame; rotation first, in b's frame."""
        return relative_covariance(self._engine, self._station(stop_a), self._station(stop_b))

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
        changes nothing, for an id that was added before and for a number out of its range.
        """
        entries = DrivePart(
            name="",
            rig=self.rig,
            stops=(stop,),
            frames=tuple(frames),
            images=tuple(images),
            observations=observations if observations is not None and len(observations) else None,
        )
        self._require_new(entries)
        previous = self._station(after) if after is not None else next(reversed(self._stop.values()), None)
        station = Station(len(self._stop), entries, self._sharing, len(self._image_row))
        run = self._run(station)
        if previous is not None:
            self._follow(station, previous)
        with blas_on_one_thread():
            run.rows = self._drive.ledger.with_fate(self._enter(station, observations), Fate.WAITING)
            self._place(station, previous, run)
        return run.finished()

    def _run(self, station: Station | None = None) -> UpdateRun:
        return UpdateRun(self._drive, self._engine, self.options, station)

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

    def _follow(self, station: Station, previous: Station) -> None:
        """Record the station before, and the odometry from it where that replaces the mast's prior."""
        station.after = previous.number
        if self.options.telemetry == "odometry":
            join(station, previous)

    def _enter(self, station: Station, observations: Observations | None) -> IntArray:
        """Register a station and its observations; return the rows of these in the ledger."""
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
        cameras = CameraViews.of([one.camera for one in self.rig.eyes])
        *_, valid = lines_of_sight(eye, observations.uv_px, cameras)
        return self._drive.ledger.append(image, observations, valid)

    def _place(self, station: Station, previous: Station | None, run: UpdateRun) -> None:
        """Localise a new station, and add its observations."""
        drive, engine = self._drive, self._engine
        known, new = gtsam.Values(engine.estimate), gtsam.Values()
        said = station.start(guess(station, previous, engine.estimate))
        for key in said.keys():  # noqa: SIM118  gtsam.Values is not a dictionary
            if not known.exists(key):
                copied(said, [key], new)
        known.insert(new)
        start = gtsam.Values(known)
        around = drive.near(previous.number) | {station.number} if previous is not None else {station.number}
        near, far = by_nearness(drive, run.rows, {station.number: around})
        seen = sample(drive, station, near)
        if seen is not None:
            located = localise(station, known, seen, local_priors(station, previous, known), robust=True)
            known.update(located.values)
        change = Change()
        known = run.take_in(near, known, change, far, around, start)
        new = copied(known, new.keys())
        run.advance(change, [*drive.shared_priors(station), *station.factors(firm=False)], new)
        run.close_loops(far)

    def add_observations(self, observations: Observations) -> Update:
        """Add observations of images that were added before; `observations.image` are rows of `images`.

        Observations of tracks far off are tested as a loop closure: they take part if they agree on a pose of
        the stop that does not contradict the drive. Raises InputError, and changes nothing, for an image that
        was not added and for an image that has seen a track already.
        """
        run, drive, engine = self._run(), self._drive, self._engine
        image = self._rows_of_images(observations)
        known = drive.ledger.find(image, observations.track) >= 0
        if known.any():
            row = int(np.argmax(known))
            raise InputError(
                f"observations: row {row}: expected an image to see a track once, found image "
                f"{self.images[image[row]]!r}, track {observations.track[row]} again"
            )
        with blas_on_one_thread():
            run.rows = drive.ledger.with_fate(self._append(observations, image), Fate.WAITING)
            near, far = by_nearness(drive, run.rows, {})
            change = Change()
            around = {n for i in distinct(drive.station_of(run.rows)).tolist() for n in drive.near(i)}
            run.take_in(near, engine.estimate, change, far, around, engine.estimate)
            run.advance(change)
            run.close_loops(far)
            return run.finished()

    @property
    def keys(self) -> GraphKeys:
        """Keys of the stops, frames and the rig so far, for `add_factors`.

        Frames are numbered as added. Raises InputError where no stop was added.
        """
        return self._template.keys

    @property
    def _template(self) -> HardTemplate:
        if not self._stop:
            raise InputError("smoother: expected at least one stop to have keys of, found none")
        return whole_template(self._drive)

    def add_factors(self, factors: UserFactors) -> Update:
        """Add GTSAM factors of the caller's, on `keys`; they take part from now on, as in `solve`.

        Raises InputError, and changes nothing, for a factor that cannot be evaluated where the drive is.
        """
        return self.add_factors_of(self._template, factors)

    def add_constraints(self, constraints: Sequence[Constraint]) -> Update:
        """Add ties on stops and frames; they take part from now on, and are never let go.

        Raises InputError, and changes nothing, for a tie on a stop that was not added or that telemetry
        holds, and for one on terrain points: these are eliminated at places that move with their stops
        (`solve_incrementally` has them in its last step).
        """
        for i, one in enumerate(constraints):
            if one.landmarks:
                raise InputError(
                    f"constraints[{i}] ({one.about}): expected a tie on stops or frames, found one on "
                    "terrain points"
                )
        tied = replace(self._template.traverse, constraints=tuple(constraints))
        return self.add_factors([one.factor for one in stop_constraints(tied, self._template)])

    def add_factors_of(self, template: HardTemplate, factors: UserFactors) -> Update:
        """The same on the keys of a template of the whole drive, which may be in another order."""
        run = self._run()
        with blas_on_one_thread():
            new = self._drive.take_factors(template, self._template, factors, self._engine.estimate)
            if new:
                run.advance(Change(), new)
            return run.finished()

    def remove(self, observations: Observations) -> Update:
        """Take back observations: those with the same `image` (row of `images`) and `track`.

        Raises InputError, and changes nothing, for one that was not added.
        """
        run, ledger = self._run(), self._drive.ledger
        image = self._rows_of_images(observations)
        rows = ledger.find(image, observations.track)
        missing = rows < 0
        if missing.any():
            row = int(np.argmax(missing))
            raise InputError(
                f"observations: row {row}: expected an observation that was added, found image "
                f"{self.images[image[row]]!r} with track {observations.track[row]}"
            )
        with blas_on_one_thread():
            used = ledger.with_fate(rows, Fate.USED)
            ledger.set_fate(rows, Fate.REMOVED)
            change = Change()
            self._drive.give_up(used, Postures(self._engine.estimate), change)
            run.rows = rows
            run.advance_if_changed(change)
            return run.finished()

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

    # --- saving and loading ---

    def state(self) -> SmootherState:
        """The state of the drive, from which `of` makes a smoother that continues.

        Raises InputError where no stop was added.
        """
        if not self._stop:
            raise InputError("smoother: expected at least one stop to keep, found none")
        return state_of(self._drive, self.options, self._engine.estimate)

    @staticmethod
    def of(state: SmootherState, factors: UserFactors = ()) -> "TraverseSmoother":
        """A smoother that continues from a state, linearised at its estimate.

        `factors` are those that the caller had added: a state cannot keep them. Raises InputError for another
        number of them, and for a state whose entries are out of range or contradict each other.
        """
        require_consistent(state)
        t = state.traverse
        smoother = TraverseSmoother(t.rig, state.options)
        drive = smoother._drive
        with blas_on_one_thread():
            for number, stop in enumerate(t.stops):
                frames = tuple(t.frames[i] for i in np.flatnonzero(t.frame_stop == number))
                images = tuple(t.images[i] for i in np.flatnonzero(t.image_stop == number))
                entries = DrivePart(name="", rig=t.rig, stops=(stop,), frames=frames, images=images)
                station = Station(number, entries, smoother._sharing, len(smoother._image_row))
                if (after := int(state.after[number])) >= 0:
                    smoother._follow(station, drive.stations[after])
                smoother._enter(station, None)
            if t.observations is not None:
                smoother._append(t.observations, t.observations.image)
                drive.ledger.take_over(state.fate)
            drive.restore(state.track, state.home, Landmarks(vector=state.vector, origin_m=state.origin_m))
            values = state.values()
            drive.take_factors(smoother._template, smoother._template, factors, values)
            if len(drive.given) != state.n_given:
                raise InputError(
                    f"factors: expected the {state.n_given} that were added before the smoother was kept, "
                    f"found {len(drive.given)}"
                )
            smoother._engine.restart(values)
        if not np.isfinite(smoother.cost):
            raise InputError(f"state: expected a finite cost, found {smoother.cost}")
        return smoother

    def save(self, path: Path | str) -> None:
        """Write the state to a file (`.npz`) for `load`; only a complete file replaces an older one.

        Raises InputError where no stop was added or the file cannot be written.
        """
        save_smoother(self.state(), Path(path))

    @staticmethod
    def load(path: Path | str, factors: UserFactors = ()) -> "TraverseSmoother":
        """A smoother that continues from a saved file; `factors` as for `of`.

        Raises InputError for a file of another version or a damaged one.
        """
        path = Path(path)
        state = load_smoother(path)
        with prefixed(path), np.errstate(all="ignore"):  # a cost that overflows is refused as such
            try:
                return TraverseSmoother.of(state, factors)
            except (
                SolveError,
                RuntimeError,
                np.linalg.LinAlgError,
            ) as error:  # also GTSAM's of singular systems
                why = " ".join(str(error).split()) or type(error).__name__
                raise InputError(
                    f"expected a drive that can be solved, found one that cannot: {why}"
                ) from error
