"""Landmarks as unit 4-vectors: linear triangulation, refinement with cameras held, redundancy.

A landmark is (X, w) on the sphere S^3 (thesis eq. 4.1, without its surplus scale), relative to an origin
of its own near the cameras that see it: the point is origin + X / w. A pixel is a ratio of linear
functions of (X, w), so a ridge on the horizon (w near 0) is an ordinary landmark, and a landmark that starts
beyond infinity (w below 0) can come back.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.threads import in_parallel
from pancam_graph.cameras import Camera, Fields, LensTable, fields_of
from pancam_graph.landmarks import kernel
from pancam_graph.landmarks._losses import SQUARED, Loss

_GRAIN = 512
"""Landmarks that one thread takes at once where each is iterated on: about half a millisecond."""
_LIGHT_GRAIN = 8192
"""The same where each observation is looked at once: threads wait for the interpreter's lock longer than
shorter ranges take."""
_RAY_GRAIN = 16384
SETTLED = 1e-9
"""Refinement of a landmark ends when a step promises to lower its cost by no more than this share."""

__all__ = [
    "SETTLED",
    "CameraViews",
    "Landmarks",
    "Measurements",
    "evaluate",
    "free_derivatives",
    "lines_of_sight",
    "point_sigma_m",
    "rays_of",
    "refine",
    "residual_cofactor",
    "residuals",
    "triangulate",
]


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraViews:
    """Cameras of all images."""

    world_R_camera: FloatArray
    """(images, 3, 3) orientation of each camera"""
    world_t_camera: FloatArray
    """(images, 3) centre of each camera in the world, metres"""
    calibration: FloatArray
    """(images, 3, 3) calibration matrix K, upper triangular"""
    lenses: LensTable | None = None
    """What their lenses do to rays before K; None: nothing, they are pinholes"""
    fields: Fields | None = None
    """What is added to pixels after K; None: nothing"""

    @cached_property
    def in_kernel(self) -> kernel.Cameras:
        """The cameras as the compiled loops read them."""
        n = len(self.world_t_camera)
        lenses = self.lenses or LensTable.without(n)
        calibration = as_floats(self.calibration, (n, 3, 3))
        world_R_camera = as_floats(self.world_R_camera, (n, 3, 3))
        return kernel.Cameras(
            to_pixel=np.ascontiguousarray(self.calibration @ self.world_R_camera.transpose(0, 2, 1)),
            centre_m=as_floats(self.world_t_camera, (n, 3)),
            calibration=calibration,
            world_R_camera=world_R_camera,
            lens=lenses.row,
            lens_kind=lenses.kind,
            lens_parameters=lenses.parameters,
        )

    @cached_property
    def typical_focal_px(self) -> float:
        """Median focal length."""
        return float(np.median(self.calibration[:, 0, 0]))

    def without_field(self, image: IntArray, uv_px: FloatArray) -> FloatArray:
        """Where pixels (n, 2), as measured in images (n,), would be if there were no fields."""
        return uv_px if self.fields is None else uv_px - self.fields.at(image, uv_px)

    def after(self, rotation: FloatArray, shift_m: FloatArray) -> "CameraViews":
        """The cameras after a rigid motion of the world: x becomes rotation (3, 3) x + shift (3,)."""
        return replace(
            self,
            world_R_camera=rotation @ self.world_R_camera,
            world_t_camera=self.world_t_camera @ rotation.T + shift_m,
        )

    @staticmethod
    def of(cameras: Sequence[Camera]) -> "CameraViews":
        """One image of each camera, in the camera's own frame as the world."""
        n = len(cameras)
        return CameraViews(
            world_R_camera=np.tile(np.eye(3), (n, 1, 1)),
            world_t_camera=np.zeros((n, 3)),
            calibration=np.array([c.pinhole.calibration_matrix for c in cameras]).reshape(n, 3, 3),
            lenses=LensTable.of(cameras, np.arange(n)),
            fields=fields_of(cameras, np.arange(n)),
        )

    @staticmethod
    def joined(parts: "Sequence[CameraViews]") -> "CameraViews":
        """The cameras of several sets of images, one after the other: all have fields, or none has."""
        lenses = [v.lenses or LensTable.without(len(v.world_t_camera)) for v in parts]
        fields = [v.fields for v in parts if v.fields is not None]
        assert len(fields) in {0, len(parts)}
        return CameraViews(
            world_R_camera=np.concatenate([v.world_R_camera for v in parts]),
            world_t_camera=np.concatenate([v.world_t_camera for v in parts]),
            calibration=np.concatenate([v.calibration for v in parts]),
            lenses=LensTable.joined(lenses),
            fields=Fields.joined(fields) if fields else None,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurements:
    """Observations sorted by landmark; n rows."""

    row: IntArray
    """(n,) row in the traverse's observations; -1: it is by a sensor, and no observation"""
    image: IntArray
    """(n,) row of the image of each observation"""
    landmark: IntArray
    """(n,) landmark row, ascending, without gaps"""
    uv_px: FloatArray
    """(n, 2) pixels as measured"""
    whitening: FloatArray
    """(n, 2, 2) takes a residual in pixels to unit covariance"""

    @property
    def n_landmarks(self) -> int:
        """Number of landmarks."""
        return int(self.landmark[-1]) + 1 if len(self.landmark) else 0

    @cached_property
    def begin(self) -> IntArray:
        """(landmarks + 1,) first row of each landmark, and n."""
        return _begin(self.landmark)

    @property
    def starts(self) -> IntArray:
        """(landmarks,) first row of each landmark."""
        return self.begin[:-1]

    @cached_property
    def typical_sigma_px(self) -> float:
        """Median standard deviation of a measurement's coordinate."""
        w = self.whitening
        return float(np.median(1 / np.sqrt(np.abs(w[:, 0, 0] * w[:, 1, 1] - w[:, 0, 1] * w[:, 1, 0]))))

    def part(self, rows: IntArray) -> "Measurements":
        """Rows of whole landmarks, ascending; landmarks numbered anew without gaps."""
        landmark = self.landmark[rows]
        return replace(
            self,
            row=self.row[rows],
            image=self.image[rows],
            landmark=np.cumsum(np.diff(landmark, prepend=landmark[:1]) > 0),
            uv_px=self.uv_px.take(rows, axis=0),
            whitening=self.whitening.take(rows, axis=0),
        )

    def scaled(self, factor: FloatArray | float) -> "Measurements":
        """The same with every sigma multiplied by a factor, one for all or (n,)."""
        return replace(self, whitening=self.whitening / np.reshape(factor, (-1, 1, 1)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Landmarks:
    """Unit 4-vectors with their origins."""

    vector: FloatArray
    """(landmarks, 4) (X, w) of unit length, its sign such that most cameras have it in front"""
    origin_m: FloatArray
    """(landmarks, 3) world point that X / w is relative to"""

    @cached_property
    def length(self) -> FloatArray:
        """(landmarks,) length of X; the distance from the origin is this divided by w."""
        x = self.vector[:, :3]
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", x, x)))

    def points_m(self, furthest_m: FloatArray) -> FloatArray:
        """World points (landmarks, 3), no further from their origins than `furthest_m` (landmarks,).

        A landmark at infinity or beyond is placed at that distance. One at its origin, which has no
        direction, stays there.
        """
        x, w = self.vector[:, :3], self.vector[:, 3]
        depth = np.maximum(w, self.length / furthest_m).clip(1e-300)
        return np.asarray(self.origin_m + x / depth[:, None])

    def of(self, rows: IntArray) -> "Landmarks":
        """Some of the landmarks."""
        return Landmarks(vector=self.vector[rows], origin_m=self.origin_m[rows])

    def about(self, origin_m: FloatArray) -> "Landmarks":
        """The same points relative to other origins (landmarks, 3)."""
        x = self.vector[:, :3] + self.vector[:, 3:] * (self.origin_m - origin_m)
        vector = np.column_stack([x, self.vector[:, 3]])
        return Landmarks(vector=vector / np.linalg.norm(vector, axis=1, keepdims=True), origin_m=origin_m)

    def moved_to(self, points_m: FloatArray) -> "Landmarks":
        """Landmarks of the same origins at world points (landmarks, 3)."""
        vector = np.column_stack([points_m - self.origin_m, np.ones(len(points_m))])
        return replace(self, vector=vector / np.linalg.norm(vector, axis=1, keepdims=True))


def triangulate(
    centre_m: FloatArray, direction: FloatArray, landmark: IntArray, weight: FloatArray
) -> Landmarks:
    """Linear triangulation in homogeneous coordinates from n rays sorted by landmark.

    Ray centres (n, 3), unit directions (n, 3), landmark rows (n,) ascending without gaps, weights (n,).
    Minimises the weighted squared distances |(I - d d')(X - w c)|^2 over unit (X, w), w in units of the
    baseline across the rays so that the answer is the same in any unit of length; then once more with
    weights divided by the squared ranges so that angles count, not metres. One ray alone, or rays along
    one line, show no parallax: the landmark then lies on them at infinity. Where all weights of a landmark
    are 0, all its rays count alike.
    """
    begin, n = _begin(landmark), len(landmark)
    centre_m, direction = as_floats(centre_m, (n, 3)), as_floats(direction, (n, 3))
    weight = as_floats(weight, (n,))
    vector, origin = np.empty((len(begin) - 1, 4)), np.empty((len(begin) - 1, 3))
    over_landmarks(
        kernel.triangulate, np.arange(len(vector)), begin, centre_m, direction, weight, vector, origin
    )
    return Landmarks(vector=vector, origin_m=origin)


def rays_of(measurements: Measurements, views: CameraViews) -> tuple[FloatArray, FloatArray]:
    """Centres (n, 3) and unit directions (n, 3) of the measurements' lines of sight, in the world."""
    centre_m, direction, _ = lines_of_sight(measurements.image, measurements.uv_px, views)
    return centre_m, direction


def lines_of_sight(
    image: IntArray, uv_px: FloatArray, views: CameraViews
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Points (n, 3), metres, and unit directions (n, 3) in the world of the lines of sight of pixels (n, 2).

    The point is the camera's centre, or one near it where the camera's pupil moves. Returns also whether each
    pixel has a line of sight (n,): a pixel outside the domain of its lens has none, and gets that of the
    pinhole instead. Raises IndexError for an image (n,) without a camera.
    """
    n = len(image)
    images, cameras = _images(image, views), views.in_kernel
    pixels = as_floats(views.without_field(images, as_floats(uv_px, (n, 2))), (n, 2))
    centre, direction, seen = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, dtype=bool)
    in_parallel(
        lambda first, last: kernel.lines_of_sight(
            images, pixels, cameras, first, last, centre, direction, seen
        ),
        n,
        grain=_RAY_GRAIN,
    )
    return centre, direction, seen


def evaluate(
    landmarks: Landmarks, measurements: Measurements, views: CameraViews
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Whitened residuals (n, 2), their derivatives (n, 2, 3) by the tangents of S^3, and what is in front.

    Residuals of landmarks behind a camera are those of the mirrored point and mean nothing.
    """
    seen, n = seen_by(measurements, views), len(measurements.image)
    vector, origin = _arrays(landmarks, measurements)
    residual, b, in_front = np.empty((n, 2)), np.empty((n, 2, 3)), np.empty(n, dtype=bool)
    which = np.arange(len(vector))
    over_landmarks(kernel.evaluate, which, seen, vector, origin, residual, b, in_front, grain=_LIGHT_GRAIN)
    return residual, b, in_front


def residuals(
    landmarks: Landmarks, measurements: Measurements, views: CameraViews
) -> tuple[FloatArray, BoolArray]:
    """`evaluate` without derivatives: whitened residuals (n, 2), and what is in front (n,)."""
    seen, n = seen_by(measurements, views), len(measurements.image)
    vector, origin = _arrays(landmarks, measurements)
    residual, in_front = np.empty((n, 2)), np.empty(n, dtype=bool)
    which = np.arange(len(vector))
    over_landmarks(kernel.residuals, which, seen, vector, origin, residual, in_front, grain=_LIGHT_GRAIN)
    return residual, in_front


def free_derivatives(b: FloatArray, landmarks: Landmarks, measurements: Measurements) -> FloatArray:
    """`evaluate`'s derivatives (n, 2, 3) along those directions that `refine` leaves free.

    A landmark that `refine` holds at infinity (w is 0) does not follow its observations beyond it: its
    derivatives lose their part along w.
    """
    vector, _ = _arrays(landmarks, measurements)
    free: FloatArray = as_floats(b, (len(measurements.image), 2, 3)).copy()
    over_landmarks(kernel.free_derivatives, np.arange(len(vector)), measurements.begin, vector, free)
    return free


def refine(
    landmarks: Landmarks,
    measurements: Measurements,
    views: CameraViews,
    weight: FloatArray,
    loss: Loss = SQUARED,
    *,
    beyond_infinity: bool = False,
    only: IntArray | None = None,
) -> Landmarks:
    """Landmarks of least cost with all cameras held, each by Levenberg-Marquardt.

    `only` are the rows of the landmarks to refine; default: all. `weight` (n,) multiplies each observation's
    cost; 0 leaves it out. A step that would raise a landmark's cost or move it behind a camera is not taken.
    A landmark does not move along directions that its rays leave free. Landmarks whose rays diverge end at
    infinity, or beyond it with `beyond_infinity`.
    """
    seen = seen_by(measurements, views)
    start, origin = _arrays(landmarks, measurements)
    weights, vector = as_floats(weight, (len(measurements.image),)), start.copy()
    which = np.arange(len(vector)) if only is None else only
    over_landmarks(
        kernel.refine, which, seen, origin, weights, loss.kind, loss.width, beyond_infinity, SETTLED, vector
    )
    return replace(landmarks, vector=vector)


def residual_cofactor(b: FloatArray, measurements: Measurements, weight: FloatArray) -> FloatArray:
    """Covariance (n, 2, 2) that noise alone gives to whitened residuals, cameras taken as known.

    For an observation that takes part (weight above 0) it is I - B V^-1 B', since the landmark follows it;
    for one that does not it is I + B V^-1 B'. `b` (n, 2, 3) are `evaluate`'s derivatives. Source: Baarda, A
    testing procedure for use in geodetic networks, 1968.
    """
    n = len(measurements.image)
    derivatives, weights, out = as_floats(b, (n, 2, 3)), as_floats(weight, (n,)), np.empty((n, 2, 2))
    which = np.arange(measurements.n_landmarks)
    over_landmarks(kernel.cofactors, which, measurements.begin, derivatives, weights, out)
    return out


def point_sigma_m(
    points_m: FloatArray, measurements: Measurements, views: CameraViews, accepted: BoolArray
) -> FloatArray:
    """Standard deviation (landmarks,) of world points (landmarks, 3) in their worst direction, cameras held.

    Except for points between their cameras, that direction is the line of sight. Infinite for landmarks with
    fewer than two accepted observations.
    """
    seen, n = seen_by(measurements, views), measurements.n_landmarks
    points, weight = as_floats(points_m, (n, 3)), as_floats(accepted, (len(measurements.image),))
    smallest = np.empty(n)
    over_landmarks(kernel.smallest_information, np.arange(n), seen, points, weight, smallest)
    few = np.bincount(measurements.landmark, weight, minlength=n) < 2
    return np.where(few | (smallest <= 0), np.inf, 1 / np.sqrt(smallest.clip(1e-300)))


def over_landmarks(
    loop: Callable[..., None], which: IntArray, *arguments: object, grain: int = _GRAIN
) -> None:
    """Call loop(part, *arguments) for parts of the landmarks `which`, over all threads."""
    in_parallel(lambda first, last: loop(which[first:last], *arguments), len(which), grain=grain)


# --- arrays as the compiled loops take them ---


def as_floats(array: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """The array as contiguous float64; raises ValueError where its shape is another.

    The array is writable, for Numba would compile a loop again for arrays that are not.
    """
    floats: FloatArray = np.require(array, np.float64, ["C", "W"])
    if floats.shape != shape:
        raise ValueError(f"expected an array of shape {shape}, found {floats.shape}")
    return floats


def seen_by(measurements: Measurements, views: CameraViews) -> kernel.Seen:
    """Measurements with the cameras that made them. Raises IndexError for an image without a camera."""
    n = len(measurements.image)
    image = _images(measurements.image, views)
    return kernel.Seen(
        begin=measurements.begin,
        image=image,
        uv_px=as_floats(views.without_field(image, measurements.uv_px), (n, 2)),
        whitening=as_floats(measurements.whitening, (n, 2, 2)),
        cameras=views.in_kernel,
    )


def _images(image: IntArray, views: CameraViews) -> IntArray:
    """Images (n,) as contiguous int64. Raises IndexError for one without a camera."""
    n_images = len(views.world_t_camera)
    images: IntArray = np.require(image, np.int64, ["C", "W"])
    if len(images) and not 0 <= images.min() <= images.max() < n_images:
        raise IndexError(f"image: expected 0 to {n_images - 1}, found {images.min()} to {images.max()}")
    return images


def _arrays(landmarks: Landmarks, measurements: Measurements) -> tuple[FloatArray, FloatArray]:
    """Vectors (landmarks, 4) and origins (landmarks, 3), one for each landmark of the measurements."""
    n = measurements.n_landmarks
    return as_floats(landmarks.vector, (n, 4)), as_floats(landmarks.origin_m, (n, 3))


def _begin(landmark: IntArray) -> IntArray:
    n_landmarks = int(landmark[-1]) + 1 if len(landmark) else 0
    return np.searchsorted(landmark, np.arange(n_landmarks + 1)).astype(np.int64, copy=False)
