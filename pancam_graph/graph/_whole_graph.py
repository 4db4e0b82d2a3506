"""The whole graph of a traverse for GTSAM's own optimisers, with terrain points and held variables."""

import gtsam
import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras import without_field
from pancam_graph.factors import Fixed, Key, Slot, mast_projection_factor
from pancam_graph.graph._factors import graph_of
from pancam_graph.graph._keys import Kind, key_of
from pancam_graph.graph._landmarks import ExplicitLandmarks
from pancam_graph.graph._soft import SoftTemplate
from pancam_graph.graph._template import diagonal_noise
from pancam_graph.landmarks import Loss, Measurements

__all__ = ["whole_graph"]


def whole_graph(
    problem_values: gtsam.Values,
    explicit: ExplicitLandmarks,
    points_m: FloatArray,
    kept: BoolArray,
    *,
    loss: Loss,
    is_rigid: bool,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Factors and values: landmarks (landmarks, 3) at `points_m`, all else at the template's values.

    `kept` (n,) are the measurements that take part. `is_rigid`: cameras are not variables, and observations
    are factors on masts and angles. A quantity that telemetry holds is a variable with a constraint. Where a
    tie is not rigid, a free calibration has two linked variables: `K` as callers know it, and `C` for GTSAM's
    projection factors.
    """
    template, values = explicit.template, gtsam.Values(problem_values)
    if is_rigid:
        graph = _rigid_graph(template, explicit.measurements, kept, loss)
        for image in range(len(template.traverse.images)):
            values.erase(template.camera_key(image))
    else:
        graph = template.factors(apart=True).graph
        explicit.calibrations.join(graph, values)
        graph.push_back(explicit.factors(kept, loss))
    keys, t = template.keys, template.traverse
    for stop in t.stops:
        if not values.exists(key := keys.mast(stop.id)):
            values.insert(key, stop.world_T_mast)
            graph.push_back(gtsam.PriorFactorPose3(key, stop.world_T_mast, diagonal_noise(np.zeros(6))))
    for frame, angles in zip(t.frames, t.pan_tilt_rad, strict=True):
        if not values.exists(key := keys.angles(frame.id)):
            values.insert(key, angles)
            graph.push_back(gtsam.PriorFactorVector(key, angles, diagonal_noise(np.zeros(2))))
        if template.head_flex and not values.exists(key := keys.flex(frame.id)):
            none = np.zeros(len(template.head_flex))
            values.insert(key, none)
            graph.push_back(gtsam.PriorFactorVector(key, none, diagonal_noise(none)))
    seen = np.zeros(len(points_m), dtype=bool)
    seen[explicit.measurements.landmark[kept]] = True
    explicit.insert_points(values, points_m, seen)
    return graph, values


def _rigid_graph(
    template: SoftTemplate, measurements: Measurements, accepted: BoolArray, loss: Loss
) -> gtsam.NonlinearFactorGraph:
    """Priors and projections of accepted measurements (n,), without camera poses and ties.

    The variables are the template's without its cameras, and a Point3 `L` for each landmark.
    """
    factors = template.factors()
    graph, m, t, rig = graph_of(factors.priors), measurements, template.traverse, template.rig_variables
    free, lenses = (
        bool(rig.of["calibration"]),
        [without_field(e.camera).with_unit_calibration() for e in t.rig.eyes],
    )
    plain_px = template.without_field(m.image, m.uv_px)
    for i in np.flatnonzero(accepted).tolist():
        image = int(m.image[i])
        calibration: Slot = Fixed(np.zeros(0))
        basis: FloatArray = np.zeros((1, 5, 0))
        if free and (variable := rig.variable("calibration", image)) is not None:
            calibration, basis = Key(variable.key), rig.basis("calibration")[image : image + 1]
        # Not "smart": GTSAM takes a matrix with nothing above its diagonal for a diagonal one.
        noise = loss.noise_model(gtsam.noiseModel.Gaussian.SqrtInformation(m.whitening[i], False))
        graph.push_back(
            mast_projection_factor(
                noise,
                Key(key_of(Kind.LANDMARK, int(m.landmark[i]))),
                template.mast(int(t.image_stop[image])),
                template.pan_tilt(int(t.image_frame[image])),
                rig.mount_slot(image),
                rig.axis_slot(int(t.image_stop[image])),
                calibration,
                template.head_flex.slot(template.flex_key(int(t.image_frame[image]))),
                nominal=t.calibration[image : image + 1],
                basis=basis,
                lens=lenses[int(t.image_eye[image])],
                uv_px=plain_px[i : i + 1],
            )
        )
    return graph
