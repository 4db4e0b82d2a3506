"""The data model: stops, frames, images and observations of a rover traverse.

A stop is one place of the mast, a frame one pointing of the head, an image one eye's picture of a
frame, a track one terrain point seen in several images.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from pancam_graph.base.arrays import float_array, int_array
from pancam_graph.base.choices import expected_one_of, nearest, some_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, compose, pose_arrays
from pancam_graph.data._constraints import Constraint, FrameSeen, Landmark
from pancam_graph.data._matching import Matching
from pancam_graph.data._noise import PixelNoise, mean_sigma_px
from pancam_graph.data._points import NamedPoints
from pancam_graph.data._sharing import Sharing
from pancam_graph.data._site import Site
from pancam_graph.rigs import Rig

__all__ = [
    "UNKNOWN_RAD",
    "VAGUE_RAD",
    "DrivePart",
    "Frame",
    "Image",
    "Observations",
    "Stop",
    "Tile",
    "Traverse",
]

UNKNOWN_RAD = float(np.pi)
"""Standard deviation from which on a pan or tilt is not known at all."""
VAGUE_RAD = float(np.deg2rad(2.0))
"""Standard deviation of a pan or tilt beyond which features are not sought where it says."""

_ASYMMETRY = 1e-9
"""Largest difference of a covariance's two mixed entries, as a share of its larger variance."""
_FLATTEST = 1e-12
"""Least determinant of a covariance whose larger variance is 1: less is singular but for rounding."""
_AGREE = 0.01
"""Largest share by which a sigma may differ from what goes with its covariance."""


@dataclass(frozen=True, kw_only=True)
class Stop:
    """One place where the mast stood."""

    id: str
    world_T_mast: gtsam.Pose3
    """Pose of the mast in the world as odometry or localisation gives it; the mean of the prior."""
    sigma_rotation_rad: float
    """Standard deviation of the prior for each rotation component, radians; 0 holds the rotation."""
    sigma_translation_m: float
    """Standard deviation of the prior for each coordinate, metres; 0 holds the position."""

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations (6,) of the prior in the tangent of the pose, rotation first."""
        return np.repeat([self.sigma_rotation_rad, self.sigma_translation_m], 3)


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One pointing of the head, shared by all eyes."""

    id: str
    stop: str
    """Id of the stop."""
    pan_rad: float
    """Pan angle as telemetry gives it, radians; positive anticlockwise seen from above."""
    tilt_rad: float
    """Tilt angle as telemetry gives it, radians; positive upwards."""
    sigma_pan_rad: float
    """Standard deviation of the pan prior; 0 holds the pan."""
    sigma_tilt_rad: float
    """Standard deviation of the tilt prior; 0 holds the tilt."""

    @property
    def sigmas_rad(self) -> FloatArray:
        """Standard deviations (2,) of pan and tilt."""
        return np.array([self.sigma_pan_rad, self.sigma_tilt_rad])

    @property
    def is_vague(self) -> bool:
        """Whether its pointing is known so badly that pictures are to tell it."""
        return max(self.sigma_pan_rad, self.sigma_tilt_rad) > VAGUE_RAD


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A file with a part of an image: a window of the camera's picture."""

    file: str
    """Path of the image file relative to the traverse folder."""
    left_px: int
    """Column of the image in which the file's first one is."""
    top_px: int
    """Row of the image in which the file's first one is."""


@dataclass(frozen=True, kw_only=True)
class Image:
    """One eye's picture of a frame."""

    id: str
    frame: str
    """Id of the frame."""
    camera: str
    """Name of the eye."""
    file: str | None = None
    """Path of the image file relative to the traverse folder, if there is one."""
    mask: str | None = None
    """Path of a mask relative to the traverse folder: white where the image may be used, black where not."""
    tiles: tuple[Tile, ...] = ()
    """Files that have a part of the image each, where no file has all of it; `file` is the first of them."""

    def __post_init__(self) -> None:
        """Name the first tile's file. Raises InputError for another one beside tiles, or a negative place."""
        if not self.tiles:
            return
        if self.file not in {None, self.tiles[0].file}:
            raise InputError(
                f"images: {self.id}: expected a file or tiles, found the file {self.file!r} beside tiles"
            )
        for i, tile in enumerate(self.tiles):
            if min(tile.left_px, tile.top_px) < 0:
                raise InputError(
                    f"images: {self.id}: tiles[{i}]: expected left_px and top_px of 0 or more, "
                    f"found {tile.left_px} and {tile.top_px}"
                )
        object.__setattr__(self, "file", self.tiles[0].file)

    @property
    def files(self) -> tuple[str, ...]:
        """All files that the image is in."""
        if self.tiles:
            return tuple(tile.file for tile in self.tiles)
        return () if self.file is None else (self.file,)


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Pixels at which images see tracks: n observations as columns of equal length."""

    image: IntArray
    """(n,) row in the traverse's images."""
    track: IntArray
    """(n,) number of the track, 0 or above; not every number need occur."""
    uv_px: FloatArray
    """(n, 2) measured pixel (u, v); the centre of the top-left pixel is (0, 0)."""
    sigma_px: FloatArray
    """(n,) standard deviation of each coordinate, pixels; with covariances, the root of their mean
    variance."""
    covariance_px2: FloatArray | None = None
    """(n, 2, 2) covariance of (u, v), symmetric and positive definite; None means sigma_px^2 I."""
    origin: Literal["given", "images"] = "given"
    """"images" if this package measured the pixels: their sigmas are guesses, which a solve rescales."""
    point_track: Mapping[str, int] = field(default_factory=dict)
    """Track of each named point whose marks are among the rows (`with_points`)."""

    def __post_init__(self) -> None:
        """Turn the columns to int64 and float64. Raises InputError for what is no number, or masked."""
        for name, turned in (
            ("image", int_array),
            ("track", int_array),
            ("uv_px", float_array),
            ("sigma_px", float_array),
            ("covariance_px2", float_array),
        ):
            column = getattr(self, name)
            if column is not None or name != "covariance_px2":
                object.__setattr__(self, name, turned(f"observations: {name}", column))

    def __len__(self) -> int:
        """Number of observations."""
        return len(self.image)

    @cached_property
    def tracks(self) -> frozenset[int]:
        """Numbers of the tracks that occur."""
        return frozenset(np.unique(self.track).tolist())

    @property
    def noise(self) -> PixelNoise:
        """Noise of the observations, which decides their weight."""
        return PixelNoise(sigma_px=self.sigma_px, covariance_px2=self.covariance_px2)

    def with_covariance(self, covariance_px2: FloatArray) -> "Observations":
        """The same observations with other covariances (n, 2, 2), and the sigmas that belong to them."""
        return replace(self, covariance_px2=covariance_px2, sigma_px=mean_sigma_px(covariance_px2))

    def with_points(self, points: NamedPoints | None) -> "Observations":
        """These observations, then the marks of named points, whose tracks follow the largest here."""
        if points is None or not len(points):
            return self
        first = int(self.track.max(initial=-1)) + 1
        track = {name: first + i for i, name in enumerate(points.names)}
        covariance = self.covariance_px2
        if covariance is not None:
            own = points.sigma_px[:, None, None] ** 2 * np.eye(2)
            covariance = np.concatenate([covariance, own])
        return replace(
            self,
            image=np.concatenate([self.image, points.image]),
            track=np.concatenate([self.track, [track[name] for name in points.name]]),
            uv_px=np.concatenate([self.uv_px, points.uv_px]),
            sigma_px=np.concatenate([self.sigma_px, points.sigma_px]),
            covariance_px2=covariance,
            point_track=track,
        )

    def without_points(self) -> "Observations":
        """The observations that are no marks of named points."""
        if not self.point_track:
            return self
        marks = np.isin(self.track, list(self.point_track.values()))
        return replace(self.select(~marks), point_track={})

    def select(self, rows: BoolArray | IntArray) -> "Observations":
        """The observations of some rows, by mask or index."""
        noise = self.noise.select(rows)
        return replace(
            self,
            image=self.image[rows],
            track=self.track[rows],
            uv_px=self.uv_px[rows],
            sigma_px=noise.sigma_px,
            covariance_px2=noise.covariance_px2,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Traverse:
    """Everything known before the adjustment; the constructor checks that all entries fit together.

    Raises InputError naming the entry for duplicate ids, unknown stops, frames or cameras, numbers
    that are not finite, negative sigmas, and observations out of range.
    """

    name: str
    rig: Rig
    stops: tuple[Stop, ...]
    frames: tuple[Frame, ...]
    images: tuple[Image, ...]
    observations: Observations | None = None
    """Measured pixels; None if they are still to be measured in the image files."""
    sharing: Sharing | None = None
    """Numbers of the rig to estimate, unless the options of a solve say otherwise; None if unstated."""
    folder: Path | None = None
    """Folder that paths of image files are relative to; None for a traverse made in memory."""
    parts: tuple[str, ...] = ()
    """Folders that it was read from, relative to `folder`, where they are several."""
    warnings: tuple[str, ...] = field(default=())
    """Sentences about the input that a reader of it wrote for the user."""
    matching: Matching | None = None
    """Statistics of the search for observations in images; None for observations from elsewhere."""
    constraints: tuple[Constraint, ...] = ()
    """What is known of terrain points and stops beside pictures and telemetry."""
    site: Site | None = None
    """Where the world is on its planet; None: unknown, all is local."""
    points: NamedPoints | None = None
    """Marks of named points; `observations`, once there are any, have them too (`with_points`)."""

    _of_which_one: ClassVar[tuple[str, ...]] = ("stops", "frames", "images")
    """Kinds of entries of which there must be one at least."""

    def __repr__(self) -> str:
        """Its name, its rig, and how much of what it has."""
        seen = "no observations yet"
        if self.observations is not None:
            tracks = len(np.unique(self.observations.track))
            seen = f"{len(self.observations)} observations of {tracks} tracks"
        return (
            f"Traverse {self.name!r}: {len(self.stops)} stops, {len(self.frames)} frames and "
            f"{len(self.images)} images of the rig {self.rig.name!r}, {seen}"
        )

    def __post_init__(self) -> None:
        """Check ids, references and ranges."""
        for kind, entries in (("stops", self.stops), ("frames", self.frames), ("images", self.images)):
            if not entries and kind in self._of_which_one:
                raise InputError(f"{kind}: expected at least one entry, found none")
            _require_unique(kind, [e.id for e in entries])
        stop_ids, frame_ids = {s.id for s in self.stops}, {f.id for f in self.frames}
        eye_names = {e.name for e in self.rig.eyes}
        for stop in self.stops:
            where = f"stops: {stop.id}"
            _require_numbers(where, pose=[*stop.world_T_mast.matrix().ravel()])
            _require_sigmas(
                where,
                sigma_rotation_rad=stop.sigma_rotation_rad,
                sigma_translation_m=stop.sigma_translation_m,
            )
        for frame in self.frames:
            where = f"frames: {frame.id}"
            if frame.stop not in stop_ids:
                raise InputError(f"{where}: stop: expected the id of a stop, found {frame.stop!r}")
            _require_numbers(where, pan_rad=[frame.pan_rad], tilt_rad=[frame.tilt_rad])
            _require_sigmas(where, sigma_pan_rad=frame.sigma_pan_rad, sigma_tilt_rad=frame.sigma_tilt_rad)
        for image in self.images:
            where = f"images: {image.id}"
            if image.frame not in frame_ids:
                raise InputError(f"{where}: frame: expected the id of a frame, found {image.frame!r}")
            if image.camera not in eye_names:
                raise InputError(
                    f"{where}: camera: expected one of {', '.join(sorted(eye_names))}, found {image.camera!r}"
                )
        _require_unique("images: frame and camera", [f"{i.frame} {i.camera}" for i in self.images])
        if self.observations is not None:
            _require_observations(self.observations, len(self.images))
        if self.points is not None:
            wrong = (self.points.image < 0) | (self.points.image >= len(self.images))
            _require_rows(
                "image", f"a row of images, 0 to {len(self.images) - 1}", wrong, self.points.image, "points"
            )
            self._require_marks_in_images(self.points)
        self._require_constraints()

    def _require_marks_in_images(self, points: NamedPoints) -> None:
        """Raise InputError for a mark beside its picture."""
        for name, row, (u, v) in zip(points.name, points.image.tolist(), points.uv_px.tolist(), strict=True):
            camera = self.rig.eyes[int(self.image_eye[row])].camera
            if not (-0.5 <= u <= camera.width_px - 0.5 and -0.5 <= v <= camera.height_px - 0.5):
                raise InputError(
                    f"points: {name}: image {self.images[row].id}: expected pixels in a picture of "
                    f"{camera.width_px} x {camera.height_px}, found ({u:g}, {v:g})"
                )

    def _require_constraints(self) -> None:
        """Raise InputError for a constraint on what there is not, and for exact ones that contradict."""
        stops = [s.id for s in self.stops]
        held = {s.id for s in self.stops if not s.sigmas.any()}
        alike: dict[tuple[object, ...], list[int]] = {}
        for i, one in enumerate(self.constraints):
            where = f"constraints[{i}] ({one.kind})"
            for stop in one.stops:
                if stop not in stops:
                    raise InputError(expected_one_of(f"{where}: stop", stop, stops))
            if isinstance(one, FrameSeen):
                self._require_in_picture(one, where)
            for landmark in one.landmarks:
                self.track_of(landmark, f"{where}: landmark")
            if one.stops and not one.landmarks and held.issuperset(one.stops):
                raise InputError(
                    f"{where}: expected a stop that can move, found {' and '.join(one.stops)} held by sigma 0"
                )
            before = alike.setdefault((one.kind, frozenset(one.landmarks), frozenset(one.stops)), [])
            for j in before:
                if one.contradicts(self.constraints[j]):
                    raise InputError(
                        f"{where}: expected what constraints[{j}] says, which is exact (sigma 0) as this is; "
                        "found another value"
                    )
            before.append(i)

    def _require_in_picture(self, one: FrameSeen, where: str) -> None:
        """Raise InputError for something seen in a picture that there is not, or beside it."""
        for what, name, names in (
            ("frame", one.frame, [f.id for f in self.frames]),
            ("camera", one.camera, [eye.name for eye in self.rig.eyes]),
        ):
            if name not in names:
                raise InputError(expected_one_of(f"{where}: {what}", name, names))
        image = self.image_of(one)
        if image is None:
            cameras = ", ".join(i.camera for i in self.images if i.frame == one.frame) or "none"
            raise InputError(
                f"{where}: expected an image of {one.frame} by {one.camera}; found images by {cameras}"
            )
        camera = self.rig.eyes[int(self.image_eye[image])].camera
        if not camera.contains(np.array([[one.u_px, one.v_px]]))[0]:
            raise InputError(
                f"{where}: expected pixels in a picture of {camera.width_px} x {camera.height_px}, found "
                f"({one.u_px:g}, {one.v_px:g})"
            )

    def image_of(self, one: FrameSeen) -> int | None:
        """Row of the image that something is seen in; None where there is no such image."""
        seen = one.frame, one.camera
        return next((i for i, image in enumerate(self.images) if (image.frame, image.camera) == seen), None)

    def track_of(self, landmark: Landmark, where: str = "landmark") -> int | None:
        """Number of the track of a landmark, by name or number; None where it has none yet.

        Raises InputError, beginning with `where`, for a name that is not in `points`, and for a track that
        no observation has.
        """
        known = {} if self.observations is None else dict(self.observations.point_track)
        names = list(dict.fromkeys([*known, *(() if self.points is None else self.points.names)]))
        if isinstance(landmark, str) and landmark in names:
            return known.get(landmark)
        if isinstance(landmark, int | np.integer) or landmark.isdecimal():
            track = int(landmark)
            if self.observations is not None and track in self.observations.tracks:
                return track
            found = (
                f"{landmark}, which no observation has"
                if self.observations is not None
                else (f"{landmark}: tracks that are still to be found have no numbers")
            )
            raise InputError(f"{where}: expected a name of points or the number of a track, found {found}")
        there = f"one of {some_of(names)}" if names else "a name of points, of which there are none"
        raise InputError(f"{where}: expected {there}; found {landmark!r}{nearest(landmark, names)}")

    @cached_property
    def frame_stop(self) -> IntArray:
        """(frames,) row of each frame's stop."""
        row = {s.id: i for i, s in enumerate(self.stops)}
        return np.array([row[f.stop] for f in self.frames], dtype=np.int64)

    @cached_property
    def image_frame(self) -> IntArray:
        """(images,) row of each image's frame."""
        row = {f.id: i for i, f in enumerate(self.frames)}
        return np.array([row[i.frame] for i in self.images], dtype=np.int64)

    @cached_property
    def image_eye(self) -> IntArray:
        """(images,) index of each image's eye in the rig."""
        row = {e.name: i for i, e in enumerate(self.rig.eyes)}
        return np.array([row[i.camera] for i in self.images], dtype=np.int64)

    @cached_property
    def image_stop(self) -> IntArray:
        """(images,) row of each image's stop."""
        return self.frame_stop[self.image_frame]

    @cached_property
    def calibration(self) -> FloatArray:
        """(images, 3, 3) calibration matrix K of each image in the rig, upper-triangular, no distortion."""
        return np.array([p.calibration_matrix for p in self.rig.pinholes])[self.image_eye]

    @cached_property
    def pan_tilt_rad(self) -> FloatArray:
        """(frames, 2) pan and tilt as telemetry gives them."""
        return np.array([[f.pan_rad, f.tilt_rad] for f in self.frames]).reshape(-1, 2)

    @cached_property
    def pan_tilt_sigmas_rad(self) -> FloatArray:
        """(frames, 2) sigmas of pan and tilt; 0: telemetry holds it."""
        return np.array([frame.sigmas_rad for frame in self.frames]).reshape(-1, 2)

    def camera_poses(
        self,
        world_T_mast: Sequence[gtsam.Pose3] | None = None,
        pan_tilt_rad: FloatArray | None = None,
        flex: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """`world_R_camera` (images, 3, 3) and centres (images, 3), metres, of all images by the mast chain.

        `world_T_mast` (one a stop) and `pan_tilt_rad` (frames, 2) default to telemetry, `flex` (frames, 4),
        as `Rig.mast_T_camera` takes it, to a rigid mast.
        """
        poses = world_T_mast if world_T_mast is not None else [s.world_T_mast for s in self.stops]
        angles = pan_tilt_rad if pan_tilt_rad is not None else self.pan_tilt_rad
        stops_R, stops_t = pose_arrays(poses)
        of_image = None if flex is None else flex[self.image_frame]
        mast_T_camera = self.rig.mast_T_camera(angles[self.image_frame], self.image_eye, of_image)
        return compose(stops_R[self.image_stop], stops_t[self.image_stop], *mast_T_camera)

    def with_observations(
        self, observations: Observations, warnings: Sequence[str] = (), *, matching: Matching | None = None
    ) -> "Traverse":
        """The same traverse with other observations, further warnings, and statistics of matching."""
        warnings = (*self.warnings, *warnings)
        return replace(self, observations=observations, warnings=warnings, matching=matching)

    def with_warnings(self, warnings: Sequence[str]) -> "Traverse":
        """The same traverse with more warnings; what its constructor has checked is not checked again."""
        other = copy(self)
        object.__setattr__(other, "warnings", (*self.warnings, *warnings))
        return other


@dataclass(frozen=True, kw_only=True, eq=False)
class DrivePart(Traverse):
    """Some stops of a drive, where nothing may have been pointed or photographed."""

    _of_which_one: ClassVar[tuple[str, ...]] = ("stops",)


def _require_unique(kind: str, ids: Sequence[str]) -> None:
    seen: set[str] = set()
    for name in ids:
        if name in seen:
            raise InputError(f"{kind}: expected different ids, found {name!r} twice")
        seen.add(name)


def _require_numbers(where: str, **numbers: Sequence[float]) -> None:
    for name, values in numbers.items():
        if not np.all(np.isfinite(float_array(f"{where}: {name}", values))):
            raise InputError(f"{where}: {name}: expected finite numbers, found {list(values)}")


def _require_sigmas(where: str, **sigmas: float) -> None:
    for name, sigma in sigmas.items():
        if not (np.isfinite(float_array(f"{where}: {name}", sigma)) and sigma >= 0):
            raise InputError(f"{where}: {name}: expected 0 (held) or a positive number, found {sigma}")


def _require_observations(obs: Observations, n_images: int) -> None:
    n = obs.image.size  # of a single value too, which has no length
    for name, column, shape in (
        ("image", obs.image, (n,)),
        ("track", obs.track, (n,)),
        ("uv_px", obs.uv_px, (n, 2)),
        ("sigma_px", obs.sigma_px, (n,)),
        ("covariance_px2", obs.covariance_px2, (n, 2, 2)),
    ):
        if column is not None and column.shape != shape:
            raise InputError(f"observations: {name}: expected shape {shape}, found {column.shape}")
    if n == 0:
        raise InputError("observations: expected at least one, found none")
    _require_rows(
        "image",
        f"a row of images, 0 to {n_images - 1}",
        (obs.image < 0) | (obs.image >= n_images),
        obs.image,
    )
    _require_rows("track", "a number of 0 or above", obs.track < 0, obs.track)
    _require_rows("uv_px", "finite pixels", ~np.isfinite(obs.uv_px).all(axis=1), obs.uv_px)
    sigma_px, covariance_px2 = obs.sigma_px, obs.covariance_px2
    # Covariances first: where they stand alone in a file, the sigmas were made of them.
    if covariance_px2 is not None:
        _require_covariances(covariance_px2)
    wrong = ~(np.isfinite(sigma_px) & (sigma_px > 0))
    _require_rows("sigma_px", "a finite number above 0", wrong, sigma_px)
    if covariance_px2 is not None:
        mean = mean_sigma_px(covariance_px2)
        other = np.abs(sigma_px - mean) > _AGREE * mean
        right = (
            f"{mean[np.argmax(other)]:.6g}, the root of the mean variance in covariance_px2, or no sigma_px"
        )
        _require_rows("sigma_px", right, other, sigma_px)
    order = np.lexsort((obs.track, obs.image))
    image, track = obs.image[order], obs.track[order]
    twice = (image[1:] == image[:-1]) & (track[1:] == track[:-1])
    if twice.any():
        row = int(np.argmax(twice))
        raise InputError(
            f"observations: expected an image to see a track once, found image {image[row]}, "
            f"track {track[row]} twice"
        )


def _require_rows(
    name: str,
    expected: str,
    wrong: ArrayLike,
    column: FloatArray | IntArray,
    table: str = "observations",
) -> None:
    """Raise InputError naming the first row of a table that is wrong."""
    if np.any(wrong):
        row = int(np.argmax(wrong))
        found = column[row].tolist()
        raise InputError(f"{table}: {name}, row {row}: expected {expected}, found {found}")


def _require_covariances(covariance_px2: FloatArray) -> None:
    name, c = "covariance_px2", covariance_px2
    _require_rows(name, "finite numbers", ~np.isfinite(c).all(axis=(1, 2)), c)
    _require_rows(name, "variances above 0", ~((c[:, 0, 0] > 0) & (c[:, 1, 1] > 0)), c)
    with np.errstate(over="ignore"):  # a matrix that overflows fails the tests below
        scaled = c / np.maximum(c[:, 0, 0], c[:, 1, 1])[:, None, None]
        skewed = ~(np.abs(scaled[:, 0, 1] - scaled[:, 1, 0]) <= _ASYMMETRY)
        determinant = scaled[:, 0, 0] * scaled[:, 1, 1] - scaled[:, 1, 0] ** 2
    _require_rows(name, "a symmetric matrix", skewed, c)
    _require_rows(name, "a positive definite matrix", ~(determinant > _FLATTEST), c)
