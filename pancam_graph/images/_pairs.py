"""The geometry of two images by their pointing: whether they overlap, and where to look for a feature."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, compose, pose_arrays
from pancam_graph.cameras import Camera
from pancam_graph.data import Traverse
from pancam_graph.images._front_end_options import FrontEndOptions

__all__ = [
    "FAR_M",
    "MAX_TURN_RAD",
    "MAX_ZOOM",
    "PairGeometry",
    "Relative",
    "Segments",
    "inspected_depths_m",
    "move_pixels",
]

FAR_M = 1e7
"""Depth that stands for infinity: a baseline of 100 m is seen there under 1e-5 rad."""

_DEPTHS = 16
_AT_ONCE = 16_384  # points at once: few calls for few features, and little enough for the caches of a core
_COARSE_FARTHEST_M = 200.0
_LEAST_CELLS, _MOST_CELLS = 16, 48
_DIFFERENCE = 1e-2
MAX_TURN_RAD = float(np.deg2rad(30.0))
"""Between lines of sight with a larger angle, descriptors of the same terrain do not agree."""
MAX_ZOOM = 2.5
"""Nor do they at distances whose ratio is larger."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Segments:
    """Where in image b the features of image a can lie: straight from far to near, with half widths."""

    far_px: FloatArray
    """(n, 2) pixel of the farthest depth that falls on b or near it."""
    near_px: FloatArray
    """(n, 2) pixel of the nearest such depth."""
    far_radius_px: FloatArray
    """(n,) half width of the search at the far end."""
    near_radius_px: FloatArray
    """(n,) half width at the near end; linear in between."""
    magnification: FloatArray
    """(n,) how much larger b shows distant terrain than a, by lengths."""
    valid: BoolArray
    """(n,) False where no depth falls on b; the rest of the row then means nothing."""

    def select(self, rows: IntArray) -> "Segments":
        """The segments of some features."""
        return Segments(
            far_px=self.far_px[rows],
            near_px=self.near_px[rows],
            far_radius_px=self.far_radius_px[rows],
            near_radius_px=self.near_radius_px[rows],
            magnification=self.magnification[rows],
            valid=self.valid[rows],
        )

    def among(self, rows: BoolArray) -> "Segments":
        """The segments as those of some `rows` (m,) of more pixels; all others are not valid."""
        out = {}
        for name, column in vars(self).items():
            out[name] = np.zeros((len(rows), *column.shape[1:]), dtype=column.dtype)
            out[name][rows] = column
        return Segments(**out)

    def bounds_px(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest pixel (2,) that the valid segments reach; at least one must be valid."""
        ends = np.stack([self.far_px, self.near_px])[:, self.valid]
        radii = np.stack([self.far_radius_px, self.near_radius_px])[:, self.valid, None]
        return (ends - radii).min(axis=(0, 1)), (ends + radii).max(axis=(0, 1))

    def reach(self, uv_px: FloatArray) -> BoolArray:
        """Which of the pixels (m, 2) lie within each segment's window, (n, m)."""
        along = self.near_px - self.far_px
        length2 = np.maximum(np.einsum("ni,ni->n", along, along), 1e-12)
        du = uv_px[:, 0] - self.far_px[:, :1]
        dv = uv_px[:, 1] - self.far_px[:, 1:]
        t = np.clip((du * along[:, :1] + dv * along[:, 1:]) / length2[:, None], 0.0, 1.0)
        distance2 = (du - t * along[:, :1]) ** 2 + (dv - t * along[:, 1:]) ** 2
        radius = self.far_radius_px[:, None] + t * (self.near_radius_px - self.far_radius_px)[:, None]
        return np.asarray((distance2 <= radius**2) & self.valid[:, None])

    def holds(self, uv_px: FloatArray) -> BoolArray:
        """Whether each segment's window holds the pixel (n, 2) of its own row, (n,)."""
        rows = np.arange(len(uv_px))
        each = [self.select(rows[i : i + 1]).reach(uv_px[i : i + 1])[0, 0] for i in rows]
        return np.array(each, dtype=bool)


class Relative(NamedTuple):
    """Pose of camera a in the frame of camera b."""

    R: FloatArray
    """(3, 3) b_R_a"""
    t: FloatArray
    """(3,) metres."""

    def of(self, points_m: FloatArray) -> FloatArray:
        """Points (n, 3) in the frame of camera b, from those in the frame of camera a."""
        return np.asarray(points_m @ self.R.T + self.t)


@dataclass(frozen=True, eq=False)
class PairGeometry:
    """Relative geometry of images a and b, and the small corrections p that telemetry leaves open.

    p has numbers in radians or metres: the orientation of b's eye (3: mount, twist, flex), pan and tilt
    of a's and of b's frame (4, if the frames differ), the pose of b's stop relative to a's (6, if the
    stops differ).
    """

    traverse: Traverse
    a: int
    """Row of image a."""
    b: int
    """Row of image b."""
    mount_sigma_rad: float
    """Standard deviation of each of the first three corrections."""
    rover_fixed: bool = False
    """Go from a to b through the mast frame instead of the world, as if the rover had not moved between
    the stops: that is how it sees its own deck."""

    @property
    def camera_a(self) -> Camera:
        """Camera model of image a."""
        return self._camera(self.a)

    @property
    def camera_b(self) -> Camera:
        """Camera model of image b."""
        return self._camera(self.b)

    def _camera(self, row: int) -> Camera:
        return self.traverse.rig.eyes[int(self.traverse.image_eye[row])].camera

    @cached_property
    def same_frame(self) -> bool:
        """Whether both are eyes of one pointing."""
        return bool(self.traverse.image_frame[self.a] == self.traverse.image_frame[self.b])

    @cached_property
    def same_stop(self) -> bool:
        """Whether the mast stood in one place for both."""
        return bool(self.traverse.image_stop[self.a] == self.traverse.image_stop[self.b])

    @property
    def _through_world(self) -> bool:
        return not (self.same_stop or self.rover_fixed)

    @cached_property
    def sigma(self) -> FloatArray:
        """(len(p),) standard deviations of p by telemetry, 0 for what is held."""
        rows = [self.a, self.b]
        parts = [np.full(3, self.mount_sigma_rad)]
        if not self.same_frame:
            frames = [self.traverse.frames[self.traverse.image_frame[i]] for i in rows]
            parts += [np.array([f.sigma_pan_rad, f.sigma_tilt_rad]) for f in frames]
        if self._through_world:
            stops = [self.traverse.stops[self.traverse.image_stop[i]] for i in rows]
            rotation = np.hypot(stops[0].sigma_rotation_rad, stops[1].sigma_rotation_rad)
            translation = np.hypot(stops[0].sigma_translation_m, stops[1].sigma_translation_m)
            parts.append(np.repeat([rotation, translation], 3))
        return np.concatenate(parts)

    @property
    def no_correction(self) -> FloatArray:
        """The corrections p = 0."""
        return np.zeros(len(self.sigma))

    def b_T_a(self, p: FloatArray) -> Relative:
        """Pose of camera a in the frame of camera b at the corrections p."""
        rows = np.array([self.a, self.b])
        angles = self.traverse.pan_tilt_rad[self.traverse.image_frame[rows]]
        if not self.same_frame:
            angles = angles + p[3:7].reshape(2, 2)
        R, t = self.traverse.rig.mast_T_camera(angles, self.traverse.image_eye[rows])
        if self._through_world:
            stops = [self.traverse.stops[self.traverse.image_stop[i]].world_T_mast for i in rows]
            stops[1] = stops[1].retract(p[7:13])
            R, t = compose(*pose_arrays(stops), R, t)
        b_R = (R[1] @ gtsam.Rot3.Expmap(p[:3]).matrix()).T
        return Relative(b_R @ R[0], b_R @ (t[0] - t[1]))

    def d_b_T_a(self, p: FloatArray, root: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives of `b_T_a` along root's k columns: rotation (k, 3, 3) and translation (k, 3)."""
        base = self.b_T_a(p)
        moved = [self.b_T_a(p + _DIFFERENCE * column) for column in root.T if np.any(column)]
        d_R = np.array([m.R - base.R for m in moved]).reshape(-1, 3, 3)
        return d_R / _DIFFERENCE, np.array([m.t - base.t for m in moved]).reshape(-1, 3) / _DIFFERENCE

    def transfer(self, points_m: FloatArray, b_T_a: Relative) -> tuple[FloatArray, BoolArray]:
        """Pixels in b (n, 2) of points (n, 3) in the frame of camera a, and their validity (n,)."""
        return self.camera_b.project(b_T_a.of(points_m))

    def segments(
        self, uv_px: FloatArray, p: FloatArray, root: FloatArray, slack_px: float, options: FrontEndOptions
    ) -> Segments:
        """Where in b the pixels (n, 2) of a can lie, for p with the covariance `root @ root.T`.

        Depths from `options.min_depth_m` to infinity; the half widths are `options.search_sigmas` standard
        deviations and `slack_px` pixels of the coarser image.
        """
        near = self._near(uv_px, p, root, slack_px, options)
        part = self._segments(uv_px[near], p, root, slack_px, options)
        return part if near.all() else part.among(near)

    def _near(
        self, uv_px: FloatArray, p: FloatArray, root: FloatArray, slack_px: float, options: FrontEndOptions
    ) -> BoolArray:
        """Which pixels (n, 2) of a lie in or next to a cell of it of which a corner can lie on b; quick.

        All, where the corners are as many as the pixels.
        """
        size_a = np.array([self.camera_a.width_px, self.camera_a.height_px])
        size_b = min(self.camera_b.width_px, self.camera_b.height_px)
        # Three corners and more fall into the field of b, however narrow that is.
        zoom = float(self.magnification((size_a[None] - 1) / 2)[0])
        cells = int(np.clip(np.ceil(3 * size_a.max() * zoom / size_b), _LEAST_CELLS, _MOST_CELLS))
        if (cells + 1) ** 2 >= len(uv_px):
            return np.ones(len(uv_px), dtype=bool)
        on_b = np.pad(self._cells_on_b(cells, p, root, slack_px, options), 1)
        near = np.any([on_b[i : i + cells, j : j + cells] for i in range(3) for j in range(3)], axis=0)
        column, row = np.clip(uv_px / (size_a - 1) * cells, 0, cells - 1).astype(np.int64).T
        return np.asarray(near[row, column])

    def _cells_on_b(
        self, cells: int, p: FloatArray, root: FloatArray, slack_px: float, options: FrontEndOptions
    ) -> BoolArray:
        """Which of cells x cells pieces of image a, by row and column, have a corner that can lie on b."""
        u, v = np.meshgrid(
            *np.linspace(0, [self.camera_a.width_px - 1, self.camera_a.height_px - 1], cells + 1).T
        )
        valid = self._segments(np.column_stack([u.ravel(), v.ravel()]), p, root, slack_px, options).valid
        corner = valid.reshape(u.shape)
        return np.asarray(corner[:-1, :-1] | corner[1:, :-1] | corner[:-1, 1:] | corner[1:, 1:])

    def _segments(
        self, uv_px: FloatArray, p: FloatArray, root: FloatArray, slack_px: float, options: FrontEndOptions
    ) -> Segments:
        """As `segments`, of all pixels."""
        rays = self.camera_a.unproject(uv_px)
        n, b_T_a = len(uv_px), self.b_T_a(p)
        d_b_T_a = self.d_b_T_a(p, root)
        magnification = self.magnification(uv_px)
        slack = slack_px * np.maximum(magnification, 1.0)
        far_radius = slack + options.search_sigmas * self._spread_px(
            rays.origin_m + FAR_M * rays.direction, b_T_a, d_b_T_a
        )

        # The depths at which both see the point from similar sides, on b or near it, are consecutive: the
        # first and the last of them are the ends of the segment.
        depths = inspected_depths_m(options.min_depth_m)
        pixels, inside = np.empty((len(depths), n, 2)), np.empty((len(depths), n), dtype=bool)
        size = np.array([self.camera_b.width_px, self.camera_b.height_px])
        margin = far_radius[:, None]
        for k in np.array_split(np.arange(len(depths)), max(1, len(depths) * n // _AT_ONCE)):
            points = (rays.origin_m + depths[k, None, None] * rays.direction).reshape(-1, 3)
            uv, seen = self.transfer(points, b_T_a)
            pixels[k] = uv.reshape(len(k), n, 2)
            on = np.all((pixels[k] > -margin) & (pixels[k] < size - 1 + margin), axis=2)
            inside[k] = on & (seen & _alike(points, b_T_a)).reshape(len(k), n)
        first, last = inside.argmax(axis=0), len(depths) - 1 - inside[::-1].argmax(axis=0)
        row = np.arange(n)
        far_px, near_px = pixels[first, row], pixels[last, row]

        # Distortion bends the image of a line of sight: the half width covers its distance from the straight.
        along = near_px - far_px
        across = (
            np.stack([-along[:, 1], along[:, 0]], 1)
            / np.maximum(np.linalg.norm(along, axis=1), 1e-6)[:, None]
        )
        number = np.arange(len(depths))[:, None]
        between = inside & (number >= first) & (number <= last)
        bow = np.max(np.abs(np.einsum("kni,ni->kn", pixels - far_px, across)) * between, axis=0)
        near_spread = self._spread_px(rays.origin_m + depths[last][:, None] * rays.direction, b_T_a, d_b_T_a)
        return Segments(
            far_px=far_px,
            near_px=near_px,
            far_radius_px=far_radius + bow,
            near_radius_px=slack + options.search_sigmas * near_spread + bow,
            magnification=magnification,
            valid=rays.valid & inside.any(axis=0),
        )

    def _spread_px(
        self, points_m: FloatArray, b_T_a: Relative, d_b_T_a: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        """Standard deviation (n,) of the pixels in b of points (n, 3) in the frame of camera a."""
        _, d_uv, _ = self.camera_b.project_with_jacobian(b_T_a.of(points_m))
        return np.asarray(np.sqrt(np.sum(move_pixels(points_m, d_uv, d_b_T_a) ** 2, axis=(1, 2))))

    def magnification(self, uv_px: FloatArray) -> FloatArray:
        """How much larger b shows distant terrain than a, by lengths, at pixels (n, 2) of a."""
        shifts = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        rays = self.camera_a.unproject((uv_px + shifts[:, None]).reshape(-1, 2))
        pixels, _ = self.transfer(rays.origin_m + FAR_M * rays.direction, self.b_T_a(self.no_correction))
        centre, right, down = pixels.reshape(3, -1, 2)
        (right_u, right_v), (down_u, down_v) = (right - centre).T, (down - centre).T
        area = np.abs(right_u * down_v - right_v * down_u)
        return np.asarray(np.sqrt(np.where(np.isfinite(area), area, 1.0)))

    def elevation_rad(self, uv_px: FloatArray) -> FloatArray:
        """Elevation (n,) above the world's horizontal of what a sees at pixels (n, 2)."""
        frame, stop = self.traverse.image_frame[self.a], self.traverse.image_stop[self.a]
        angles = self.traverse.pan_tilt_rad[[frame]]
        mast_R, _ = self.traverse.rig.mast_T_camera(angles, self.traverse.image_eye[[self.a]])
        up = self.traverse.stops[stop].world_T_mast.rotation().matrix()[2] @ mast_R[0]
        return np.asarray(np.arcsin(np.clip(self.camera_a.unproject(uv_px).direction @ up, -1.0, 1.0)))

    def overlap(self, options: FrontEndOptions, *, widened: bool, cells: int = 8) -> BoolArray:
        """Which of cells x cells pieces of image a, by row and column, can lie on b.

        Within the search window, if `widened`, else exactly as telemetry has it.
        """
        root = np.diag(self.sigma) if widened else np.zeros((len(self.sigma), 0))
        slack_px = options.search_slack_px if widened else 0.0
        return self._cells_on_b(cells, self.no_correction, root, slack_px, options)


def move_pixels(points_m: FloatArray, d_uv: FloatArray, d_b_T_a: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Derivatives (n, 2, k) of pixels in b by k changes of the pose, see `PairGeometry.d_b_T_a`.

    `d_uv` (n, 2, 3) are the derivatives of the pixels by the points in the frame of b. The points (n, 3) are
    in that of a.
    """
    d_R, d_t = d_b_T_a
    moved = points_m @ np.swapaxes(d_R, 1, 2) + d_t[:, None]
    return np.asarray(d_uv @ np.moveaxis(moved, 0, 2))


def _alike(points_m: FloatArray, b_T_a: Relative) -> BoolArray:
    """Whether points (n, 3) in the frame of camera a are seen from similar sides and distances, (n,)."""
    from_b = b_T_a.of(points_m)
    from_a = from_b - b_T_a.t
    a2, b2, ab = (np.einsum("ni,ni->n", *p) for p in ((from_a, from_a), (from_b, from_b), (from_a, from_b)))
    near = (a2 < MAX_ZOOM**2 * b2) & (b2 < MAX_ZOOM**2 * a2)
    return np.asarray(near & (ab > np.cos(MAX_TURN_RAD) * np.sqrt(np.maximum(a2 * b2, 1e-24))))


def inspected_depths_m(min_depth_m: float) -> FloatArray:
    """Depths, farthest first, that stand for all those from `min_depth_m` to infinity."""
    return np.append(np.geomspace(min_depth_m, _COARSE_FARTHEST_M, _DEPTHS), FAR_M)[::-1]
