"""NVM of VisualSFM: `scene.nvm` (version 3) and the images.

Source: the manual of VisualSFM. A camera is a focal length, the quaternion (w, x, y, z) of camera_R_world (x
right, y down, z forward), the centre and a radial distortion, which is 0: images are resampled. Pixels count
from the middle of the image, y down.
"""

from pathlib import Path

import numpy as np

from pancam_graph.base.geometry import wxyz_from_rotation
from pancam_graph.results.formats._centred import centred
from pancam_graph.results.formats._source import Source, row_text

__all__ = ["write_nvm"]


def write_nvm(source: Source, folder: Path) -> None:
    """Write `scene.nvm` and `images/` into an empty folder."""
    scene = centred(source)
    lines = ["NVM_V3", "", str(len(scene.rows))]
    for row, name, camera in zip(scene.rows, scene.names, scene.cameras, strict=True):
        R, centre = scene.pose(row)
        numbers = np.concatenate([[camera.pinhole.fx_px], wxyz_from_rotation(R), centre])
        lines.append(f"{name} {row_text(numbers)} 0 0")
    points = scene.points()
    lines += ["", str(len(points))]
    pixels = scene.from_middle_px()
    within = np.arange(len(scene.placed.image)) - np.searchsorted(scene.placed.image, scene.placed.image)
    for landmark, rows in points:
        shade = scene.shade(landmark)
        views = " ".join(
            f"{scene.number[scene.placed.image[k]]} {within[k]} {row_text(pixels[k])}" for k in rows
        )
        xyz = row_text(source.solution.final.landmarks_m[landmark])
        lines.append(f"{xyz} {shade} {shade} {shade} {len(rows)} {views}")
    scene.write(folder, "nvm", {"scene.nvm": "\n".join([*lines, "", "0", ""])})
