"""Image files as 2-D grey arrays: PDS .IMG through its label, anything else through OpenCV."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.io._pds_label import ImageLayout, PdsLabel, read_label
from pancam_graph.rigs import Rig

__all__ = [
    "GreyImage",
    "ImageContent",
    "left_out",
    "read_eye_content",
    "read_eye_image",
    "read_image",
]

GreyImage = NDArray[np.uint8] | NDArray[np.uint16]

_NAMED = 5
_GREY_WEIGHTS = np.array([0.299, 0.587, 0.114])
"""Red, green, blue to luma, ITU-R BT.601; what OpenCV uses for its own formats."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageContent:
    """What an image file holds."""

    samples: GreyImage
    """(rows, columns)"""
    colour: bool
    """Whether there were bands that differ; their luma is what `samples` has."""
    host: str | None
    """The spacecraft that a PDS label names."""


def left_out(errors: Mapping[str, ImageError]) -> list[str]:
    """Warnings of images, by id, whose files cannot be used: one of each, and how many more there are."""
    said = [f"image {name} is left out: {error}" for name, error in list(errors.items())[:_NAMED]]
    more = len(errors) - _NAMED
    return (
        [*said, f"{more} more images are left out, whose files cannot be used either"] if more > 0 else said
    )


def read_image(path: Path) -> GreyImage:
    """Read an image as (rows, columns), 8 or 16 bits, grey.

    A file that ends in .img or .IMG is read through its PDS3 label (attached, or a .LBL beside it):
    integers of 8 or 16 bits in either byte order; negative samples, and those that the label calls missing or
    invalid, become 0. Anything else is left to OpenCV (PNG, TIFF, JPEG, PGM and more), without turning or
    stretching. Colour becomes luma; an alpha channel is left out. Pixel [0, 0] is the top left one.

    Raises ImageError for a file that is missing, unreadable, truncated, or not of 8 or 16 bits.
    """
    return _read_content(path).samples


def _read_content(path: Path) -> ImageContent:
    if not path.is_file():
        raise ImageError(f"{path}: expected an image file, found {'a folder' if path.is_dir() else 'none'}")
    if path.suffix.lower() == ".img":
        return _read_pds(path)
    return _read_with_opencv(path)


def read_eye_image(path: Path, rig: Rig, eye: int) -> GreyImage:
    """Read an image that an eye of a rig took; see `read_image`.

    Raises ImageError as `read_image` does, and for an image of another size than the eye's camera: a rig
    (most often a template) for another product, subframe or zoom.
    """
    return read_eye_content(path, rig, eye).samples


def read_eye_content(path: Path, rig: Rig, eye: int) -> ImageContent:
    """Read an image that an eye of a rig took, and what else its file says; raises as `read_eye_image`."""
    content = _read_content(path)
    name, camera, (height_px, width_px) = rig.eyes[eye].name, rig.eyes[eye].camera, content.samples.shape
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise ImageError(
            f"{path}: expected {camera.width_px} x {camera.height_px} pixels as of camera {name} "
            f"of the rig {rig.name}, found {width_px} x {height_px}"
        )
    return content


def _read_pds(path: Path) -> ImageContent:
    try:
        label = read_label(path)
        layout = label.image_layout()
    except ImageError:
        raise
    except InputError as error:
        raise ImageError(str(error)) from error
    layout.require_complete()
    samples = _samples(layout)
    samples = np.where(np.isin(samples, _no_data(label)), samples.dtype.type(0), samples)
    host = label.top.items.get("INSTRUMENT_HOST_ID")
    host = None if host is None else label.top.text("INSTRUMENT_HOST_ID").upper()
    if samples.shape[0] == 1:
        return ImageContent(samples=_unsigned(samples[0]), colour=False, host=host)
    if samples.shape[0] < 3:
        raise ImageError(f"{path}: BANDS: expected 1, or 3 for colour, found {samples.shape[0]}")
    colour = bool(np.any(samples[1:3] != samples[0]))
    grey = np.tensordot(_GREY_WEIGHTS, np.maximum(samples[:3], 0).astype(float), axes=1)
    return ImageContent(samples=_unsigned(np.rint(grey).astype(samples.dtype)), colour=colour, host=host)


def _no_data(label: PdsLabel) -> list[float]:
    """Values that stand for missing samples; labels that write them in another way (16#...#) mean reals."""
    image = label.group("IMAGE").items
    entries = (image.get(key) for key in ("MISSING_CONSTANT", "INVALID_CONSTANT"))
    values = [v for entry in entries for v in (entry if isinstance(entry, list | tuple) else [entry])]
    return [float(v) for v in values if isinstance(v, int | float) and not isinstance(v, bool)]


def _samples(layout: ImageLayout) -> NDArray[Any]:
    """All samples as (bands, rows, columns)."""
    size = layout.end_bytes - layout.offset_bytes
    raw = np.fromfile(layout.file, dtype=np.uint8, count=size, offset=layout.offset_bytes)
    lines = raw.reshape(-1, layout.line_bytes)
    stop = layout.line_bytes - layout.line_suffix_bytes
    values: NDArray[Any] = np.ascontiguousarray(lines[:, layout.line_prefix_bytes : stop]).view(layout.dtype)
    height, width, bands = layout.height_px, layout.width_px, layout.bands
    if layout.storage == "SAMPLE_INTERLEAVED":
        return np.asarray(values.reshape(height, width, bands).transpose(2, 0, 1))
    if layout.storage == "LINE_INTERLEAVED":
        return np.asarray(values.reshape(height, bands, width).transpose(1, 0, 2))
    return values.reshape(bands, height, width)


def _unsigned(samples: NDArray[Any]) -> GreyImage:
    positive: NDArray[Any] = np.maximum(samples, 0)
    return positive.astype(np.uint8) if samples.dtype.itemsize == 1 else positive.astype(np.uint16)


def _read_with_opencv(path: Path) -> ImageContent:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path}: expected an image file, could not read it: {error.strerror}") from error
    _require_whole(path, data)
    image = _decode(data)
    if image is None:
        raise ImageError(
            f"{path}: expected an image that OpenCV reads (PNG, TIFF, JPEG, PGM), found {len(data)} bytes "
            "that are none"
        )
    if image.dtype not in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        raise ImageError(f"{path}: expected samples of 8 or 16 bits, found {image.dtype}")
    colour = False
    if image.ndim == 3:
        channels = image.shape[2]
        if channels >= 3:
            colour = bool(np.any(image[:, :, 1:3] != image[:, :, :1]))
            image = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_BGR2GRAY)
        else:
            image = np.ascontiguousarray(image[:, :, 0])
    return ImageContent(samples=_unsigned(image), colour=colour, host=None)


def _decode(data: bytes) -> NDArray[Any] | None:
    """The image, or None for bytes that OpenCV cannot read."""
    if not data:
        return None
    # OpenCV writes lines of its own about broken files; the caller's one sentence replaces them.
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        # From memory: OpenCV cannot open every path that the system can.
        return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    finally:
        cv2.utils.logging.setLogLevel(level)


def _require_whole(path: Path, data: bytes) -> None:
    # OpenCV decodes what there is of a truncated PNG or JPEG and fills the rest.
    for start, end, kind in ((b"\x89PNG", b"IEND", "PNG"), (b"\xff\xd8\xff", b"\xff\xd9", "JPEG")):
        if data.startswith(start) and end not in data[-65536:]:
            raise ImageError(
                f"{path}: expected a whole {kind}, found {len(data)} bytes without its end: truncated"
            )
