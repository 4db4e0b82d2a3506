"""Covariances of what stereo pairs see, at nodes of direction and depth: terrain's shared errors."""

from dataclasses import replace

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import StereoCovariance, stereo_order
from pancam_graph.elimination import Covariance, LandmarkSystem
from pancam_graph.graph import HardTemplate
from pancam_graph.landmarks import SQUARED, CameraViews, Landmarks, Measurements, lines_of_sight, residuals
from pancam_graph.solve._problem import Problem

__all__ = ["stereo_covariance"]

_SIDE = 7
"""Nodes along each side of a picture."""
_DEPTH_M: FloatArray = 0.8 * np.power(1.6, np.arange(12.0))
"""From 0.8 to 141 m: linear between them, a variance that grows with the square of depth is 5 % too large at
most."""
_BORDER = 9
"""Pixels along each side of a picture that tell how far it reaches."""
_SIGMA_PX = 1e-4
"""Of nodes' pixels: so little that they add nothing."""
_AT_ONCE = 200
"""Pairs whose nodes are in memory together."""
_ENTRIES = np.triu_indices(3)


def stereo_covariance(problem: Problem, covariance: Covariance) -> StereoCovariance | None:
    """Covariances of places that the stereo pairs of a problem see, due to its variables.

    `covariance` is that of the variables of its template. Each node is a landmark that the two images of a
    pair see without noise (V^-1 E' C E V^-1 of `LandmarkSystem.landmark_covariance_m2`). Of nodes that lie
    beyond a picture where its lens has no projection, the value is that of the nearest node that has one.
    None where cameras are variables themselves, and where no frame sees in stereo.
    """
    template, views = problem.template, problem.views
    if not isinstance(template, HardTemplate):
        return None
    left, right = _pairs(problem)
    if not len(left):
        return None
    sizes = [(eye.camera.width_px, eye.camera.height_px) for eye in template.traverse.rig.eyes]
    size_px = np.array(sizes)[template.traverse.image_eye]
    extent = np.array([_extent(views, row, size_px[row]) for row in left.tolist()])
    some = [slice(k, k + _AT_ONCE) for k in range(0, len(left), _AT_ONCE)]
    parts = [_of_some(problem, covariance, left[which], right[which], extent[which]) for which in some]
    return StereoCovariance(
        left=left, right=right, extent=extent, depth_m=_DEPTH_M, covariance=np.concatenate(parts)
    )


def _pairs(problem: Problem) -> tuple[IntArray, IntArray]:
    """Rows of the left and right images of all pairs of one frame that see in stereo."""
    traverse, views = problem.template.traverse, problem.views
    rows_of = [list[int]() for _ in traverse.frames]
    for row, frame in enumerate(traverse.image_frame.tolist()):
        rows_of[frame].append(row)
    found = list[tuple[int, int]]()
    for rows in rows_of:
        for i, a in enumerate(rows):
            for b in rows[i + 1 :]:
                both, focal = [a, b], views.calibration[[a, b], 0, 0].tolist()
                order = stereo_order(
                    (focal[0], focal[1]), views.world_R_camera[both], views.world_t_camera[both]
                )
                if order is not None:
                    found.append((both[order[0]], both[order[1]]))
    pairs = np.array(found, dtype=np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _extent(views: CameraViews, row: int, size_px: IntArray) -> FloatArray:
    """Least and largest x/z, then y/z (4,), of what an image sees."""
    u, v = (np.linspace(-0.5, n - 0.5, _BORDER) for n in size_px)
    corner_u, corner_v = (np.ravel(grid) for grid in np.meshgrid(u, v))
    border = np.isin(corner_u, u[[0, -1]]) | np.isin(corner_v, v[[0, -1]])
    uv = np.column_stack([corner_u, corner_v])[border]
    _, direction, _ = lines_of_sight(np.full(len(uv), row), uv, views)
    ray = direction @ views.world_R_camera[row]
    away = ray[:, :2] / np.maximum(ray[:, 2:], 1e-3)
    return np.column_stack([away.min(axis=0), away.max(axis=0)]).ravel()


def _of_some(
    problem: Problem, covariance: Covariance, left: IntArray, right: IntArray, extent: FloatArray
) -> FloatArray:
    """`StereoCovariance.covariance` of some pairs."""
    views, shape = problem.views, (len(left), len(_DEPTH_M), _SIDE, _SIDE)
    share = np.linspace(0, 1, _SIDE)
    x, y = (low[:, None] + share * (high - low)[:, None] for low, high in (extent[:, :2].T, extent[:, 2:].T))
    away = np.empty((*shape, 2))
    away[..., 0], away[..., 1] = x[:, None, None, :], y[:, None, :, None]
    depth = np.broadcast_to(_DEPTH_M[:, None, None], shape)
    ray = np.concatenate([away, np.ones((*shape, 1))], axis=-1)
    R, centre = views.world_R_camera[left], views.world_t_camera[left]
    world = centre[:, None, None, None] + np.einsum("pij,pklmj->pklmi", R, ray * depth[..., None])
    landmarks, seen, sees = _nodes(views, left, right, world.reshape(-1, 3))
    sees = sees.reshape(shape)
    found = np.full((*shape, 6), np.nan)
    if not sees.any():
        return _spread(found)
    rows = np.flatnonzero(sees)
    measurements, landmarks = seen.part(np.flatnonzero(np.repeat(sees.ravel(), 2))), landmarks.of(rows)
    n, pair = len(rows), np.nonzero(sees)[0]
    template = problem.template
    system = LandmarkSystem(template.linkage, measurements, landmarks, SQUARED, cliques=template.cliques)
    system.linearise(template.posture(problem.values))
    of_world = system.landmark_covariance_m2(covariance)
    # From metres in the world to x/z, y/z and the relative error of z.
    turn = np.zeros((n, 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = 1.0
    turn[:, :, 2] = -ray[sees]
    to_nodes = turn @ R[pair].transpose(0, 2, 1) / depth[sees][:, None, None]
    found[sees] = (to_nodes @ of_world @ to_nodes.transpose(0, 2, 1))[:, *_ENTRIES]
    return _spread(found)


def _nodes(
    views: CameraViews, left: IntArray, right: IntArray, world_m: FloatArray
) -> tuple[Landmarks, Measurements, BoolArray]:
    """World points (n, 3), as many of each pair in turn, where its images see them without noise.

    Also whether both images see each (n,).
    """
    n, each = len(world_m), len(world_m) // len(left)
    landmarks = Landmarks(
        vector=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
        origin_m=np.repeat(views.world_t_camera[left], each, axis=0),
    ).moved_to(world_m)
    nowhere = Measurements(
        row=np.zeros(2 * n, dtype=np.int64),
        image=np.repeat(np.column_stack([left, right]), each, axis=0).ravel(),
        landmark=np.repeat(np.arange(n), 2),
        uv_px=np.zeros((2 * n, 2)),
        whitening=np.tile(np.eye(2), (2 * n, 1, 1)),
    )
    uv, in_front = residuals(landmarks, nowhere, views)
    sees = (in_front & np.isfinite(uv).all(axis=1)).reshape(n, 2).all(axis=1)
    return landmarks, replace(nowhere, uv_px=uv).scaled(_SIGMA_PX), np.asarray(sees)


def _spread(found: FloatArray) -> FloatArray:
    """Nodes (pairs, depths, rows, columns, 6), those without a value with that of the nearest one of theirs.

    Along depth first, for what is near leaves the other eye's picture. A pair without any value has 0s.
    """
    for axis in (1, 3, 2):
        lanes = np.moveaxis(found, axis, 0)
        for order in (range(len(lanes) - 2, -1, -1), range(1, len(lanes))):
            step = 1 if order.step < 0 else -1
            for k in order:
                lanes[k] = np.where(np.isnan(lanes[k]), lanes[k + step], lanes[k])
    return np.nan_to_num(found)
