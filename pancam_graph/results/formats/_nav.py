"""Pointing corrections of marsnav: `.nav` as XML and as text."""

from pathlib import Path

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.io.vicar import NavEntry, ReferenceFrame, nav_text, nav_xml
from pancam_graph.results.formats._source import Source
from pancam_graph.results.formats._vicar import site_frame, site_xyz, told_and_found

__all__ = ["write_nav", "write_nav_text"]

_SOLUTION = "pancam_graph"
_LEAST_POINTS = 3


def write_nav(source: Source, path: Path) -> None:
    """Write a `.nav`, XML: readings of the joints and cameras of each image before and after."""
    frame = site_frame(source)
    entries = _entries(source)
    without = sum(entry.models is None for entry in entries)
    if without:
        source.warnings.append(
            f"nav: {without} of {len(entries)} cameras have no equal in the CAHV family and are left out"
        )
    mission = source.identities[0].mission if source.identities else ""
    text = nav_xml(entries, mission=mission, solution_id=_SOLUTION, ground=_ground(source), ground_in=frame)
    path.write_text(text, encoding="utf-8", newline="\n")


def write_nav_text(source: Source, path: Path) -> None:
    """Write a `.nav`, text: readings of the joints before and after, a line an image, in their order."""
    path.write_text(nav_text(_entries(source)), encoding="utf-8", newline="\n")


def _entries(source: Source) -> list[NavEntry]:
    solution = source.solution
    traverse, rover = solution.traverse, solution.traverse.rig.rover_T_mast is not None
    entries = []
    for row, who in enumerate(source.identities):
        frame = int(traverse.image_frame[row])
        told, found = traverse.pan_tilt_rad[frame], solution.final.pan_tilt_rad[frame]
        if not np.isfinite(found).all():
            continue
        before, after = who.readings_deg(*told.tolist()), who.readings_deg(*found.tolist())
        # A whole turn between the two would be one that the mast did not make.
        before = (before[0] + 360.0 * round((after[0] - before[0]) / 360.0), before[1])
        entries.append(
            NavEntry(
                unique_id=who.unique_id,
                original_deg=before,
                pointing_deg=after,
                solution_id=_SOLUTION,
                identity=who,
                models=told_and_found(source, row),
                models_in=ReferenceFrame(name="ROVER_FRAME", index=who.place)
                if rover
                else site_frame(source),
            )
        )
    return entries


def _ground(source: Source) -> FloatArray | None:
    """A point of the plane through terrain points, and its normal, in the site frame; None without three."""
    points = source.solution.final.landmarks_m
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < _LEAST_POINTS:
        return None
    middle = np.median(points, axis=0)
    near = points[
        np.linalg.norm(points - middle, axis=1) <= np.median(np.linalg.norm(points - middle, axis=1))
    ]
    centre = near.mean(axis=0)
    slope, *_ = np.linalg.lstsq(near[:, :2] - centre[:2], near[:, 2] - centre[2], rcond=None)
    normal = np.array([-slope[0], -slope[1], 1.0])
    return site_xyz(np.stack([centre, normal / np.linalg.norm(normal)]))
