"""Odometry as a factor between a stop and the stop before it."""

import gtsam

from pancam_graph.base.errors import InputError
from pancam_graph.smoother._frame import orthonormal
from pancam_graph.smoother._station import Station, copied

__all__ = ["guess", "join", "local_priors"]


def join(station: Station, previous: Station) -> None:
    """Give a station a factor of odometry from another one, in place of the prior on its mast pose.

    Raises InputError where that motion has no sigmas.
    """
    stop, other = station.traverse.stops[0], previous.traverse.stops[0]
    if station.mast is None or len(station.held_of_mast):
        raise InputError(
            f"stop {stop.id}: expected sigmas above 0, of the motion from {other.id}; found "
            f"{stop.sigma_rotation_rad} and {stop.sigma_translation_m}"
        )
    noise = gtsam.noiseModel.Diagonal.Sigmas(stop.sigmas)
    if previous.mast is None:
        station.motion = gtsam.PriorFactorPose3(station.mast, stop.world_T_mast, noise)
    else:
        moved = other.world_T_mast.between(stop.world_T_mast)
        station.motion = gtsam.BetweenFactorPose3(previous.mast, station.mast, moved, noise)


def guess(station: Station, previous: Station | None, estimate: gtsam.Values) -> gtsam.Pose3:
    """Initial mast pose: odometry from the previous stop's estimate; without one, telemetry's pose."""
    said = station.traverse.stops[0].world_T_mast
    if previous is None or station.mast is None:
        return said
    moved = previous.traverse.stops[0].world_T_mast.between(said)
    return orthonormal(previous.world_T_mast(estimate) * moved)


def local_priors(
    station: Station, previous: Station | None, values: gtsam.Values
) -> list[gtsam.NonlinearFactor]:
    """Priors of a station's own variables while the others are held."""
    between = station.motion
    if previous is None or previous.mast is None or not isinstance(between, gtsam.BetweenFactorPose3):
        return station.factors(firm=True, at=values)
    assert station.mast is not None  # `join` gives odometry to free masts only
    previous_mast = copied(values, [previous.mast])
    held = gtsam.PriorFactorPose3(
        station.mast,
        orthonormal(previous_mast.atPose3(previous.mast) * between.measured()),
        between.noiseModel(),
    )
    return [held, *station.other_priors(firm=True, at=values)]
