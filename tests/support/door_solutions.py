"""Solutions with points on which something is known, and their files in formats of other programs."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from pancam_graph import Solution, Traverse
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import (
    Constraint,
    LandmarkAzimuth,
    LandmarkElevation,
    LandmarkHeight,
    LandmarkInfinity,
    LandmarkPosition,
    Observations,
)
from pancam_graph.results import DOORS
from pancam_graph.results.formats import source_of
from pancam_graph.rigs import rig_template
from support.made_solutions import fabricate

ROVER_T_MAST = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.01, -0.02, 0.4), np.array([0.46, 0.03, 1.1]))
SAID = {"landmark-position", "landmark-height", "landmark-azimuth", "landmark-elevation"}
NAMES = ("position", "map", "height", "far", "azimuth", "elevation")


@cache
def solved(template: str = "msl-navcam", *, rover: bool = False) -> Solution:
    """A solution with points on which something is known, each kind on a point of its own."""
    rig = rig_template(template)
    made = fabricate(
        rig=replace(rig, rover_T_mast=ROVER_T_MAST if rover else None), stops=2, pans=3, points=240
    )
    observations = made.traverse.observations
    assert observations is not None
    use = made.used & (np.bincount(observations.track[made.used])[observations.track] > 1)
    made = replace(made, used=use, reason=tuple("" if u else "outlier" for u in use))
    # Points that both eyes at the first stop see.
    at_first = use & (made.traverse.image_stop[observations.image] == 0)
    count = np.bincount(observations.track[at_first])
    tracks = np.flatnonzero(count >= 2)[: len(NAMES)].tolist()
    point = {t: made.final.landmarks_m[made.landmark_track.tolist().index(t)] for t in tracks}
    mast = made.final.world_T_mast[0].translation()
    said = dict(zip(NAMES, tracks, strict=True))

    def arm(name: str) -> FloatArray:
        return np.asarray(point[said[name]] - mast)

    x, y, _ = point[said["map"]].tolist()
    constraints: tuple[Constraint, ...] = (
        LandmarkPosition(
            landmark=said["position"], position_m=tuple(point[said["position"]].tolist()), sigma_m=(0.01,) * 3
        ),
        LandmarkPosition(landmark=said["map"], position_m=(x, y, None), sigma_m=(0.5, 0.5, None)),
        LandmarkHeight(landmark=said["height"], height_m=float(point[said["height"]][2]), sigma_m=0.05),
        LandmarkInfinity(landmark=said["far"]),
        LandmarkAzimuth(
            landmark=said["azimuth"],
            stop=made.traverse.stops[0].id,
            azimuth_rad=float(np.arctan2(arm("azimuth")[1], arm("azimuth")[0])),
            sigma_rad=2e-3,
        ),
        LandmarkElevation(
            landmark=said["elevation"],
            stop=made.traverse.stops[0].id,
            elevation_rad=float(np.arcsin(arm("elevation")[2] / np.linalg.norm(arm("elevation")))),
            sigma_rad=2e-3,
        ),
    )
    return replace(made, traverse=replace(made.traverse, constraints=constraints))


def written(solution: Solution, path: Path, to: str) -> list[str]:
    source = source_of(solution)
    if DOORS[to].is_folder:
        path.mkdir()
    DOORS[to].writer()(source, path)
    return source.warnings


def marks(observations: Observations, rows: Any = slice(None)) -> set[tuple[int, float, float]]:
    return {
        (int(i), float(u), float(v))
        for i, (u, v) in zip(observations.image[rows], observations.uv_px[rows], strict=True)
    }


def bare(solution: Solution) -> Traverse:
    return replace(solution.traverse, observations=None, constraints=())


# --- ties ---
