"""Pictures of a textured sphere that a turning camera sees: exact rotations, no parallax."""

from pathlib import Path

import cv2
import numpy as np

from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray, pan_tilt_rotation

WIDTH, HEIGHT, FOCAL_PX = 240, 180, 200.0


def texture(seed: int) -> FloatArray:
    """Blobs of several sizes on a map of the sphere by longitude and latitude, 0 to 255."""
    rng = np.random.default_rng(seed)
    total = np.zeros((512, 1024))
    for sigma in (1.5, 3.0, 6.0):
        noise = cv2.GaussianBlur(rng.normal(size=total.shape), (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
        total += noise / noise.std()
    return np.asarray(np.clip(128 + 35 * total, 1, 255))


def picture(sphere: FloatArray, pan_rad: float, tilt_rad: float) -> FloatArray:
    """What a camera of `FOCAL_PX` sees, (HEIGHT, WIDTH)."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([u - (WIDTH - 1) / 2, v - (HEIGHT - 1) / 2, np.full(u.shape, FOCAL_PX)], axis=-1)
    looks = rays @ (pan_tilt_rotation(pan_rad, tilt_rad) @ HEAD_R_FORWARD_CAMERA).T
    rows, columns = sphere.shape
    x = (np.arctan2(looks[..., 1], looks[..., 0]) / (2 * np.pi) % 1.0) * columns
    y = (0.5 - np.arctan2(looks[..., 2], np.hypot(looks[..., 0], looks[..., 1])) / np.pi) * rows
    seen = cv2.remap(
        sphere.astype(np.float32),
        x.astype(np.float32),
        y.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    return np.asarray(seen, dtype=float)


def write_pictures(folder: Path, sphere: FloatArray, pan_tilt_rad: FloatArray, first: int = 0) -> None:
    """Pictures of pointings (n, 2) as PNG files, numbered from `first` on."""
    folder.mkdir(exist_ok=True)
    for number, (pan_rad, tilt_rad) in enumerate(pan_tilt_rad, first):
        seen = np.rint(picture(sphere, pan_rad, tilt_rad)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{number:02d}.png"), seen)
