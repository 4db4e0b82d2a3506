"""Images of a textured plane with known poses, for tests of mosaics."""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from pancam_graph import Frame, Image, Observations, Solution, Stop, Traverse
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import State
from pancam_graph.rigs import Rig, stereo_pan_tilt

MARK_M = np.array([12.0 + 2.4, -5.0 + 1.1, 0.0])
"""Middle of a dark disc on the plane."""
MARK_RADIUS_M = 0.05
PLACE_M = np.array([12.0, -5.0, 1.4])
PX_PER_RAD = 224 / 2 / np.tan(np.deg2rad(55.0) / 2)

_ACROSS, _ALONG = 4096, 1024


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Pointings, light and cameras of a scene, and the errors of telemetry."""

    pans_rad: tuple[float, ...] = tuple(np.deg2rad([40.0, 10.0, -20.0]))
    tilt_rad: float = float(np.deg2rad(-34.0))
    error_rad: tuple[tuple[float, float], ...] = ()
    """Pan and tilt of telemetry minus truth, by frame; further frames have no error."""
    exposure: tuple[float, ...] = ()
    """Factor of the brightness by frame; further frames have 1."""
    vignetting: float = 0.0
    """Share of the light that is lost in the corners, with the square of the distance from the middle."""
    bits: int = 16
    cameras: tuple[str, ...] = ("left",)
    points: int = 3000
    rig: Rig = field(
        default_factory=lambda: stereo_pan_tilt(field_rad=np.deg2rad(55.0), width_px=224, height_px=224)
    )


@lru_cache(maxsize=1)
def _texture() -> NDArray[np.float32]:
    noise = np.random.default_rng(5).normal(0, 1, (_ALONG, _ACROSS)).astype(np.float32)
    joined = cv2.GaussianBlur(np.hstack([noise[:, -64:], noise, noise[:, :64]]), (0, 0), 10.0)
    texture = joined[:, 64 : _ACROSS + 64 + 8]
    return np.asarray(texture / texture.std(), dtype=np.float32)


def brightness(xy_m: FloatArray) -> FloatArray:
    """Brightness of the plane at places (n, 2), with details of about a pixel at any distance."""
    d = xy_m - PLACE_M[:2]
    column = (np.arctan2(d[:, 1], d[:, 0]) % (2 * np.pi)) / (2 * np.pi) * _ACROSS
    row = (np.log(np.hypot(d[:, 0], d[:, 1])) - np.log(0.3)) / np.log(100) * _ALONG
    at = [a.astype(np.float32).reshape(-1, 64) for a in (column, row)]
    grey = 1000 + 250 * cv2.remap(_texture(), at[0], at[1], cv2.INTER_CUBIC).ravel()
    away = np.linalg.norm(xy_m - MARK_M[:2], axis=1) / MARK_RADIUS_M
    return np.where(away < 1, 100.0, grey)


def solved(scene: Scene, folder: Path) -> Solution:
    """Write the images of a scene into a folder; returns a solution that ends at the truth."""
    rig = scene.rig
    n = len(scene.pans_rad)
    truth = np.array([[pan, scene.tilt_rad] for pan in scene.pans_rad])
    given = truth.copy()
    given[: len(scene.error_rad)] += np.array(scene.error_rad).reshape(-1, 2)
    mast = gtsam.Pose3(gtsam.Rot3(), PLACE_M)
    traverse = Traverse(
        name="plane",
        rig=rig,
        folder=folder,
        stops=(Stop(id="A/1", world_T_mast=mast, sigma_rotation_rad=0.0, sigma_translation_m=0.0),),
        frames=tuple(
            Frame(
                id=f"f{k}",
                stop="A/1",
                pan_rad=float(pan),
                tilt_rad=float(tilt),
                sigma_pan_rad=2e-3,
                sigma_tilt_rad=2e-3,
            )
            for k, (pan, tilt) in enumerate(given)
        ),
        images=tuple(
            Image(id=f"f{k}-{camera}", frame=f"f{k}", camera=camera, file=f"f{k}-{camera}.png")
            for k in range(n)
            for camera in scene.cameras
        ),
    )
    R, t = traverse.camera_poses([mast], truth)
    rng = np.random.default_rng(3)
    away, around = (
        np.exp(rng.uniform(np.log(0.8), np.log(20.0), scene.points)),
        rng.uniform(0, 2 * np.pi, scene.points),
    )
    landmarks = PLACE_M * [1, 1, 0] + np.column_stack(
        [away * np.cos(around), away * np.sin(around), np.zeros(scene.points)]
    )
    rows = []
    for row, entry in enumerate(traverse.images):
        camera = rig.eyes[traverse.image_eye[row]].camera
        v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
        ray = camera.unproject(np.column_stack([u.ravel(), v.ravel()])).direction @ R[row].T
        ground = t[row] - ray * (t[row, 2] / ray[:, 2])[:, None]
        frame = int(traverse.image_frame[row])
        gain = scene.exposure[frame] if frame < len(scene.exposure) else 1.0
        grey = gain * brightness(ground[:, :2]).reshape(camera.height_px, camera.width_px)
        middle = np.array([camera.width_px - 1.0, camera.height_px - 1.0]) / 2
        away = ((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / (middle @ middle)
        grey = np.rint((1 - scene.vignetting * away) * (grey if scene.bits == 16 else grey / 10))
        samples = grey.astype(np.uint16) if scene.bits == 16 else grey.astype(np.uint8)
        assert cv2.imwrite(str(folder / str(entry.file)), samples)
        uv, valid = camera.project((landmarks - t[row]) @ R[row])
        seen = np.flatnonzero(valid & camera.contains(uv))
        rows.append(np.column_stack([np.full(len(seen), row), seen, uv[seen]]))
    table = np.concatenate(rows)
    track = table[:, 1].astype(np.int64)
    used = np.bincount(track, minlength=scene.points)[track] > 1
    traverse = traverse.with_observations(
        Observations(
            image=table[:, 0].astype(np.int64),
            track=track,
            uv_px=table[:, 2:],
            sigma_px=np.full(len(table), 0.2),
        )
    )

    def state(angles: FloatArray) -> State:
        world_R_camera, world_t_camera = traverse.camera_poses([mast], angles)
        return State(
            world_T_mast=(mast,),
            pan_tilt_rad=angles,
            world_R_camera=world_R_camera,
            world_t_camera=world_t_camera,
            landmarks_m=landmarks.copy(),
        )

    return Solution(
        traverse=traverse,
        model="mast",
        landmarks="eliminated",
        converged=True,
        stop_reason="truth",
        iterations=0,
        cost_history=(1.0,),
        cost_initial=1.0,
        cost_final=1.0,
        initial=state(given),
        final=state(truth),
        landmark_track=np.arange(scene.points),
        used=used,
        reason=tuple("" if u else "single" for u in used.tolist()),
        residual_initial_px=np.zeros((len(table), 2)),
        residual_final_px=np.zeros((len(table), 2)),
        sigma_px=np.full(len(table), 0.2),
        stop_covariance=np.zeros((1, 6, 6)),
        angle_sigma_rad=np.full((n, 2), 1e-4),
    )


def without_file(solution: Solution, row: int) -> Solution:
    """The same solution with an image that has no file."""
    images = list(solution.traverse.images)
    images[row] = replace(images[row], file=None)
    return replace(solution, traverse=replace(solution.traverse, images=tuple(images)))
