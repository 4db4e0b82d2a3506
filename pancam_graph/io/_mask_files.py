"""Masks that the user drew: white where an image may be used, black where not."""

import re
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import ImageError
from pancam_graph.base.geometry import BoolArray, wrap_angle
from pancam_graph.data import Traverse
from pancam_graph.io._image_files import read_content
from pancam_graph.io._picture_size import WantedSize

__all__ = ["MASKS", "mask_file", "read_mask"]

MASKS = "masks"
"""Name of the folder, beside the images, of masks that are assigned to images by their names."""

_POINTING = re.compile(r"(?P<camera>.+)_pan(?P<pan>[+-]?\d+(?:\.\d+)?)_tilt(?P<tilt>[+-]?\d+(?:\.\d+)?)")
_SAME_POINTING_RAD = np.deg2rad(0.5)


def mask_file(traverse: Traverse, row: int) -> Path | None:
    """The mask of an image, or None: the one that its entry names, else one that is named after it.

    In the folder `masks`, these are looked for in turn, in any format that images have: IMAGE (the image's
    id), CAMERA_panP_tiltT (the camera's name and a pointing in degrees, within half a degree of the image's),
    CAMERA. Whatever has such a name is the mask, a pipe or a link to nothing too, which `read_mask` refuses:
    a mask that is passed over would let in what it covers. For the same reason raises ImageError for a
    `masks` that is there and cannot be listed.
    """
    if traverse.folder is None:
        return None
    image = traverse.images[row]
    if image.mask is not None:
        return traverse.folder / image.mask
    folder = traverse.folder / MASKS
    try:
        masks = sorted(p for p in folder.iterdir() if not p.name.startswith("."))
    except OSError as error:
        if not (folder.exists() or folder.is_symlink()):
            return None
        reason = error.strerror or str(error)
        raise ImageError(f"{folder}: expected a folder of masks, found: {reason}") from error
    frame = traverse.frames[traverse.image_frame[row]]
    exact = [p for p in masks if p.stem == image.id]
    pointed = []
    for path in masks:
        name = _POINTING.fullmatch(path.stem)
        if name is not None and name["camera"] == image.camera:
            pan, tilt = (np.deg2rad(float(name[k])) for k in ("pan", "tilt"))
            off = max(abs(float(wrap_angle(pan - frame.pan_rad))), abs(float(tilt - frame.tilt_rad)))
            if off <= _SAME_POINTING_RAD:
                pointed.append((off, path))
    camera = [p for p in masks if p.stem == image.camera]
    return next(iter([*exact, *(p for _, p in sorted(pointed)), *camera]), None)


def read_mask(path: Path, width_px: int, height_px: int, image: str) -> BoolArray:
    """Where an image may be used, (height, width): brighter than half, or 1 in a file of zeros and ones.

    Raises ImageError as `read_image` does, and for a mask of another size than the image, which `image`
    names.
    """
    words = f"a mask of {width_px} x {height_px} pixels as of image {image}"
    mask = read_content(path, WantedSize(width_px=width_px, height_px=height_px, words=words)).samples
    return np.asarray(mask > (0 if mask.max() <= 1 else np.iinfo(mask.dtype).max // 2))
