"""Every kind of tie alone, exact and a little beside what pictures say: the solution has what was told.

What was told is compared by a formula of its own, on the solution's points and masts. Kinds are those of
marsnav (docs/ties.md has the names).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np
import pytest

from pancam_graph import Solution, solve
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
    StopDistance,
    StopHeading,
    StopPosition,
)
from support.small_drives import HARD, simulated
from support.tied_drives import ground_through, seen_often

SIMULATION = simulated(2, 3)
A, B = seen_often(SIMULATION, 2)
STOP = SIMULATION.traverse.stops[1].id
FIRST = SIMULATION.traverse.stops[0].id


@cache
def plain() -> Solution:
    """Without a tie."""
    return solve(SIMULATION.traverse, HARD)


def point(solution: Solution, track: int = A) -> FloatArray:
    return np.asarray(solution.final.landmarks_m[np.flatnonzero(solution.landmark_track == track)[0]])


def mast(solution: Solution, row: int = 1) -> gtsam.Pose3:
    return solution.final.world_T_mast[row]


def arm(solution: Solution) -> FloatArray:
    return np.asarray(point(solution) - mast(solution).translation())


def azimuth(solution: Solution) -> float:
    return float(np.arctan2(arm(solution)[1], arm(solution)[0]))


def elevation(solution: Solution) -> float:
    return float(np.arcsin(arm(solution)[2] / np.linalg.norm(arm(solution))))


NORMAL = np.array([2.0, -1.0, 2.0]) / 3.0
OFF = 1e-3
"""Metres, or tenths of radians, that the told value is beside the one without a tie."""


@dataclass(frozen=True)
class Case:
    told: Callable[[], Constraint]
    found: Callable[[Solution], FloatArray | float]
    """What the tie is about, of a solution; without the tie it is beside what was told by `moved`."""
    moved: float = OFF


def told_position() -> Constraint:
    return LandmarkPosition(landmark=A, position_m=tuple(point(plain()) + OFF), sigma_m=(0.0, 0.0, 0.0))


def told_map() -> Constraint:
    x, y = point(plain())[:2] + OFF
    return LandmarkPosition(landmark=A, position_m=(x, y, None), sigma_m=(0.0, 0.0, None))


def told_ground() -> Constraint:
    ground = ground_through(point(plain()) + np.array([0.0, 0.0, OFF]))
    return LandmarkSurface(landmark=A, surface=ground, sigma_m=0.0)


def above_ground(solution: Solution) -> float:
    """Height above the quadratic that `ground_through` samples, less that of the middle."""
    x, y, z = point(solution) - point(plain()) - [0.0, 0.0, OFF]
    return float(z - (0.2 * x - 0.1 * y + 0.02 * x * x - 0.03 * x * y + 0.01 * y * y)) + OFF


CASES: dict[str, Case] = {
    "fiducial, 1 and 9": Case(told_position, point),
    "orbital XYZ, 5": Case(told_position, point),
    "orbital XY, 4": Case(told_map, lambda s: point(s)[:2]),
    "azimuth, 6": Case(
        lambda: LandmarkAzimuth(
            landmark=A, stop=STOP, azimuth_rad=azimuth(plain()) + 0.1 * OFF, sigma_rad=0.0
        ),
        azimuth,
        0.1 * OFF,
    ),
    "elevation, 7": Case(
        lambda: LandmarkElevation(
            landmark=A, stop=STOP, elevation_rad=elevation(plain()) + 0.1 * OFF, sigma_rad=0.0
        ),
        elevation,
        0.1 * OFF,
    ),
    "height": Case(
        lambda: LandmarkHeight(landmark=A, height_m=float(point(plain())[2]) + OFF, sigma_m=0.0),
        lambda s: float(point(s)[2]),
    ),
    "Z surface, 8": Case(told_ground, above_ground),
    "plane": Case(
        lambda: LandmarkPlane(
            landmark=A, normal=tuple(NORMAL), offset_m=float(NORMAL @ point(plain())) + OFF, sigma_m=0.0
        ),
        lambda s: float(NORMAL @ point(s)),
    ),
    "distance of points": Case(
        lambda: LandmarkDistance(
            between=(A, B),
            distance_m=float(np.linalg.norm(point(plain()) - point(plain(), B))) + OFF,
            sigma_m=0.0,
        ),
        lambda s: float(np.linalg.norm(point(s) - point(s, B))),
    ),
    "position of a stop": Case(
        lambda: StopPosition(
            stop=STOP,
            position_m=(None, float(mast(plain()).translation()[1]) + OFF, None),
            sigma_m=(None, 0.0, None),
        ),
        lambda s: float(mast(s).translation()[1]),
    ),
    "heading": Case(
        lambda: StopHeading(
            stop=STOP, heading_rad=float(mast(plain()).rotation().yaw()) + 0.1 * OFF, sigma_rad=0.0
        ),
        lambda s: float(mast(s).rotation().yaw()),
        0.1 * OFF,
    ),
    "distance of stops": Case(
        lambda: StopDistance(
            between=(FIRST, STOP),
            distance_m=float(np.linalg.norm(mast(plain()).translation() - mast(plain(), 0).translation()))
            + OFF,
            sigma_m=0.0,
        ),
        lambda s: float(np.linalg.norm(mast(s).translation() - mast(s, 0).translation())),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_an_exact_tie_is_kept(name: str) -> None:
    case = CASES[name]
    solution = solve(replace(SIMULATION.traverse, constraints=(case.told(),)), HARD)
    assert solution.converged
    before = np.asarray(case.found(plain()), dtype=float)
    moved = np.asarray(case.found(solution), dtype=float) - before
    assert moved == pytest.approx(case.moved, abs=0.02 * case.moved)
