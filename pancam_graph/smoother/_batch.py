"""The whole drive as one batch problem of `solve`: the fallback where iSAM2's steps fail, and for results."""

from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.data import DrivePart, Traverse
from pancam_graph.graph import Factors, HardTemplate
from pancam_graph.landmarks import Landmarks
from pancam_graph.smoother._map import DriveMap
from pancam_graph.solve import EliminatedSolver, Problem, StopRule

__all__ = ["solved_anew", "whole_problem", "whole_template", "whole_traverse"]


def whole_traverse(drive: DriveMap) -> Traverse:
    """All stops with all observations, in the order in which they were added."""
    parts = [s.traverse for s in drive.stations]
    return DrivePart(
        name="",
        rig=drive.rig,
        stops=tuple(stop for t in parts for stop in t.stops),
        frames=tuple(frame for t in parts for frame in t.frames),
        images=tuple(image for t in parts for image in t.images),
        observations=drive.ledger.observations if len(drive.ledger) else None,
    )


def whole_template(drive: DriveMap) -> HardTemplate:
    """The rig of the whole drive as a template; its variables have the drive's keys."""
    return HardTemplate(whole_traverse(drive), drive.sharing)


def whole_problem(drive: DriveMap, values: gtsam.Values) -> Problem:
    """All observations in use as a batch problem; landmarks start where they were linearised last."""
    placed = drive.whole()
    template = whole_template(drive)
    return Problem(
        template=template,
        factors=Factors(
            telemetry=tuple(drive.factors(firm=True)), given=tuple(drive.given), seated=tuple(drive.seated)
        ),
        measurements=placed.measurements,
        accepted=np.ones(len(placed.measurements.row), dtype=bool),
        values=values,
        landmarks=placed.landmarks,
    )


def solved_anew(drive: DriveMap, values: gtsam.Values) -> gtsam.Values:
    """The optimum near `values`, by Levenberg-Marquardt; the landmarks of all blocks are moved to it."""
    problem = whole_problem(drive, values).placed()
    optimum, _ = EliminatedSolver(None, is_near=True).adjust(problem, StopRule())
    track = drive.whole().track
    for block in drive.blocks.values():
        at = np.searchsorted(track, block.placed.track)
        landmarks = Landmarks(vector=optimum.landmarks.vector[at], origin_m=optimum.landmarks.origin_m[at])
        block.replace(replace(block.placed, landmarks=landmarks))
    return optimum.values
