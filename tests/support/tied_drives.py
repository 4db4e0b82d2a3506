"""Constraints of each kind on terrain points of a small simulated drive, as the truth has them."""

from dataclasses import replace

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import (
    Constraint,
    LandmarkAzimuth,
    LandmarkDistance,
    LandmarkElevation,
    LandmarkHeight,
    LandmarkPlane,
    LandmarkPosition,
    LandmarkSurface,
    Surface,
    Traverse,
)
from pancam_graph.simulate import Simulation

__all__ = ["ground_through", "landmark_ties", "noise_free", "seen_often"]

_COVARIANCE_M2 = 1e-6 * np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 1.0], [0.0, 1.0, 2.0]])


def seen_often(simulation: Simulation, n: int, least: int = 4) -> list[int]:
    """The tracks nearest to the last stop that have so many observations at least."""
    observations = simulation.traverse.observations
    assert observations is not None
    points = simulation.truth.landmarks_m
    counts = np.bincount(observations.track, minlength=len(points))
    distance = np.linalg.norm(points - simulation.truth.world_T_mast[-1].translation(), axis=1)
    return [int(i) for i in np.argsort(distance) if counts[i] >= least][:n]


def ground_through(point_m: FloatArray, step_m: float = 0.25, nodes: int = 33) -> Surface:
    """Curved ground (a quadratic, which cubic convolution has exactly) through a point near its middle."""
    half = step_m * (nodes // 2)
    first = np.array([point_m[0] - half + 0.3 * step_m, point_m[1] + half - 0.4 * step_m])
    x = first[0] + step_m * np.arange(nodes) - point_m[0]
    y = first[1] - step_m * np.arange(nodes)[:, None] - point_m[1]
    height = point_m[2] + 0.2 * x - 0.1 * y + 0.02 * x * x - 0.03 * x * y + 0.01 * y * y
    return Surface(first_m=first, step_m=np.array([step_m, -step_m]), height_m=height)


def landmark_ties(simulation: Simulation, sigma: float = 1e-3) -> tuple[Constraint, ...]:
    """One of each kind that has a number, metres or radians of this sigma."""
    true, stops = simulation.truth, simulation.traverse.stops
    a, b, c, d, e, f, g, h, i, j = seen_often(simulation, 10)
    point = true.landmarks_m

    def arm(landmark: int, stop: int) -> FloatArray:
        return np.asarray(point[landmark] - true.world_T_mast[stop].translation())

    level, up = arm(f, 1), arm(g, len(stops) - 1)
    normal = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    return (
        LandmarkPosition(landmark=a, position_m=tuple(point[a]), sigma_m=(sigma,) * 3),
        LandmarkPosition(
            landmark=b, position_m=tuple(point[b]), covariance_m2=sigma**2 / 1e-6 * _COVARIANCE_M2
        ),
        LandmarkPosition(
            landmark=c, position_m=(point[c, 0], None, point[c, 2]), sigma_m=(sigma, None, 2 * sigma)
        ),
        LandmarkHeight(landmark=d, height_m=float(point[d, 2]), sigma_m=sigma),
        LandmarkPlane(
            landmark=e,
            normal=tuple(normal),
            offset_m=float(normal @ point[e]),
            sigma_m=sigma,
        ),
        LandmarkAzimuth(
            landmark=f,
            stop=stops[1].id,
            azimuth_rad=float(np.arctan2(level[1], level[0])),
            sigma_rad=0.1 * sigma,
        ),
        LandmarkElevation(
            landmark=g,
            stop=stops[-1].id,
            elevation_rad=float(np.arctan2(up[2], np.hypot(up[0], up[1]))),
            sigma_rad=0.1 * sigma,
        ),
        LandmarkSurface(landmark=h, surface=ground_through(point[h]), sigma_m=sigma),
        LandmarkDistance(
            between=(i, j), distance_m=float(np.linalg.norm(point[i] - point[j])), sigma_m=sigma
        ),
    )


def noise_free(simulation: Simulation) -> Traverse:
    """The traverse with its pixels as the truth has them; telemetry keeps its errors."""
    t = simulation.traverse
    assert t.observations is not None
    true = simulation.truth.uv_px
    return t.with_observations(replace(t.observations, uv_px=true))
