"""The graph of a traverse for callers who write GTSAM: its keys, and all of its factors and first values."""

from dataclasses import replace

import gtsam

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray
from pancam_graph.base.options import options_of
from pancam_graph.data import Traverse
from pancam_graph.graph import (
    ExplicitLandmarks,
    GraphKeys,
    RigVariables,
    SoftTemplate,
    stop_constraints,
    whole_graph,
)
from pancam_graph.initialise import Start
from pancam_graph.landmarks import SQUARED, loss_of
from pancam_graph.solve._options import SolveOptions
from pancam_graph.solve._prepare import free_numbers, prepare
from pancam_graph.solve._screen import screened_elsewhere

__all__ = ["build_graph", "graph_keys"]


def graph_keys(traverse: Traverse, options: SolveOptions | None = None) -> GraphKeys:
    """Keys of masts, angles, flexes and the free rig, for `build_graph` and factors that `solve` is given.

    The options determine the free entries of the rig, or else the traverse. Raises InputError as
    `solve` does for these.
    """
    options = options_of(SolveOptions, options, "graph_keys")
    return GraphKeys(traverse, RigVariables(traverse, free_numbers(traverse, options)))


def build_graph(
    traverse: Traverse,
    options: SolveOptions | None = None,
    *,
    start: Start | None = None,
    used: BoolArray | None = None,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """All factors of a traverse and values to start from, for GTSAM's own optimisers.

    Terrain points are variables `L` (Point3), numbered as the tracks in `Solution.landmark_track`. Where
    cameras are variables (`X`, Pose3, numbered as images), observations are GTSAM's projection factors, or
    `camera_projection_factor` for a camera that is no pinhole; on a rigid mast they are factors on mast,
    angles and point (`mast_projection_factor`). All other variables have the keys of `graph_keys`. A quantity
    that telemetry holds is a variable with a constraint. The cost of the graph is that of `solve`.

    `used` (observations,) is the mask of the observations to take, by least squares, as in `Solution.used`.
    Default: all observations of tracks with two or more, unscreened and therefore under the robust loss of
    the options; the loss "none" gives least squares. `start` has initial mast poses and angles; default:
    telemetry's.

    Raises InputError for the model `projective`, for which GTSAM has no projection factor, and as `solve`.
    """
    options = options_of(SolveOptions, options, "build_graph")
    if options.model == "projective":
        raise InputError(
            "build_graph: expected the model mast, circle or free, found projective: GTSAM has no projection "
            "factor for matrices"
        )
    prepared = prepare(traverse, replace(options, landmarks="explicit", method="joint"), start)
    problem, loss = prepared.problem, loss_of(options.loss)
    if used is not None:
        if len(used) != len(prepared.observations):
            raise InputError(
                f"used: expected one entry for each of {len(prepared.observations)} observations, "
                f"found {len(used)}"
            )
        problem, loss = screened_elsewhere(prepared, problem.values, used).problem, SQUARED
    assert isinstance(
        problem.template, SoftTemplate
    )  # the method with explicit landmarks has no other template
    graph, values = whole_graph(
        problem.values,
        ExplicitLandmarks(problem.template, problem.measurements),
        problem.points_m(),
        problem.kept,
        loss=loss,
        is_rigid=options.firm_tie == "hard",
    )
    for one in stop_constraints(traverse, problem.template):
        graph.push_back(one.factor)
    return graph, values
