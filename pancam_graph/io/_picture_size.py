"""Sizes of pictures by the headers of their files, so that no picture is decoded that is not wanted.

A file of 2 MB may say that it holds 30,000 x 30,000 pixels, and decode to gigabytes of one grey. Sources: the
specifications of PNG (W3C, chunk IHDR), JPEG (ITU-T T.81, B.2.2), TIFF 6.0 (section 2), Netpbm (pgm, ppm),
BMP (Windows, BITMAPINFOHEADER), WebP (RFC 9649) and JPEG 2000 (ITU-T T.800, A.5.1).
"""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pancam_graph.base.errors import ImageError
from pancam_graph.base.regular_files import instead_of_file
from pancam_graph.io._tiff_entries import TIFF_STARTS, first_entries

__all__ = [
    "MAX_PIXELS",
    "PICTURE_FORMATS",
    "WantedSize",
    "looks_like_picture",
    "picture_size",
    "require_size",
    "size_of_file",
]

MAX_PIXELS = 1 << 27
"""Pixels of the largest picture that is decoded: 134 million."""
PICTURE_FORMATS = "PNG, TIFF, JPEG, PGM, BMP, WebP, JPEG 2000"
_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".jpe", ".bmp", ".webp", ".jp2", ".j2k")
_NETPBM_SUFFIXES = (".pgm", ".ppm", ".pnm", ".pbm")

Size = tuple[int, int]

_HEADER_BYTES = 1 << 20
"""Bytes in which the header of a picture is looked for; thumbnails in EXIF stand before it."""

_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of JPEG frames; the three others of the range are tables and extensions."""
_JPEG_ALONE = frozenset(range(0xD0, 0xDA)) | {0x01}
"""Markers of JPEG without a length: restarts, start, end, temporary."""
_PNM = re.compile(rb"P[1-6]((?:\s|#[^\n\r]*)+)(\d{1,9})((?:\s|#[^\n\r]*)+)(\d{1,9})\s")
_TIFF_SIZES = frozenset({3, 4, 16})
"""Types of TIFF entries that may hold a width or a height."""


@dataclass(frozen=True, kw_only=True)
class WantedSize:
    """The size that a picture must have, and why."""

    width_px: int
    height_px: int
    words: str
    """What is expected, with the size, as error messages say it."""


def looks_like_picture(path: Path | str) -> bool:
    """Whether a file has the name of a picture of these formats."""
    return Path(path).suffix.lower() in {*_SUFFIXES, *_NETPBM_SUFFIXES}


def require_size(path: Path, size: Size, wanted: WantedSize | None) -> None:
    """Raise ImageError for a picture of another size (width, height) than wanted, or of too many pixels."""
    width_px, height_px = size
    if wanted is not None and size != (wanted.width_px, wanted.height_px):
        raise ImageError(f"{path}: expected {wanted.words}, found {width_px} x {height_px}")
    if width_px * height_px > MAX_PIXELS:
        raise ImageError(
            f"{path}: expected a picture of at most {MAX_PIXELS} pixels, found {width_px} x {height_px}"
        )


def size_of_file(path: Path) -> Size:
    """Width and height of a picture by its file's header. Raises ImageError for a file that is none."""
    other = instead_of_file(path)
    if other is not None:
        raise ImageError(f"{path}: expected an image file, found {other}")
    try:
        with path.open("rb") as stream:
            data = stream.read(_HEADER_BYTES)
            if data.startswith(TIFF_STARTS):  # the entries may be behind the samples
                data += stream.read()
    except OSError as error:
        raise ImageError(f"{path}: expected an image file, could not read it: {error.strerror}") from error
    size = picture_size(data)
    if size is None:
        raise ImageError(
            f"{path}: expected a picture ({PICTURE_FORMATS}), found a file that begins like none"
        )
    return size


def picture_size(data: bytes) -> Size | None:
    """Width and height, pixels, that the file's header says; None for a file of no known format.

    Of a file with several pictures it is the size of the first.
    """
    for start, reader in _READERS:
        if data.startswith(start):
            try:
                return reader(data)
            except struct.error:  # the file ends within the header
                return None
    return None


def _png(data: bytes) -> Size | None:
    width, height = struct.unpack_from(">II", data, 16)
    return (width, height) if data[12:16] == b"IHDR" else None


def _jpeg(data: bytes) -> Size | None:
    at = 2
    while True:
        at = data.find(b"\xff", at)
        if at < 0:
            return None
        (marker,) = struct.unpack_from("B", data, at + 1)
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if marker in {0xFF, 0x00}:  # filling
            at += 1
        elif marker in _JPEG_ALONE:
            at += 2
        else:
            at += 2 + max(2, struct.unpack_from(">H", data, at + 2)[0])


def _tiff(data: bytes) -> Size | None:
    sides: dict[int, int] = {}
    for entry in first_entries(data):
        if entry.tag in {256, 257} and entry.kind in _TIFF_SIZES:
            (sides[entry.tag],) = entry.numbers(data)
    return (sides[256], sides[257]) if len(sides) == 2 else None


def _pnm(data: bytes) -> Size | None:
    match = _PNM.match(data[:4096])
    return None if match is None else (int(match[2]), int(match[4]))


def _bmp(data: bytes) -> Size | None:
    (header,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if header == 12 else "<ii", data, 18)
    return abs(width), abs(height)  # a height below 0 is that of a picture from top to bottom


def _webp(data: bytes) -> Size | None:
    kind = data[12:16]
    if kind == b"VP8X":
        a, b, c, d, e, f = struct.unpack_from("6B", data, 24)
        return 1 + (a | b << 8 | c << 16), 1 + (d | e << 8 | f << 16)
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", data, 26)
    return (width & 0x3FFF, height & 0x3FFF) if kind == b"VP8 " else None


def _jpeg2000(data: bytes) -> Size | None:
    at = data.find(b"\xff\x4f\xff\x51")  # start of the code stream, then the marker of its size
    if at < 0:
        return None
    right, bottom, left, top = struct.unpack_from(">IIII", data, at + 8)
    return max(right - left, 0), max(bottom - top, 0)


_READERS: tuple[tuple[bytes, Callable[[bytes], Size | None]], ...] = (
    (b"\x89PNG\r\n\x1a\n", _png),
    (b"\xff\xd8\xff", _jpeg),
    *((start, _tiff) for start in TIFF_STARTS),
    (b"BM", _bmp),
    (b"RIFF", _webp),
    (b"\x00\x00\x00\x0cjP  \r\n\x87\n", _jpeg2000),
    (b"\xff\x4f\xff\x51", _jpeg2000),
    *((f"P{kind}".encode(), _pnm) for kind in range(1, 7)),
)
