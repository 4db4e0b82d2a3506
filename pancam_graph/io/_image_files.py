"""Image files as 2-D grey arrays: uncompressed ones through their labels, anything else through OpenCV."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import ImageError
from pancam_graph.base.regular_files import instead_of_file
from pancam_graph.io._picture_size import PICTURE_FORMATS, WantedSize, picture_size, require_size
from pancam_graph.io._stored_files import STORED_SUFFIXES, read_stored_image
from pancam_graph.io._tiff_entries import ORIENTATION, TIFF_STARTS, first_entries

__all__ = ["GreyImage", "ImageContent", "read_content", "read_image"]

GreyImage = NDArray[np.uint8] | NDArray[np.uint16]

_GREY_WEIGHTS = np.array([0.299, 0.587, 0.114])
"""Red, green, blue to luma, ITU-R BT.601; what OpenCV uses for its own formats."""
_FULL_SCALE = 65_000.0
"""What the largest sample of reals and of wide integers becomes: below the limit that counts as saturated."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageContent:
    """What an image file holds."""

    samples: GreyImage
    """(rows, columns), 8 or 16 bits."""
    colour: bool
    """Whether there were bands that differ; their luma is what `samples` has."""
    host: str | None
    """The spacecraft that a PDS label names."""


def read_image(path: Path) -> GreyImage:
    """Read an image as (rows, columns), 8 or 16 bits, grey.

    A file that ends in .img, .vic, .dat or .raw is read through its label (PDS4, an .xml beside it; PDS3,
    attached or a .LBL beside it; VICAR, attached): integers of 8, 16 or 32 bits and reals in either byte
    order. Negative samples, and those that the label calls missing or invalid, become 0; of reals and of
    integers of 32 bits the largest becomes 65,000. Anything else is left to OpenCV (PNG, TIFF, JPEG, PGM,
    BMP, WebP, JPEG 2000), without turning or stretching. Colour becomes luma; an alpha channel is left out.
    Pixel [0, 0] is the top left one.

    Raises ImageError for a file that is missing, no regular file, unreadable, truncated, of more than
    `MAX_PIXELS` by its header, or not of 8 or 16 bits.
    """
    return read_content(path).samples


def read_content(path: Path, wanted: WantedSize | None = None) -> ImageContent:
    """Read an image as `read_image` does, and what else its file says.

    A file that is not of the wanted size by its header is refused before anything is decoded.
    """
    other = instead_of_file(path)
    if other is not None:
        raise ImageError(f"{path}: expected an image file, found {other}")
    if path.suffix.lower() in STORED_SUFFIXES:
        return _read_stored(path, wanted)
    return _read_with_opencv(path, wanted)


def _read_stored(path: Path, wanted: WantedSize | None) -> ImageContent:
    image = read_stored_image(path)
    require_size(path, (image.layout.width_px, image.layout.height_px), wanted)
    samples = image.layout.samples(image.no_data)
    if samples.shape[0] == 1:
        return ImageContent(samples=_unsigned(samples[0]), colour=False, host=image.host)
    if samples.shape[0] < 3:
        raise ImageError(f"{path}: bands: expected 1, or 3 for colour, found {samples.shape[0]}")
    colour = bool(np.any(samples[1:3] != samples[0]))
    grey = np.tensordot(_GREY_WEIGHTS, np.maximum(samples[:3], 0).astype(float), axes=1)
    if samples.dtype.kind in "iu":
        grey = np.rint(grey).astype(samples.dtype)
    return ImageContent(samples=_unsigned(grey), colour=colour, host=image.host)


def _unsigned(samples: NDArray[Any]) -> GreyImage:
    """Samples of 8 or 16 bits; 0 for negative ones. Wider integers and reals are scaled to fill 16 bits."""
    positive: NDArray[Any] = np.maximum(samples, 0)
    if samples.dtype.itemsize == 1:
        return positive.astype(np.uint8)
    if samples.dtype.itemsize == 2:
        return positive.astype(np.uint16)
    largest = float(positive.max())
    scale = 1.0 if largest == 0 else _FULL_SCALE / largest
    return np.rint(positive * scale).astype(np.uint16)


def _read_with_opencv(path: Path, wanted: WantedSize | None) -> ImageContent:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path}: expected an image file, could not read it: {error.strerror}") from error
    _require_whole(path, data)
    size = picture_size(data)
    if size is not None:
        require_size(path, size, wanted)
    image = None if size is None else _decode(data)
    if image is None:
        raise ImageError(
            f"{path}: expected an image that can be read ({PICTURE_FORMATS}), found {len(data)} bytes that "
            "are none"
        )
    require_size(path, (image.shape[1], image.shape[0]), wanted)  # a header may not agree with what follows
    if image.dtype not in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        raise ImageError(f"{path}: expected samples of 8 or 16 bits, found {image.dtype}")
    colour = False
    if image.ndim == 3:
        channels = image.shape[2]
        if channels >= 3:
            colour = bool(np.any(image[:, :, 1:3] != image[:, :, :1]))
            import cv2  # noqa: PLC0415  only pictures need OpenCV

            image = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_BGR2GRAY)
        else:
            image = np.ascontiguousarray(image[:, :, 0])
    return ImageContent(samples=_unsigned(image), colour=colour, host=None)


def _decode(data: bytes) -> NDArray[Any] | None:
    """The image, or None for bytes that OpenCV cannot read."""
    import cv2  # noqa: PLC0415  only pictures need OpenCV

    if not data:
        return None
    # OpenCV logs lines about broken files; the sentence of the caller replaces them.
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        # From memory: OpenCV cannot open every path that the system can.
        return cv2.imdecode(np.frombuffer(_unturned(data), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    finally:
        cv2.utils.logging.setLogLevel(level)


def _unturned(data: bytes) -> bytes:
    """The file; of a TIFF with the orientation 1, as OpenCV turns a TIFF by it even where it is told not to.

    By EXIF in files of other formats OpenCV turns no picture that is read unchanged.
    """
    if not data.startswith(TIFF_STARTS):
        return data
    found = next((entry for entry in first_entries(data) if entry.tag == ORIENTATION), None)
    if found is None or (found.kind, found.count) != (3, 1) or found.numbers(data) == (1,):
        return data
    upright = struct.pack(f"{found.order}H", 1)
    return b"".join([data[: found.value_at], upright, data[found.value_at + 2 :]])


def _require_whole(path: Path, data: bytes) -> None:
    # OpenCV decodes the first part of a truncated PNG or JPEG and fills the rest with grey.
    for start, end, kind in ((b"\x89PNG", b"IEND", "PNG"), (b"\xff\xd8\xff", b"\xff\xd9", "JPEG")):
        if data.startswith(start) and end not in data[-65536:]:
            raise ImageError(
                f"{path}: expected a whole {kind}, found {len(data)} bytes without its end: truncated"
            )
