"""Simulated traverses as folders: the truth beside them, and rendered images."""

from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.whole_files import recover, whole_file, whole_folder
from pancam_graph.io import write_traverse
from pancam_graph.simulate._drive import Truth
from pancam_graph.simulate._render import Rendering

__all__ = ["check_new", "write_rendering", "write_truth"]

_TRUTH = "truth.npz"


def write_truth(truth: Truth, folder: Path) -> None:
    """Write `truth.npz`, which no solver reads.

    It has world_T_mast (stops, 4, 4), pan_tilt_rad (frames, 2), landmarks_m (tracks, 3), and per observation
    uv_px (n, 2) without noise and outlier (n,). Metres, radians, z up.
    """
    arrays = {k: getattr(truth, k) for k in ("pan_tilt_rad", "landmarks_m", "uv_px", "outlier")}
    content = BytesIO()
    np.savez(content, world_T_mast=[m.matrix() for m in truth.world_T_mast], **arrays)
    whole_file(folder / _TRUTH, content.getvalue())


def check_new(folder: Path) -> None:
    """Raise InputError unless a folder is new or empty; what a killed run has left beside it is deleted."""
    recover(folder)
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder}: expected a new or empty folder, found files")


def write_rendering(
    rendering: Rendering, folder: Path | str, *, progress: Callable[[int, int], None] | None = None
) -> None:
    """Render all images and write them as PNG files with the traverse folder and its `truth.npz`.

    The folder appears when all is done, or not at all. `progress` is called with how many images are
    written, and how many there are. Raises InputError unless `folder` is new or empty.
    """
    import cv2  # noqa: PLC0415  only pictures that are written need OpenCV

    folder = Path(folder)
    check_new(folder)
    images = rendering.traverse.images
    with whole_folder(folder) as partial:
        for row, image in enumerate(images):
            if image.file is None:
                continue
            file = partial / image.file
            file.parent.mkdir(exist_ok=True)
            _, png = cv2.imencode(".png", rendering.image(row))
            file.write_bytes(png.tobytes())
            if progress is not None:
                progress(row + 1, len(images))
        write_traverse(rendering.traverse, partial)
        write_truth(rendering.truth, partial)
