"""Two stops of a stereo mast that share only far points."""

from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph import Observations, Traverse
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Frame, Image, Stop
from pancam_graph.rigs import Rig, mer_navcam

__all__ = ["FarScene", "far_scene"]

_APART_M = 2.0
_PANS = 10
_NOISE_PX = 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class FarScene:
    """A traverse of two stops, and its truth."""

    traverse: Traverse
    world_T_mast: tuple[gtsam.Pose3, ...]
    """Of both stops; the first is held there."""
    pan_tilt_rad: FloatArray
    """(frames, 2)"""
    landmarks_m: FloatArray
    """(tracks, 3); the row is the track number"""


def far_scene(
    range_m: FloatArray, *, seed: int, sigma_m: float = 0.3, pans: int = _PANS, rig: Rig | None = None
) -> FarScene:
    """Points at these ranges (n,), all around, from 6 degrees below the horizon to 8 above it.

    Both stops take a panorama of `pans` frames, 2 m apart; each point is observed by every image that has it,
    with 0.3 px of noise. Telemetry has the noise that it claims.
    """
    rng, rig = np.random.default_rng(seed), rig or mer_navcam()
    n, yaw = len(range_m), rng.normal(0.0, 0.25)
    turns = [np.array([*rng.normal(0, 0.02, 2), angle]) for angle in (0.0, yaw)]
    along = _APART_M * np.array([np.cos(yaw / 2), np.sin(yaw / 2), 0.0]) + [0, 0, rng.normal(0, 0.05)]
    places = [np.array([0.0, 0.0, 1.5]), np.array([0.0, 0.0, 1.5]) + along]
    masts = tuple(
        gtsam.Pose3(gtsam.Rot3.RzRyRx(turn), place) for turn, place in zip(turns, places, strict=True)
    )
    pan = ((np.arange(pans) + 0.5) / pans - 0.5) * 2 * np.pi
    pan_tilt = np.tile(np.column_stack([pan, np.zeros(pans)]), (2, 1))
    azimuth, elevation = rng.uniform(-np.pi, np.pi, n), np.deg2rad(rng.uniform(-6, 8, n))
    level = np.cos(elevation)
    direction = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    points = 0.5 * (places[0] + places[1]) + range_m[:, None] * direction
    traverse = _traverse(rig, masts, pan_tilt, sigma_m, rng)
    return FarScene(
        traverse=traverse.with_observations(_observed(traverse, masts, pan_tilt, points, rng)),
        world_T_mast=masts,
        pan_tilt_rad=pan_tilt,
        landmarks_m=points,
    )


def _observed(
    traverse: Traverse,
    masts: tuple[gtsam.Pose3, ...],
    pan_tilt: FloatArray,
    points: FloatArray,
    rng: np.random.Generator,
) -> Observations:
    """Points that both stops see, in every image that has them."""
    rotation, centre = traverse.camera_poses(masts, pan_tilt)
    images, tracks, pixels = [], [], []
    for i, eye in enumerate(traverse.image_eye):
        camera = traverse.rig.eyes[eye].camera
        ray = (points - centre[i]) @ rotation[i]
        uv_px, valid = camera.project(ray)
        seen = np.flatnonzero(valid & (ray[:, 2] > 0) & camera.contains(uv_px))
        images.append(np.full(len(seen), i))
        tracks.append(seen)
        pixels.append(uv_px[seen])
    image, track, uv_px = np.concatenate(images), np.concatenate(tracks), np.concatenate(pixels)
    stop = traverse.image_stop[image]
    shared = np.isin(track, track[stop == 0]) & np.isin(track, track[stop == 1])
    noisy = uv_px[shared] + _NOISE_PX * rng.standard_normal((int(shared.sum()), 2))
    return Observations(
        image=image[shared], track=track[shared], uv_px=noisy, sigma_px=np.full(len(noisy), _NOISE_PX)
    )


def _traverse(
    rig: Rig,
    masts: tuple[gtsam.Pose3, ...],
    pan_tilt: FloatArray,
    sigma_m: float,
    rng: np.random.Generator,
) -> Traverse:
    """Telemetry with its errors; the first stop is held at the truth."""
    sigma_rad, pointing = 0.01, rig.pointing_sigma
    error = np.repeat([sigma_rad, sigma_m], 3) * rng.standard_normal(6)
    told = (masts[0], masts[1] * gtsam.Pose3.Expmap(error))
    angle_sigma = np.array([pointing.pan_rad, pointing.tilt_rad])
    angles = pan_tilt + angle_sigma * rng.standard_normal(pan_tilt.shape)
    stops = tuple(
        Stop(
            id=f"s{i}",
            world_T_mast=pose,
            sigma_rotation_rad=sigma_rad * i,
            sigma_translation_m=sigma_m * i,
        )
        for i, pose in enumerate(told)
    )
    frames = tuple(
        Frame(
            id=f"f{i}",
            stop=stops[2 * i // len(angles)].id,
            pan_rad=float(pan),
            tilt_rad=float(tilt),
            sigma_pan_rad=float(angle_sigma[0]),
            sigma_tilt_rad=float(angle_sigma[1]),
        )
        for i, (pan, tilt) in enumerate(angles)
    )
    images = tuple(
        Image(id=f"{f.id}-{eye.name}", frame=f.id, camera=eye.name, file=None)
        for f in frames
        for eye in rig.eyes
    )
    return Traverse(name="far", rig=rig, stops=stops, frames=frames, images=images)
