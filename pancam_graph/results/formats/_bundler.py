"""Bundler: `bundle.out` (version 0.3), the list of its images, and the images.

Source: the manual of Bundler. Its camera looks along -z, y up: p = -(R x + t) / z, pixel = f p from the
middle of the image, y up. There is no distortion: images are resampled.
"""

from pathlib import Path

import numpy as np

from pancam_graph.results.formats._centred import centred
from pancam_graph.results.formats._source import Source, row_text

__all__ = ["write_bundler"]

_BUNDLER_R_CAMERA = np.diag([1.0, -1.0, -1.0])


def write_bundler(source: Source, folder: Path) -> None:
    """Write `bundle.out`, `list.txt` and `images/` into an empty folder."""
    scene = centred(source)
    points = scene.points()
    lines = ["# Bundle file v0.3", f"{len(scene.rows)} {len(points)}"]
    for row, camera in zip(scene.rows, scene.cameras, strict=True):
        R, centre = scene.pose(row)
        R = _BUNDLER_R_CAMERA @ R
        lines.append(f"{camera.pinhole.fx_px!r} 0 0")
        lines += [row_text(r) for r in (*R, -R @ centre)]
    pixels = scene.from_middle_px() * [1.0, -1.0]
    # The keys of an image are numbered in the order of its observations.
    within = np.arange(len(scene.placed.image)) - np.searchsorted(scene.placed.image, scene.placed.image)
    for landmark, rows in points:
        shade = scene.shade(landmark)
        views = " ".join(
            f"{scene.number[scene.placed.image[k]]} {within[k]} {row_text(pixels[k])}" for k in rows
        )
        lines += [row_text(source.solution.final.landmarks_m[landmark]), f"{shade} {shade} {shade}"]
        lines.append(f"{len(rows)} {views}")
    files = {"bundle.out": "\n".join([*lines, ""]), "list.txt": "".join(f"{name}\n" for name in scene.names)}
    scene.write(folder, "bundler", files)
