"""Constraints on stops and frames, and those that join points; those on one point are in `_sensors`."""

from collections.abc import Iterator, Mapping

import gtsam
import numpy as np

from pancam_graph.data import (
    Constraint,
    FrameSeen,
    LandmarkDistance,
    StopDistance,
    StopHeading,
    StopPlacement,
    StopPose,
    StopPosition,
    Traverse,
)
from pancam_graph.factors import Key, stop_distance_factor, stop_heading_factor, stop_position_factor
from pancam_graph.graph._given import GivenFactor
from pancam_graph.graph._seen_factors import require_in_sight
from pancam_graph.graph._template import FactorTemplate

__all__ = ["landmark_constraints", "stop_constraints"]


def stop_constraints(traverse: Traverse, template: FactorTemplate) -> Iterator[GivenFactor]:
    """The constraints of a traverse that are about stops and frames, on a template of its drive.

    Raises InputError for what its camera cannot see, and for a template without lenses.
    """
    for i, one in enumerate(traverse.constraints):
        if one.landmarks:
            continue
        name = f"constraints[{i}] ({one.about})"
        if isinstance(one, FrameSeen):
            require_in_sight(traverse, one, template.image_of(one), name)
            factor: gtsam.NonlinearFactor | None = template.seen_factor(one)
        else:
            factor = _factor(one, [template.keys.mast(stop) for stop in one.stops])
        if factor is not None:
            yield GivenFactor(factor=factor, name=name, constraint=i)


def landmark_constraints(traverse: Traverse, key_of_track: Mapping[int | None, int]) -> Iterator[GivenFactor]:
    """The constraints that join terrain points which are variables (Point3), by the tracks of these."""
    for i, one in enumerate(traverse.constraints):
        if not isinstance(one, LandmarkDistance):
            continue
        a, b = (traverse.track_of(landmark) for landmark in one.landmarks)
        if a in key_of_track and b in key_of_track:
            sigma = gtsam.noiseModel.Isotropic.Sigma(1, one.sigma)
            factor = gtsam.RangeFactor3(key_of_track[a], key_of_track[b], one.distance_m, sigma)
            yield GivenFactor(factor=factor, name=f"constraints[{i}] ({one.about})", constraint=i)


def _factor(one: Constraint, masts: list[int]) -> gtsam.NonlinearFactor | None:
    noise = gtsam.noiseModel
    if isinstance(one, StopPosition):
        return stop_position_factor(
            noise.Gaussian.Covariance(one.covariance),
            Key(masts[0]),
            position_m=one.target_m,
            axes=one.axes,
        )
    if isinstance(one, StopPlacement):
        return gtsam.PriorFactorPose3(masts[0], one.world_T_mast, noise.Gaussian.Covariance(one.covariance))
    if isinstance(one, StopPose):
        return gtsam.BetweenFactorPose3(
            masts[0], masts[1], one.a_T_b, noise.Gaussian.Covariance(one.covariance)
        )
    if isinstance(one, StopDistance):
        sigma = noise.Diagonal.Sigmas(np.array([one.sigma]))
        return stop_distance_factor(sigma, Key(masts[0]), Key(masts[1]), distance_m=one.value)
    if isinstance(one, StopHeading):
        sigma = noise.Diagonal.Sigmas(np.array([one.sigma]))
        return stop_heading_factor(sigma, Key(masts[0]), heading_rad=one.value)
    return None
