"""Rendered scenes with known truth: a textured sphere around the first stop, seen by a small rig."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import gtsam
import numpy as np
from scipy import ndimage

from pancam_graph import Frame, Image, Observations, Stop, Traverse
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray
from pancam_graph.cameras import Pinhole
from pancam_graph.images import FrontEndOptions
from pancam_graph.rigs import Eye, Rig

SIZE_PX = 240
RADIUS_M = 5.0  # of the textured sphere that surrounds the first stop
DECK_M = -0.6  # height of the rover's deck in the mast frame
DECK_HALF_M = 1.2
_STEP_RAD = 3e-3
QUICK = FrontEndOptions(max_features=500)


def small_rig() -> Rig:
    camera = Pinhole(
        width_px=SIZE_PX,
        height_px=SIZE_PX,
        fx_px=290.0,
        fy_px=290.0,
        cx_px=(SIZE_PX - 1) / 2,
        cy_px=(SIZE_PX - 1) / 2,
    )
    eyes = tuple(
        Eye(
            name=name,
            camera=camera,
            head_T_camera=gtsam.Pose3(gtsam.Rot3(HEAD_R_FORWARD_CAMERA), np.array([0.1, y, 0.05])),
        )
        for name, y in (("left", 0.1), ("right", -0.1))
    )
    return Rig(name="small", pan_T_tilt=gtsam.Pose3(), eyes=eyes)


@cache
def noise_texture(shape: tuple[int, int], seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    out = np.zeros(shape)
    for scale in (1.5, 3.0, 6.0, 15.0):
        octave = ndimage.gaussian_filter(rng.standard_normal(shape), scale, mode="wrap")
        out += octave / octave.std()
    return out


class Scene:
    """A textured sphere fixed to the world and, if wanted, a textured deck fixed to each mast."""

    def __init__(self, *, deck: bool = False) -> None:
        self.sphere = noise_texture((700, 1100), 1)
        self.deck = noise_texture((400, 400), 2) if deck else None

    def points_m(self, traverse: Traverse, row: int, uv_px: FloatArray) -> tuple[FloatArray, np.ndarray]:
        """World points that pixels of an image see, and whether they are on the deck."""
        stops = [s.world_T_mast for s in traverse.stops]
        R, centre = traverse.camera_poses()
        camera = traverse.rig.eyes[traverse.image_eye[row]].camera
        direction = camera.unproject(uv_px).direction @ R[row].T
        along = direction @ centre[row]
        reach = -along + np.sqrt(along**2 - centre[row] @ centre[row] + RADIUS_M**2)
        world_T_mast = stops[traverse.image_stop[row]]
        mast_c = world_T_mast.transformTo(centre[row])
        mast_d = direction @ world_T_mast.rotation().matrix()
        deck_reach = (DECK_M - mast_c[2]) / np.minimum(mast_d[:, 2], -1e-6)
        on = np.abs(mast_c + deck_reach[:, None] * mast_d).max(axis=1) < DECK_HALF_M
        on &= self.deck is not None
        return centre[row] + np.where(on, deck_reach, reach)[:, None] * direction, on

    def render(self, traverse: Traverse, row: int, bits: int = 8) -> np.ndarray:
        u, v = np.meshgrid(np.arange(SIZE_PX), np.arange(SIZE_PX))
        points, on_deck = self.points_m(traverse, row, np.column_stack([u.ravel(), v.ravel()]).astype(float))
        azimuth, elevation = np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / RADIUS_M)
        at = [350 - elevation / _STEP_RAD, 550 - azimuth / _STEP_RAD]
        grey = ndimage.map_coordinates(self.sphere, at, order=1, mode="wrap")
        if self.deck is not None:
            mast = (points - traverse.stops[traverse.image_stop[row]].world_T_mast.translation()) @ (
                traverse.stops[traverse.image_stop[row]].world_T_mast.rotation().matrix()
            )
            at = [200 + 160 * mast[:, 0], 200 + 160 * mast[:, 1]]
            grey = np.where(on_deck, ndimage.map_coordinates(self.deck, at, order=1, mode="wrap"), grey)
        noise = np.random.default_rng(row).normal(scale=0.02, size=grey.shape)
        scaled = np.clip(0.5 + 0.1 * (grey + noise), 0, 1) * (2**bits - 1)
        samples: FloatArray = np.rint(scaled).reshape(SIZE_PX, SIZE_PX)
        return samples.astype(np.uint8) if bits == 8 else samples.astype(np.uint16)


def make_traverse(
    folder: Path,
    *,
    pans_deg: tuple[float, ...] = (-26.0, 0.0, 26.0),
    tilt_deg: float = 0.0,
    stops: tuple[gtsam.Pose3, ...] = (gtsam.Pose3(),),
    eyes: tuple[str, ...] = ("left", "right"),
    deck: bool = False,
    bits: int = 8,
) -> tuple[Traverse, Scene]:
    """A traverse whose telemetry is the truth, with rendered image files in `folder`."""
    scene = Scene(deck=deck)
    sigma = float(np.deg2rad(0.1))
    places = tuple(
        Stop(id=f"s{k}", world_T_mast=pose, sigma_rotation_rad=2e-3, sigma_translation_m=0.02)
        for k, pose in enumerate(stops)
    )
    frames = tuple(
        Frame(
            id=f"{s.id}-f{k}",
            stop=s.id,
            pan_rad=float(np.deg2rad(pan)),
            tilt_rad=float(np.deg2rad(tilt_deg)),
            sigma_pan_rad=sigma,
            sigma_tilt_rad=sigma,
        )
        for s in places
        for k, pan in enumerate(pans_deg)
    )
    images = tuple(
        Image(id=f"{f.id}-{eye}", frame=f.id, camera=eye, file=f"{f.id}-{eye}.png")
        for f in frames
        for eye in eyes
    )
    truth = Traverse(
        name="rendered", rig=small_rig(), stops=places, frames=frames, images=images, folder=folder
    )
    for row, image in enumerate(images):
        assert cv2.imwrite(str(folder / str(image.file)), scene.render(truth, row, bits))
    return truth, scene


def disturbed(traverse: Traverse, sigma_deg: float, seed: int) -> Traverse:
    """The traverse with pan and tilt moved, and its sigmas widened to match."""
    sigma = float(np.deg2rad(sigma_deg))
    change = np.random.default_rng(seed).normal(scale=sigma, size=(len(traverse.frames), 2))
    frames = tuple(
        replace(
            f, pan_rad=f.pan_rad + d[0], tilt_rad=f.tilt_rad + d[1], sigma_pan_rad=sigma, sigma_tilt_rad=sigma
        )
        for f, d in zip(traverse.frames, change.tolist(), strict=True)
    )
    return replace(traverse, frames=frames)


def found_in(traverse: Traverse) -> Observations:
    assert traverse.observations is not None
    return traverse.observations


def errors_px(truth: Traverse, scene: Scene, obs: Observations) -> FloatArray:
    """Distance of each observation from where its track's first one says it is, by the true scene."""
    R, centre = truth.camera_poses()
    first = np.searchsorted(obs.track, obs.track)
    error = np.zeros(len(obs))
    for row in range(len(truth.images)):
        camera = truth.rig.eyes[truth.image_eye[row]].camera
        for origin in range(len(truth.images)):
            k = np.flatnonzero(
                (obs.image == row) & (obs.image[first] == origin) & (first != np.arange(len(obs)))
            )
            if len(k):
                points, _ = scene.points_m(truth, origin, obs.uv_px[first[k]])
                pixel, _ = camera.project((points - centre[row]) @ R[row])
                error[k] = np.linalg.norm(pixel - obs.uv_px[k], axis=1)
    return np.asarray(error[first != np.arange(len(obs))])


def as_bytes(obs: Observations) -> bytes:
    assert obs.covariance_px2 is not None
    return b"".join(c.tobytes() for c in (obs.image, obs.track, obs.uv_px, obs.covariance_px2))
