"""Terrain points that the images of single stops place, and how images of other stops should show them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
import scipy

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, compose, pose_arrays
from pancam_graph.cameras import Camera
from pancam_graph.data import DrivePart, Solution, Traverse
from pancam_graph.images._local_map import HALF_WIDTH_PX, local_map
from pancam_graph.images._usable import rows_by_image
from pancam_graph.rigs import Rig

__all__ = [
    "Sighting",
    "StopTerrain",
    "of_stops",
    "rig_arrays",
    "rig_from",
    "terrain_arrays",
    "terrain_from",
    "unplaced_arrays",
]

_NEAREST_INVERSE_M = 1e-7
_NEIGHBOURS = 12
_NEIGHBOUR_PX = 60.0
_FITS = 3
_CAUCHY_SIGMAS = 2.0
_GRAZING = 0.03
_SLOPE_SHARE = 0.5
_MOST_CHANGE = 0.5  # of the inverse depth within a patch
_COLUMNS = ("track", "image", "uv_px", "feature", "inverse_depth", "sigma_inverse_m", "slope")


@dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """How an image of another stop should see n points of a terrain."""

    uv_px: FloatArray
    """(n, 2) pixels."""
    d_pose: FloatArray
    """(n, 2, 6) derivatives of the pixels by the other mast's pose, in GTSAM's tangent."""
    d_inverse_depth: FloatArray
    """(n, 2) derivatives of the pixels by the points' inverse depths."""
    cosine: FloatArray
    """(n,) cosine of the angle between both lines of sight."""
    zoom: FloatArray
    """(n,) how much larger the other image shows what faces the camera, by lengths."""
    valid: BoolArray
    """(n,) False for points behind the camera; their rows mean nothing."""

    def select(self, rows: BoolArray | IntArray) -> "Sighting":
        """Some of the points."""
        return Sighting(**{name: column[rows] for name, column in vars(self).items()})

    def covariance_px2(self, pose_covariance: FloatArray, sigma_inverse_m: FloatArray) -> FloatArray:
        """(n, 2, 2) covariance of the pixels, from that of the pose (6, 6) and the depths' sigmas (n,)."""
        depth = self.d_inverse_depth * sigma_inverse_m[:, None]
        pose = self.d_pose @ pose_covariance @ np.swapaxes(self.d_pose, 1, 2)
        return np.asarray(pose + depth[:, :, None] * depth[:, None, :])


@dataclass(frozen=True, kw_only=True, eq=False)
class StopTerrain:
    """Points of some stops with the image that each was first seen in, sorted by track within a stop."""

    traverse: Traverse
    """These stops, their frames and images; poses and angles are from each stop's own images."""
    rigs: tuple[Rig, ...]
    """(stops,) the rig as the images of each stop have it."""
    drive_row: IntArray
    """(images,) row of each image in the drive that the stops are of."""
    track: IntArray
    """(n,) track of each point among those that the images of its stop were compared for."""
    image: IntArray
    """(n,) image in which each point was first seen, by its row here."""
    uv_px: FloatArray
    """(n, 2) pixel of each point in that image."""
    feature: IntArray
    """(n,) row of that sighting among the image's features."""
    inverse_depth: FloatArray
    """(n,) per metre along the axis of the camera that saw it first; 0 for infinity."""
    sigma_inverse_m: FloatArray
    """(n,) its standard deviation."""
    slope: FloatArray
    """(n, 2) how the inverse depth of the surface changes by pixel of that camera."""

    def select(self, rows: BoolArray | IntArray) -> "StopTerrain":
        """Some of the points."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _COLUMNS})

    def of_stop(self, stop: int) -> "StopTerrain":
        """One stop, with the points that its images saw first."""
        rows = np.flatnonzero(self.stop == stop)
        traverse, images = of_stops(self.traverse, np.array([stop]))
        return replace(
            self.select(rows),
            traverse=traverse,
            rigs=(self.rigs[stop],),
            drive_row=self.drive_row[images],
            image=np.searchsorted(images, self.image[rows]),
        )

    def beside(self, other: "StopTerrain") -> "StopTerrain":
        """These stops and their points, followed by those of other stops of the same drive."""
        a, b = self.traverse, other.traverse
        columns = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _COLUMNS}
        columns["image"][len(self.image) :] += len(a.images)
        return StopTerrain(
            traverse=replace(
                a, stops=a.stops + b.stops, frames=a.frames + b.frames, images=a.images + b.images
            ),
            rigs=self.rigs + other.rigs,
            drive_row=np.concatenate([self.drive_row, other.drive_row]),
            **columns,
        )

    @property
    def nbytes(self) -> int:
        """Bytes of the columns."""
        return sum(int(getattr(self, name).nbytes) for name in _COLUMNS)

    @cached_property
    def rows_of(self) -> dict[int, IntArray]:
        """Rows of the points that were first seen in an image, ascending, by the images that have some."""
        return rows_by_image(self.image)

    @cached_property
    def stop(self) -> IntArray:
        """(n,) stop of that image."""
        return self.traverse.image_stop[self.image]

    @cached_property
    def camera_poses(self) -> tuple[FloatArray, FloatArray]:
        """`world_R_camera` (images, 3, 3) and centres (images, 3), metres."""
        mast_R, mast_t = pose_arrays([stop.world_T_mast for stop in self.traverse.stops])
        stop = self.traverse.image_stop
        return compose(mast_R[stop], mast_t[stop], *self._mast_T_cameras)

    def camera(self, image: int) -> Camera:
        """Camera model of an image."""
        t = self.traverse
        return self.rigs[int(t.image_stop[image])].eyes[int(t.image_eye[image])].camera

    @cached_property
    def _camera_number(self) -> IntArray:
        """(images,) the same for images of one stop and eye."""
        return self.traverse.image_stop * len(self.traverse.rig.eyes) + self.traverse.image_eye

    def points_m(self, rows: IntArray, shift_px: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
        """World points (n, 3) of rows of one image; `shift_px` beside them, on the plane of the surface."""
        image = int(self.image[rows[0]])
        origin, ray = _sights(self.camera(image), self.uv_px[rows] + shift_px)
        inverse = self.inverse_depth[rows] + self.slope[rows] @ np.array(shift_px)
        R, centre = (p[image] for p in self.camera_poses)
        return np.asarray(centre + (origin + ray / np.maximum(inverse, _NEAREST_INVERSE_M)[:, None]) @ R.T)

    @cached_property
    def _world_m(self) -> FloatArray:
        """(n, 3) all points."""
        points = np.empty((len(self.image), 3))
        for rows in self.rows_of.values():
            points[rows] = self.points_m(rows)
        return points

    @cached_property
    def _along(self) -> FloatArray:
        """(n, 3) derivatives of the points, in the world, by their depths."""
        R, centre = (p[self.image] for p in self.camera_poses)
        axis = np.einsum("nij,nj->ni", R, self._forward[self._camera_number[self.image]])
        to_a = self._world_m - centre
        return np.asarray(to_a / np.maximum(np.einsum("ni,ni->n", to_a, axis), 1e-12)[:, None])

    @cached_property
    def _forward(self) -> FloatArray:
        """Axes (stops x eyes, 3) of their cameras, in their frames."""
        return np.array([_forward(eye.camera) for rig in self.rigs for eye in rig.eyes])

    def sighting(self, rows: IntArray, image: IntArray | int, world_T_mast: gtsam.Pose3) -> Sighting:
        """How `image`, of another stop, sees each of the rows, if its mast is at that pose.

        One image for all rows, or one for each.
        """
        points, first = self._world_m[rows], self.image[rows]
        image = np.broadcast_to(image, rows.shape)
        number = self._camera_number[image]
        mast_R, mast_t = (x[image] for x in self._mast_T_cameras)
        R_m, t_m = world_T_mast.rotation().matrix(), world_T_mast.translation()
        in_mast = (points - t_m) @ R_m
        in_camera = np.einsum("nji,nj->ni", mast_R, in_mast - mast_t)
        uv, d_point = np.empty((len(rows), 2)), np.empty((len(rows), 2, 3))
        valid = np.empty(len(rows), dtype=bool)
        for each in np.unique(number).tolist():
            k = np.flatnonzero(number == each)
            camera = self.camera(int(image[k[0]]))
            uv[k], d_point[k], valid[k] = camera.project_with_jacobian(in_camera[k])
        d_mast = d_point @ np.swapaxes(mast_R, 1, 2)
        # In the mast's frame a turn w of the mast moves a point p by -w x p, a shift v moves it by -v.
        d_pose = np.concatenate([np.cross(d_mast, in_mast[:, None]), -d_mast], axis=2)
        inverse = np.maximum(self.inverse_depth[rows], _NEAREST_INVERSE_M)
        d_inverse = np.einsum("nij,nj->ni", d_mast @ R_m.T, -self._along[rows] / inverse[:, None] ** 2)
        to_a = points - self.camera_poses[1][first]
        to_b = (in_mast - mast_t) @ R_m.T
        range_a = np.linalg.norm(to_a, axis=1)
        range_b = np.maximum(np.linalg.norm(to_b, axis=1), 1e-9)
        return Sighting(
            uv_px=uv,
            d_pose=d_pose,
            d_inverse_depth=d_inverse,
            cosine=np.einsum("ni,ni->n", to_a, to_b) / np.maximum(range_a * range_b, 1e-12),
            zoom=self._focal_px[number] / self._focal_px[self._camera_number[first]] * range_a / range_b,
            valid=valid,
        )

    def local_map(
        self, rows: IntArray, image: int, world_T_mast: gtsam.Pose3
    ) -> tuple[FloatArray, FloatArray]:
        """How the pixel in `image` moves with that of one other image, on the surface; see `local_map`.

        Second derivatives are 0 where the line of sight grazes the surface, so that its plane nearly reaches
        the horizon within a patch.
        """
        camera = self.camera(image)
        mast_R, mast_t = (x[image] for x in self._mast_T_cameras)
        R_m, t_m = world_T_mast.rotation().matrix(), world_T_mast.translation()

        def moved(du: float, dv: float) -> FloatArray:
            in_mast = (self.points_m(rows, (du, dv)) - t_m) @ R_m
            return camera.project((in_mast - mast_t) @ mast_R)[0]

        affine, bend = local_map(moved)
        change = HALF_WIDTH_PX * np.abs(self.slope[rows]).sum(axis=1)
        flat = change < _MOST_CHANGE * np.maximum(self.inverse_depth[rows], _NEAREST_INVERSE_M)
        return affine, np.where(flat[:, None, None], bend, 0.0)

    @cached_property
    def _mast_T_cameras(self) -> tuple[FloatArray, FloatArray]:
        t = self.traverse
        R, centre = np.empty((len(t.images), 3, 3)), np.empty((len(t.images), 3))
        for stop, rig in enumerate(self.rigs):
            k = np.flatnonzero(t.image_stop == stop)
            R[k], centre[k] = rig.mast_T_camera(t.pan_tilt_rad[t.image_frame[k]], t.image_eye[k])
        return R, centre

    @cached_property
    def _focal_px(self) -> FloatArray:
        """Focal lengths (stops x eyes,)."""
        return np.array(
            [eye.camera.pinhole.calibration_matrix[0, 0] for rig in self.rigs for eye in rig.eyes]
        )


def of_stops(
    traverse: Traverse, stops: IntArray, of_images: BoolArray | None = None
) -> tuple[Traverse, IntArray]:
    """Some stops of a traverse by themselves, rows ascending, and the rows of their images.

    Without observations, constraints, named points and warnings. `of_images` (images,) leaves images out.
    """
    frames = np.flatnonzero(np.isin(traverse.frame_stop, stops)).tolist()
    here = np.isin(traverse.image_stop, stops)
    images = np.flatnonzero(here if of_images is None else here & of_images)
    part = DrivePart(
        name=traverse.name,
        rig=traverse.rig,
        stops=tuple(traverse.stops[k] for k in stops.tolist()),
        frames=tuple(traverse.frames[k] for k in frames),
        images=tuple(traverse.images[k] for k in images.tolist()),
        sharing=traverse.sharing,
    )
    return part, images


def terrain_arrays(solution: Solution, feature: IntArray) -> dict[str, FloatArray | IntArray]:
    """What `terrain_from` needs to build the terrain that a solution places.

    `feature` (observations,) is the row of each of its observations among the features of its image.
    """
    t, final = solution.traverse, solution.final
    obs = t.observations
    assert obs is not None
    # Observations are sorted by track, then image.
    tracks, first = np.unique(obs.track, return_index=True)
    landmark = np.searchsorted(solution.landmark_track, tracks).clip(max=len(solution.landmark_track) - 1)
    known = (solution.landmark_track[landmark] == tracks) & solution.used[first]
    known &= np.isfinite(final.landmarks_m[landmark]).all(axis=1)
    tracks, first, points = tracks[known], first[known], final.landmarks_m[landmark[known]]

    image = obs.image[first]
    to_point = points - final.world_t_camera[image]
    ahead = np.array([_forward(eye.camera) for eye in solution.rig.eyes])[t.image_eye[image]]
    axis = np.einsum("nij,nj->ni", final.world_R_camera[image], ahead)
    depth = np.einsum("ni,ni->n", axis, to_point)
    sigma = _sigma_inverse_m(solution, tracks, to_point, image)
    good = (depth > 1e-3) & np.isfinite(sigma)
    return {
        **_geometry(solution.rig, final.pan_tilt_rad, final.world_T_mast),
        "track": tracks[good],
        "image": image[good],
        "uv_px": obs.uv_px[first[good]],
        "feature": feature[first[good]],
        "inverse_depth": 1 / depth[good],
        "sigma_inverse_m": sigma[good],
    }


def unplaced_arrays(traverse: Traverse) -> dict[str, FloatArray | IntArray]:
    """As `terrain_arrays`, of stops none of whose points can be placed: they stand where telemetry says."""
    none, no_number = np.empty(0), np.empty(0, dtype=np.int64)
    masts = [stop.world_T_mast for stop in traverse.stops]
    return {
        **_geometry(traverse.rig, traverse.pan_tilt_rad, masts),
        "track": no_number,
        "image": no_number,
        "uv_px": np.empty((0, 2)),
        "feature": no_number,
        "inverse_depth": none,
        "sigma_inverse_m": none,
    }


def rig_arrays(rig: Rig) -> dict[str, FloatArray]:
    """What a solve estimates of a rig, fields aside; see `rig_from`."""
    return {
        "calibration": np.array([eye.camera.pinhole.calibration_matrix for eye in rig.eyes]),
        "head_T_camera": np.array([eye.head_T_camera.matrix() for eye in rig.eyes]),
        "pan_T_tilt": rig.pan_T_tilt.matrix(),
    }


def rig_from(rig: Rig, calibration: FloatArray, head_T_camera: FloatArray, pan_T_tilt: FloatArray) -> Rig:
    """A rig with what was estimated of it in place of what it claims."""
    eyes = tuple(
        replace(eye, camera=eye.camera.with_calibration(K), head_T_camera=gtsam.Pose3(mount))
        for eye, K, mount in zip(rig.eyes, calibration, head_T_camera, strict=True)
    )
    return replace(rig, eyes=eyes, pan_T_tilt=gtsam.Pose3(pan_T_tilt))


def _geometry(
    rig: Rig, pan_tilt_rad: FloatArray, world_T_mast: Sequence[gtsam.Pose3]
) -> dict[str, FloatArray]:
    world_R_mast, world_t_mast = pose_arrays(world_T_mast)
    return {
        **rig_arrays(rig),
        "pan_tilt_rad": pan_tilt_rad,
        "world_R_mast": world_R_mast,
        "world_t_mast": world_t_mast,
    }


def terrain_from(
    traverse: Traverse,
    *,
    calibration: FloatArray,
    head_T_camera: FloatArray,
    pan_T_tilt: FloatArray,
    pan_tilt_rad: FloatArray,
    world_R_mast: FloatArray,
    world_t_mast: FloatArray,
    drive_row: IntArray,
    slope: FloatArray | None = None,
    **columns: Any,
) -> StopTerrain:
    """The points that one solution of some stops places, each with its surface; see `terrain_arrays`.

    Its traverse is at the solution, the rig too. `slope` is that of the surface, where it is known already.
    """
    frames = tuple(
        replace(f, pan_rad=float(pan), tilt_rad=float(tilt))
        for f, (pan, tilt) in zip(traverse.frames, pan_tilt_rad, strict=True)
    )
    stops = tuple(
        replace(s, world_T_mast=gtsam.Pose3(gtsam.Rot3(R), t))
        for s, R, t in zip(traverse.stops, world_R_mast, world_t_mast, strict=True)
    )
    rig = rig_from(traverse.rig, calibration, head_T_camera, pan_T_tilt)
    terrain = StopTerrain(
        traverse=replace(traverse, frames=frames, stops=stops, observations=None),
        rigs=(rig,) * len(stops),
        drive_row=drive_row,
        **columns,
        slope=np.zeros((len(columns["track"]), 2)) if slope is None else slope,
    )
    if slope is not None:
        return terrain
    slopes = terrain.slope.copy()
    world_R_camera, _ = terrain.camera_poses
    for i, rows in terrain.rows_of.items():
        slopes[rows] = _slopes(terrain, rows, world_R_camera[i])
    return replace(terrain, slope=slopes)


def _sigma_inverse_m(
    solution: Solution, tracks: IntArray, to_point: FloatArray, image: IntArray
) -> FloatArray:
    """Standard deviations (n,) of inverse depths, by the observation whose baseline says most of them.

    Infinite without a baseline.
    """
    t, obs = solution.traverse, solution.traverse.observations
    assert obs is not None
    rows = np.flatnonzero(solution.used & np.isin(obs.track, tracks))
    k = np.searchsorted(tracks, obs.track[rows])
    direction = to_point / np.linalg.norm(to_point, axis=1, keepdims=True)
    centre = solution.final.world_t_camera
    across = np.cross(centre[obs.image[rows]] - centre[image[k]], direction[k])
    # Across its epipolar line an observation says nothing of the depth, and along it is the less sure one.
    noise = np.sqrt(2) * solution.sigma_px[rows] / t.calibration[image[k], 0, 0]
    best = np.zeros(len(tracks))
    np.maximum.at(best, k, np.linalg.norm(across, axis=1) / noise)
    with np.errstate(divide="ignore"):
        return np.asarray(1 / best)


def _forward(camera: Camera) -> FloatArray:
    """The axis that depths are measured along: the line of sight of the image's middle."""
    middle = np.array([[(camera.width_px - 1) / 2, (camera.height_px - 1) / 2]])
    return np.asarray(camera.unproject(middle).direction[0])


def _sights(camera: Camera, uv_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Origins and rays (n, 3) of pixels, the rays of unit length along the camera's axis."""
    rays = camera.unproject(uv_px)
    return rays.origin_m, rays.direction / (rays.direction @ _forward(camera))[:, None]


def _slopes(terrain: StopTerrain, rows: IntArray, world_R_camera: FloatArray) -> FloatArray:
    """Slopes (n, 2) of the inverse depth around points of one image.

    The inverse depth of a plane is linear in the pixel of a pinhole. Each plane is fitted to the nearest
    points, robustly, and held to level ground, or to facing the camera near the horizon.
    """
    camera = terrain.camera(int(terrain.image[rows[0]]))
    uv, w, sigma = terrain.uv_px[rows], terrain.inverse_depth[rows], terrain.sigma_inverse_m[rows]
    up = world_R_camera.T @ np.array([0.0, 0.0, 1.0])
    _, ray = _sights(camera, uv)
    d_ray = [_sights(camera, uv + s)[1] - _sights(camera, uv - s)[1] for s in ((0.5, 0.0), (0.0, 0.5))]
    down = -(ray @ up)
    steep = down > _GRAZING
    level = (
        np.stack([d @ up for d in d_ray], 1) * np.where(steep, -w / np.maximum(down, _GRAZING), 0)[:, None]
    )
    focal = float(camera.pinhole.calibration_matrix[0, 0])
    prior = (_SLOPE_SHARE * np.linalg.norm(level, axis=1) + w / focal) ** -2.0

    count = min(_NEIGHBOURS + 1, len(rows))
    distance, near = (np.reshape(x, (len(rows), -1)) for x in scipy.spatial.cKDTree(uv).query(uv, k=count))
    delta = uv[near] - uv[:, None]
    design = np.concatenate([np.ones((*near.shape, 1)), delta], axis=2)
    base = np.where(distance < _NEIGHBOUR_PX, 1 / np.hypot(sigma[near], sigma[:, None]) ** 2, 0.0)
    target = w[near] - w[:, None]
    slope, offset = level.copy(), np.zeros(len(rows))
    for _ in range(_FITS):
        error = target - offset[:, None] - np.einsum("nki,ni->nk", delta, slope)
        weight = base / (1 + error**2 * base / _CAUCHY_SIGMAS**2)
        normal = np.einsum("nk,nki,nkj->nij", weight, design, design)
        right = np.einsum("nk,nki,nk->ni", weight, design, target)
        normal[:, 0, 0] += 1e-6 * base.max(axis=1)
        for i in (0, 1):
            normal[:, 1 + i, 1 + i] += prior
            right[:, 1 + i] += prior * level[:, i]
        solved = np.linalg.solve(normal, right[..., None])[..., 0]
        offset, slope = solved[:, 0], solved[:, 1:]
    return np.asarray(slope)
