"""What GIS programs show of a solution: stops, the drive, ellipses, views and terrain points, as layers."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pancam_graph.base.ellipses import RADIUS_95, ellipse_outlines, translation_covariance_in_world
from pancam_graph.base.geometry import FloatArray, pose_arrays
from pancam_graph.data import Site, Solution

__all__ = ["Feature", "Layer", "Shape", "gis_layers"]

Shape = Literal["Point", "LineString", "Polygon"]
Property = str | int | float | None

_VIEW_M = 10.0
"""Length of a view's sides."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Feature:
    """A thing on the map."""

    at: FloatArray
    """(n, 3) x, y, z of its places: longitude and latitude in degrees and height, or world metres without a
    site; of a polygon the first again at the end, anticlockwise seen from above"""
    properties: dict[str, Property]
    """Numbers and text by name, the same names in all features of a layer."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """Features of one kind."""

    name: str
    shape: Shape
    features: tuple[Feature, ...]


def gis_layers(solution: Solution) -> tuple[Layer, ...]:
    """The layers of a solution; what is not finite is left out.

    `stops`, `drive` (the way from stop to stop), `ellipses` (95 % of where each stop may be, from above),
    `views` (triangles of 10 m from each camera through the sides of its image, along the ground plan) and
    `landmarks`.
    """
    site = solution.traverse.site
    stops, ellipses = tuple(_stops(solution)), tuple(_ellipses(solution))
    way = np.array([stop.at[0] for stop in stops])
    drive = (Feature(at=way, properties={"name": solution.traverse.name}),) if len(way) > 1 else ()
    return (
        Layer(name="stops", shape="Point", features=stops),
        Layer(name="drive", shape="LineString", features=drive),
        Layer(name="ellipses", shape="Polygon", features=ellipses),
        Layer(name="views", shape="Polygon", features=tuple(_views(solution))),
        Layer(name="landmarks", shape="Point", features=tuple(_landmarks(solution, site))),
    )


def _placed(points_m: FloatArray, site: Site | None) -> FloatArray:
    """World points (n, 3) as coordinates of the map."""
    return points_m if site is None else site.geographic(points_m)[:, [1, 0, 2]]


def _stops(solution: Solution) -> Iterator[Feature]:
    t, site = solution.traverse, solution.traverse.site
    rotations, places = pose_arrays(solution.final.world_T_mast)
    covariance = translation_covariance_in_world(rotations, solution.stop_covariance)
    if site is not None:
        covariance = site.level_R_world @ covariance @ site.level_R_world.T
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).clip(0))
    axes = ("x", "y", "z") if site is None else ("east", "north", "up")
    for i in np.flatnonzero(np.isfinite(places).all(axis=1)).tolist():
        forward = float(np.arctan2(rotations[i, 1, 0], rotations[i, 0, 0]))
        known: dict[str, Property] = {"stop": t.stops[i].id}
        known |= {f"{name}_m": float(v) for name, v in zip("xyz", places[i], strict=True)}
        known |= {f"sigma_{name}_m": _number(v) for name, v in zip(axes, sigma[i], strict=True)}
        known["azimuth_deg" if site is not None else "heading_deg"] = (
            float(np.degrees(forward)) if site is None else site.azimuth_deg(forward)
        )
        yield Feature(at=_placed(places[i : i + 1], site), properties=known)


def _ellipses(solution: Solution) -> Iterator[Feature]:
    rotations, places = pose_arrays(solution.final.world_T_mast)
    covariance = translation_covariance_in_world(rotations, solution.stop_covariance)[:, :2, :2]
    told = np.isfinite(covariance).all(axis=(1, 2)) & (np.trace(covariance, axis1=1, axis2=2) > 0)
    told &= np.isfinite(places).all(axis=1)
    rows = np.flatnonzero(told)
    for i, outline in zip(rows.tolist(), ellipse_outlines(covariance[rows], RADIUS_95), strict=True):
        level = np.column_stack([places[i, :2] + outline, np.full(len(outline), places[i, 2])])
        level[-1] = level[0]
        if np.sum(outline[:-1, 0] * outline[1:, 1] - outline[1:, 0] * outline[:-1, 1]) < 0:
            level = level[::-1]
        half = np.linalg.norm(outline, axis=1)
        yield Feature(
            at=_placed(level, solution.traverse.site),
            properties={
                "stop": solution.traverse.stops[i].id,
                "share": 0.95,
                "longest_m": float(half.max()),
                "shortest_m": float(half.min()),
            },
        )


def _views(solution: Solution) -> Iterator[Feature]:
    t, final = solution.traverse, solution.final
    eyes = [eye.camera for eye in solution.rig.eyes]
    sides = []
    for camera in eyes:
        middle = (camera.height_px - 1) / 2
        ends = np.array([[-0.5, middle], [camera.width_px - 0.5, middle]])
        sides.append(camera.unproject(ends).direction)
    for i, image in enumerate(t.images):
        centre, ray = final.world_t_camera[i], sides[int(t.image_eye[i])] @ final.world_R_camera[i].T
        level = np.linalg.norm(ray[:, :2], axis=1)
        if not np.isfinite(np.append(centre, ray)).all() or level.min() < 0.1:  # it looks up or down
            continue
        left, right = (np.append(r[:2] / n * _VIEW_M, 0.0) for r, n in zip(ray, level, strict=True))
        yield Feature(
            at=_placed(np.array([centre, centre + right, centre + left, centre]), t.site),
            properties={
                "image": image.id,
                "stop": t.stops[int(t.image_stop[i])].id,
                "camera": image.camera,
                "file": image.file,
            },
        )


def _landmarks(solution: Solution, site: Site | None) -> Iterator[Feature]:
    points = solution.final.landmarks_m
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    covariance = solution.landmark_covariance_m2
    sigma = np.full(len(points), np.nan)
    if covariance is not None:
        known = np.isfinite(covariance).all(axis=(1, 2))
        sigma[known] = np.sqrt(np.linalg.eigvalsh(covariance[known])[:, -1].clip(0))
    for i, at in zip(rows.tolist(), _placed(points[rows], site), strict=True):
        track = int(solution.landmark_track[i])
        yield Feature(at=at[None], properties={"track": track, "sigma_m": _number(sigma[i])})


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
