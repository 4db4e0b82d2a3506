"""What the pointing says about two images: whether they overlap, and where to look for a feature."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from pancam_graph.cameras import Camera
from pancam_graph.geometry import BoolArray, FloatArray, IntArray, compose, pose_arrays
from pancam_graph.images._options import FrontEndOptions
from pancam_graph.traverse import Traverse

__all__ = ["PairGeometry", "Segments", "overlapping_pairs"]

FAR_M = 1e7
"""Stands for infinity: a baseline of 100 m is 1e-5 rad there."""

_GRID = 9
_DEPTHS = 16
_COARSE_FARTHEST_M = 200.0


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

    def b_T_a(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and translation (3,) from camera a to camera b at the corrections p."""
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
        return b_R @ R[0], b_R @ (t[0] - t[1])

    def transfer(self, points_m: FloatArray, p: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels in b (n, 2) of points (n, 3) in the frame of camera a, and their validity (n,)."""
        R, t = self.b_T_a(p)
        return self.camera_b.project(points_m @ R.T + t)

    def segments(
        self, uv_px: FloatArray, p: FloatArray, root: FloatArray, slack_px: float, options: FrontEndOptions
    ) -> Segments:
        """Where in b the pixels (n, 2) of a can lie, for p with the covariance `root @ root.T`.

        Depths from `options.min_depth_m` to infinity; the half widths are `options.search_sigmas` standard
        deviations and `slack_px` pixels of the coarser image.
        """
        rays = self.camera_a.unproject(uv_px)
        n = len(uv_px)
        magnification = self.magnification(uv_px)
        slack = slack_px * np.maximum(magnification, 1.0)
        far_radius = slack + options.search_sigmas * self._spread_px(
            rays.origin_m + FAR_M * rays.direction, p, root
        )

        # The depths whose pixels fall on b, or near it, form one run; its ends make the segment.
        depths = np.append(np.geomspace(options.min_depth_m, _COARSE_FARTHEST_M, _DEPTHS), FAR_M)[::-1]
        pixels, inside = np.empty((len(depths), n, 2)), np.empty((len(depths), n), dtype=bool)
        size = np.array([self.camera_b.width_px, self.camera_b.height_px])
        margin = far_radius[:, None]
        for k, depth in enumerate(depths):
            pixels[k], seen = self.transfer(rays.origin_m + depth * rays.direction, p)
            inside[k] = seen & np.all((pixels[k] > -margin) & (pixels[k] < size - 1 + margin), axis=1)
        first, last = inside.argmax(axis=0), len(depths) - 1 - inside[::-1].argmax(axis=0)
        row = np.arange(n)
        far_px, near_px = pixels[first, row], pixels[last, row]

        # Distortion bends the line of sight's image: the half width covers what a straight piece misses.
        along = near_px - far_px
        across = (
            np.stack([-along[:, 1], along[:, 0]], 1)
            / np.maximum(np.linalg.norm(along, axis=1), 1e-6)[:, None]
        )
        number = np.arange(len(depths))[:, None]
        between = inside & (number >= first) & (number <= last)
        bow = np.max(np.abs(np.einsum("kni,ni->kn", pixels - far_px, across)) * between, axis=0)
        near_spread = self._spread_px(rays.origin_m + depths[last][:, None] * rays.direction, p, root)
        return Segments(
            far_px=far_px,
            near_px=near_px,
            far_radius_px=far_radius + bow,
            near_radius_px=slack + options.search_sigmas * near_spread + bow,
            magnification=magnification,
            valid=rays.valid & inside.any(axis=0),
        )

    def _spread_px(self, points_m: FloatArray, p: FloatArray, root: FloatArray) -> FloatArray:
        """Standard deviation (n,) of the pixels in b of points (n, 3) in the frame of camera a."""
        pixels, _ = self.transfer(points_m, p)
        variance = np.zeros(len(points_m))
        for column in root.T:
            if np.any(column):
                variance += np.sum((self.transfer(points_m, p + column)[0] - pixels) ** 2, axis=1)
        return np.sqrt(variance)

    def magnification(self, uv_px: FloatArray) -> FloatArray:
        """How much larger b shows distant terrain than a, by lengths, at pixels (n, 2) of a."""
        shifts = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        rays = self.camera_a.unproject((uv_px + shifts[:, None]).reshape(-1, 2))
        pixels, _ = self.transfer(rays.origin_m + FAR_M * rays.direction, np.zeros(len(self.sigma)))
        centre, right, down = pixels.reshape(3, -1, 2)
        area = np.abs(np.linalg.det(np.stack([right - centre, down - centre], -1)))
        return np.asarray(np.sqrt(np.where(np.isfinite(area), area, 1.0)))

    def elevation_rad(self, uv_px: FloatArray) -> FloatArray:
        """Elevation (n,) above the world's horizontal of what a sees at pixels (n, 2)."""
        frame, stop = self.traverse.image_frame[self.a], self.traverse.image_stop[self.a]
        angles = self.traverse.pan_tilt_rad[[frame]]
        mast_R, _ = self.traverse.rig.mast_T_camera(angles, self.traverse.image_eye[[self.a]])
        up = self.traverse.stops[stop].world_T_mast.rotation().matrix()[2] @ mast_R[0]
        return np.asarray(np.arcsin(np.clip(self.camera_a.unproject(uv_px).direction @ up, -1.0, 1.0)))

    def overlap(self, options: FrontEndOptions, *, widened: bool) -> float:
        """Share of a grid over a that can lie on b: within the search window, or as telemetry has it."""
        u, v = np.meshgrid(
            np.linspace(0, self.camera_a.width_px - 1, _GRID),
            np.linspace(0, self.camera_a.height_px - 1, _GRID),
        )
        grid = np.column_stack([u.ravel(), v.ravel()])
        root = np.diag(self.sigma) if widened else np.zeros((len(self.sigma), 0))
        slack_px = options.search_slack_px if widened else 0.0
        found = self.segments(grid, np.zeros(len(self.sigma)), root, slack_px, options)
        return float(np.mean(found.valid))


def overlapping_pairs(
    traverse: Traverse, options: FrontEndOptions, progress: Callable[[int, int], None] | None = None
) -> list[PairGeometry]:
    """Pairs of images (a before b) that can see the same terrain by all that telemetry knows."""
    pairs = []
    n = len(traverse.images)
    for a in range(n):
        for b in range(a + 1, n):
            pair = PairGeometry(traverse, a, b, options.mount_sigma_rad)
            if pair.overlap(options, widened=True) > 0:
                pairs.append(pair)
        if progress is not None:
            progress(a + 1, n)
    return pairs
