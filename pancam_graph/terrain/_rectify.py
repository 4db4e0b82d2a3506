"""Pictures of two eyes turned so that a point lies in the same row of both."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import Camera, Pinhole, straightening_map
from pancam_graph.terrain._drive import Drive, Pair

__all__ = ["Rectified", "rectify"]

_RANGE_M = 6.0
"""Distance at which an entrance pupil that moves is taken to be where it is."""
_WIDEST = 2.0
"""Tangent of the angle off the axis up to which a rectified picture reaches."""
_EDGE_PX = 32


@dataclass(frozen=True, kw_only=True, eq=False)
class Rectified:
    """A pair of pinholes whose rows are epipolar lines."""

    left: Pinhole
    right: Pinhole
    """Of the same size and focal length, and the same row of the principal point."""
    world_R_pair: FloatArray
    """(3, 3) orientation of both: x along the baseline, y down, z forward."""
    world_t_left: FloatArray
    """(3,) centre of the left one, metres."""
    baseline_m: float
    maps: tuple[FloatArray, FloatArray]
    """(height, width, 2) pixels of each picture at those of the rectified one; NaN where it has none."""

    @property
    def shift_px(self) -> float:
        """Disparity of a point at infinity."""
        return self.left.cx_px - self.right.cx_px

    def depth_m(self, disparity_px: FloatArray) -> FloatArray:
        """Depth of points by their disparities; NaN at infinity and beyond."""
        parallax = disparity_px - self.shift_px
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(parallax > 0, self.left.fx_px * self.baseline_m / parallax, np.nan)

    def rays(self) -> FloatArray:
        """Directions (height, width, 3) of the left one's pixels in the world, of depth 1."""
        v, u = np.mgrid[: self.left.height_px, : self.left.width_px].astype(float)
        x, y = (u - self.left.cx_px) / self.left.fx_px, (v - self.left.cy_px) / self.left.fy_px
        return np.asarray(np.stack([x, y, np.ones_like(x)], axis=-1) @ self.world_R_pair.T)


def rectify(drive: Drive, pair: Pair) -> Rectified:
    """Rectify a pair through its adjusted cameras, lenses and smooth fields included.

    Rows are those that both eyes see; columns those that either sees of its own picture.
    """
    R, t = drive.world_R_camera, drive.world_t_camera
    rows = pair.left, pair.right
    x = (t[pair.right] - t[pair.left]) / pair.baseline_m
    ahead = R[pair.left][:, 2] + R[pair.right][:, 2]
    z = ahead - (ahead @ x) * x
    z /= np.linalg.norm(z)
    world_R_pair = np.column_stack([x, np.cross(z, x), z])
    cameras = [drive.cameras[row] for row in rows]
    focal = float(np.sqrt(np.prod([c.pinhole.fx_px for c in cameras])))
    turns = [R[row].T @ world_R_pair for row in rows]
    low, high = zip(*(_field(c, turn) for c, turn in zip(cameras, turns, strict=True)), strict=True)
    top, bottom = max(low[0][1], low[1][1]), min(high[0][1], high[1][1])
    width = max(high[k][0] - low[k][0] for k in range(2))
    width_px, height_px = int(np.ceil(focal * width)) + 1, max(int(np.ceil(focal * (bottom - top))) + 1, 1)
    holes = [
        Pinhole(
            width_px=width_px,
            height_px=height_px,
            fx_px=focal,
            fy_px=focal,
            cx_px=float(np.rint(-focal * low[k][0])),
            cy_px=float(np.rint(-focal * top)),
        )
        for k in range(2)
    ]
    return Rectified(
        left=holes[0],
        right=holes[1],
        world_R_pair=world_R_pair,
        world_t_left=t[pair.left],
        baseline_m=pair.baseline_m,
        maps=(_map(cameras[0], holes[0], turns[0]), _map(cameras[1], holes[1], turns[1])),
    )


def _field(camera: Camera, camera_R_pair: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least and greatest x and y, at depth 1, of what a camera sees in the rectified frame."""
    u, v = np.arange(0, camera.width_px, _EDGE_PX), np.arange(0, camera.height_px, _EDGE_PX)
    grid = np.meshgrid(np.append(u, camera.width_px - 1.0), np.append(v, camera.height_px - 1.0))
    rays = camera.unproject(np.stack(grid, axis=-1).reshape(-1, 2).astype(float))
    seen = rays.direction[rays.valid] @ camera_R_pair
    seen = seen[seen[:, 2] > 1e-3]
    xy = np.clip(seen[:, :2] / seen[:, 2:], -_WIDEST, _WIDEST)
    return xy.min(axis=0), xy.max(axis=0)


def _map(camera: Camera, hole: Pinhole, camera_R_pair: FloatArray) -> FloatArray:
    found = straightening_map(camera, hole, _RANGE_M, camera_R_pair)
    if found is None:
        v, u = np.mgrid[: hole.height_px, : hole.width_px].astype(float)
        found = np.stack([u, v], axis=-1)
    outside = ~camera.contains(found.reshape(-1, 2)).reshape(found.shape[:2])
    return np.where(outside[..., None], np.nan, found)
