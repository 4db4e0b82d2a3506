"""Folders of plain pictures with tables of pointing, and EXIF as cameras write it."""

import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

Number = int | tuple[int, int] | str
"""A value of EXIF: a whole number, a fraction, a text."""

MAKE, MODEL, ORIENTATION = 0x010F, 0x0110, 0x0112
FOCAL, FOCAL_35MM, PLANE_X, PLANE_UNIT = 0x920A, 0xA405, 0xA20E, 0xA210
WIDTH, HEIGHT, SERIAL = 0xA002, 0xA003, 0xA431
_POINTER = 0x8769
_OF_PICTURE = {MAKE, MODEL, ORIENTATION}


def tiff(entries: Mapping[int, Number], order: str = "<") -> bytes:
    """EXIF as a TIFF with two directories, the second behind the first."""
    outer = {tag: value for tag, value in entries.items() if tag in _OF_PICTURE}
    inner = {tag: value for tag, value in entries.items() if tag not in _OF_PICTURE}
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8)
    length = len(_directory({**outer, _POINTER: 0}, 8, order))
    return head + _directory({**outer, _POINTER: 8 + length}, 8, order) + _directory(inner, 8 + length, order)


def _directory(entries: Mapping[int, Number], at: int, order: str) -> bytes:
    behind = at + 2 + 12 * len(entries) + 4
    body, extra = struct.pack(f"{order}H", len(entries)), b""
    for tag, value in sorted(entries.items()):
        if isinstance(value, str):
            kind, count, raw = 2, len(value) + 1, value.encode() + b"\0"
        elif isinstance(value, tuple):
            kind, count, raw = 5, 1, struct.pack(f"{order}II", *value)
        elif tag == _POINTER or value > 0xFFFF:
            kind, count, raw = 4, 1, struct.pack(f"{order}I", value)
        else:
            kind, count, raw = 3, 1, struct.pack(f"{order}H", value)
        body += struct.pack(f"{order}HHI", tag, kind, count)
        if len(raw) <= 4:
            body += raw.ljust(4, b"\0")
        else:
            body += struct.pack(f"{order}I", behind + len(extra))
            extra += raw
    return body + b"\0\0\0\0" + extra


def picture(
    suffix: str, width_px: int = 16, height_px: int = 12, exif: bytes | None = None, seed: int = 0
) -> bytes:
    """A small picture of noise, JPEG or PNG with EXIF where it is given."""
    samples = np.random.default_rng(seed).integers(1, 255, (height_px, width_px), dtype=np.uint8)
    done, encoded = cv2.imencode(suffix, samples)
    assert done
    data = encoded.tobytes()
    if exif is None:
        return data
    if suffix == ".png":
        body = b"eXIf" + exif
        chunk = struct.pack(">I", len(exif)) + body + struct.pack(">I", zlib.crc32(body))
        return data[:33] + chunk + data[33:]
    content = b"Exif\0\0" + exif
    return data[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(content)) + content + data[2:]


def small_tiff(orientation: int, samples: np.ndarray) -> bytes:
    """An 8-bit TIFF of some samples, with an orientation."""
    height_px, width_px = samples.shape
    entries = (
        (256, width_px), (257, height_px), (258, 8), (259, 1), (262, 1), (273, 8), (274, orientation),
        (277, 1), (278, height_px), (279, samples.size),
    )  # fmt: skip
    directory = struct.pack("<H", len(entries)) + b"".join(
        struct.pack("<HHIHH", tag, 3, 1, value, 0) for tag, value in entries
    )
    return b"II*\0" + struct.pack("<I", 8 + samples.size) + samples.tobytes() + directory + b"\0\0\0\0"


def table(path: Path, *lines: str) -> Path:
    """A CSV file of some lines."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def pictures(folder: Path, names: Sequence[str], exif: bytes | None = None) -> Path:
    """A folder with pictures of these names."""
    for number, name in enumerate(names):
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(picture(file.suffix, exif=exif, seed=number))
    return folder
