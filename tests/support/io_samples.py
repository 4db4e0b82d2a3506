"""Small traverses and solutions for the tests of files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from pancam_graph import Frame, Image, Observations, Stop, Traverse
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray, rx, rz
from pancam_graph.cameras import CAHV, CAHVOR, CAHVORE, Brown, Pinhole
from pancam_graph.data import Solution, State
from pancam_graph.rigs import RIG_ENTRIES, Eye, Rig, RigCovariance, RigEntry

SIZE: dict[str, Any] = {"width_px": 64, "height_px": 48}
MOUNT = gtsam.Pose3(gtsam.Rot3(rz(0.1) @ HEAD_R_FORWARD_CAMERA), np.array([0.1, 0.2, -0.03]))


def cahv_vectors() -> dict[str, Any]:
    """A camera that looks along the head's x axis, with axes that are not quite orthogonal."""
    turn = rz(-0.02) @ rx(0.01)
    axis: FloatArray = turn @ [1.0, 0.0, 0.0]
    return {
        "C": np.array([0.1, -0.1, 0.02]),
        "A": axis,
        "H": 70.0 * turn @ [0.0, -1.0, 1e-4] + 31.0 * axis,
        "V": 71.0 * turn @ [0.0, 2e-4, -1.0] + 23.0 * axis,
    }


def all_eyes() -> tuple[Eye, ...]:
    """An eye of each camera model."""
    numbers: dict[str, Any] = {"fx_px": 70.0, "fy_px": 71.5, "cx_px": 31.5, "cy_px": 23.25}
    distortion = (-0.1, 0.02, 1e-3, -2e-3, 0.005)
    vectors = cahv_vectors()
    optical: dict[str, Any] = {"O": vectors["A"], "R": np.array([1e-4, -0.02, 0.01])}
    pupil: dict[str, Any] = {"E": np.array([-0.003, 0.01, -0.02]), "linearity": 0.37}
    return (
        Eye(name="pinhole", camera=Pinhole(**SIZE, **numbers, skew_px=0.3), head_T_camera=MOUNT),
        Eye(name="brown", camera=Brown(**SIZE, **numbers, distortion=distortion), head_T_camera=MOUNT),
        Eye.from_head_model("cahv", CAHV(**SIZE, **vectors)),
        Eye.from_head_model("cahvor", CAHVOR(**SIZE, **vectors, **optical)),
        Eye.from_head_model("cahvore", CAHVORE(**SIZE, **vectors, **optical, **pupil)),
    )


def traverse(poses: tuple[gtsam.Pose3, ...] = (gtsam.Pose3(), MOUNT), folder: Path | None = None) -> Traverse:
    """Two frames at each stop, an image of each eye in each frame, three tracks that every image sees."""
    rig = Rig(name="all models", pan_T_tilt=gtsam.Pose3(gtsam.Rot3(), np.array([0, 0, 0.1])), eyes=all_eyes())
    stops = tuple(
        Stop(id=f"s{i}", world_T_mast=pose, sigma_rotation_rad=0.01 * i, sigma_translation_m=0.1 * i)
        for i, pose in enumerate(poses)
    )
    frames = tuple(
        Frame(
            id=f"{stop.id}f{i}",
            stop=stop.id,
            pan_rad=0.1 + i / 3,
            tilt_rad=-0.2,
            sigma_pan_rad=1.34e-3,
            sigma_tilt_rad=1e-3,
        )
        for stop in stops
        for i in range(2)
    )
    images = tuple(Image(id=f"{f.id}_{e.name}", frame=f.id, camera=e.name) for f in frames for e in rig.eyes)
    n = len(images)
    rng = np.random.default_rng(0)
    observations = Observations(
        image=np.repeat(np.arange(n), 3),
        track=np.tile([0, 2, 7], n),
        uv_px=rng.uniform(0, 47, (3 * n, 2)),
        sigma_px=np.full(3 * n, 0.3),
    )
    return Traverse(
        name="sample",
        rig=rig,
        stops=stops,
        frames=frames,
        images=images,
        observations=observations,
        folder=folder,
    )


def covariances(n: int) -> FloatArray:
    """Covariances (n, 2, 2) that are all different, correlated, and exactly symmetric."""
    root = np.random.default_rng(1).normal(0, 0.3, (n, 2, 2))
    covariance = root @ root.transpose(0, 2, 1) + 0.01 * np.eye(2)
    return np.asarray((covariance + covariance.transpose(0, 2, 1)) / 2)


def with_covariance(rig: Rig, pictures: tuple[str, ...] = ()) -> Rig:
    """A rig with a covariance of all numbers of its eyes' calibrations and mounts, each with each."""
    entries = tuple(
        RigEntry(quantity, eye.name, entry)
        for eye in rig.eyes
        for quantity in ("calibration", "mounts")
        for entry in RIG_ENTRIES[quantity]
    )
    n = len(entries)
    size = np.array([rig.uncertainty.sigma_of(e.quantity, e.entry) for e in entries])
    root = np.eye(n) + np.random.default_rng(2).normal(0, 0.1, (n, n))
    matrix = 0.1 * np.outer(size, size) * (root @ root.T)
    covariance = RigCovariance(entries=entries, matrix=(matrix + matrix.T) / 2, pictures=pictures)
    return replace(rig, uncertainty=replace(rig.uncertainty, covariance=covariance))


def solution(**changes: Any) -> Solution:
    """A made-up solution: track 2 has no landmark, image 0 has no used observation, one is an outlier."""
    given = traverse()
    observations = given.observations
    assert observations is not None
    n = len(observations)
    rotations, centres = given.camera_poses()
    state = State(
        world_T_mast=tuple(s.world_T_mast for s in given.stops),
        pan_tilt_rad=given.pan_tilt_rad + 1e-4,
        world_R_camera=rotations,
        world_t_camera=centres,
        landmarks_m=np.array([[1.0, 2.0, 3.0], [np.nan] * 3, [5.0, 6.0, 7.0]]),
    )
    reason = ["single" if t == 2 else "" for t in observations.track]
    reason[0] = reason[2] = reason[5] = "outlier"
    residual = np.tile([0.3, -0.4], (n, 1))
    residual[observations.track == 2] = np.nan
    values: dict[str, Any] = {
        "traverse": given,
        "model": "mast",
        "landmarks": "explicit",
        "converged": True,
        "stop_reason": "relative decrease below 1e-9",
        "iterations": 4,
        "cost_history": (200.0, 50.0),
        "cost_initial": 200.0,
        "cost_final": 50.0,
        "initial": state,
        "final": state,
        "landmark_track": np.array([7, 2, 0]),
        "used": np.array([r == "" for r in reason]),
        "reason": tuple(reason),
        "residual_initial_px": 2 * residual,
        "residual_final_px": residual,
        "sigma_px": observations.sigma_px,
        "stop_covariance": np.stack([np.zeros((6, 6)), np.diag(np.arange(1.0, 7.0))]),
        "angle_sigma_rad": np.full((len(given.frames), 2), 2e-5),
        "warnings": ("a track is seen once",),
    }
    return Solution(**values | changes)
