"""Sizes of pictures are known before they are decoded, and no picture is decoded that is not wanted."""

import resource
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pancam_graph.base.errors import ImageError
from pancam_graph.io import read_image, read_mask, read_picture
from pancam_graph.io._picture_size import MAX_PIXELS, picture_size
from support import io_samples

SUFFIXES = (".png", ".jpg", ".tif", ".bmp", ".webp", ".jp2", ".pgm", ".ppm", ".pbm")
GREY_ONLY = {".pgm", ".pbm"}


def encoded(suffix: str, width: int, height: int, *, colour: bool = False) -> bytes:
    shape = (height, width, 3) if colour or suffix == ".ppm" else (height, width)
    samples = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    done, data = cv2.imencode(suffix, samples)
    assert done
    return data.tobytes()


def bomb(width: int, height: int) -> bytes:
    """A PNG of a single grey, of a thousandth of the bytes that its pixels take."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        body = kind + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    packer = zlib.compressobj(9)
    row = bytes(1 + width)
    rows = b"".join([*(packer.compress(row) for _ in range(height)), packer.flush()])
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("colour", [False, True])
def test_the_size_in_a_header_is_that_of_the_picture(suffix: str, colour: bool) -> None:
    if suffix in GREY_ONLY and colour:
        pytest.skip("a format without colour")
    for width, height in ((37, 41), (300, 35)):
        assert picture_size(encoded(suffix, width, height, colour=colour)) == (width, height)


def test_sizes_of_big_endian_tiff_and_of_a_jpeg_with_a_thumbnail_are_those_of_the_picture() -> None:
    entry = struct.pack(">HHIHH", 256, 3, 1, 640, 0) + struct.pack(">HHII", 257, 4, 1, 480)
    assert picture_size(b"MM\0*" + struct.pack(">IH", 8, 2) + entry) == (640, 480)
    thumbnail = encoded(".jpg", 8, 8)
    exif = b"\xff\xe1" + struct.pack(">H", 2 + len(thumbnail)) + thumbnail
    picture = encoded(".jpg", 40, 30)
    assert picture_size(picture[:2] + exif + picture[2:]) == (40, 30)


@settings(max_examples=120, deadline=None, derandomize=True)
@given(st.sampled_from(SUFFIXES), st.data())
def test_no_header_however_damaged_raises(suffix: str, data: st.DataObject) -> None:
    content = bytearray(encoded(suffix, 32, 32))
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, min(len(content) - 1, 80)))] = data.draw(st.integers(0, 255))
    size = picture_size(bytes(content[: data.draw(st.integers(0, len(content)))]))
    assert size is None or len(size) == 2


def test_a_picture_or_mask_of_another_size_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decoded(*_: Any) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(cv2, "imdecode", decoded)
    (tmp_path / "a.png").write_bytes(bomb(3000, 3000))
    sample = io_samples.traverse(folder=tmp_path)
    named = replace(sample, images=(replace(sample.images[0], file="a.png"), *sample.images[1:]))
    with pytest.raises(ImageError, match=r"a\.png: expected 64 x 48 pixels .*, found 3000 x 3000$"):
        read_picture(named, 0)
    with pytest.raises(ImageError, match=r"expected a mask of 64 x 48 pixels .*, found 3000 x 3000$"):
        read_mask(tmp_path / "a.png", 64, 48, "b.png")


def test_a_picture_of_too_many_pixels_is_refused_in_little_memory(tmp_path: Path) -> None:
    side = 12_000
    assert side**2 > MAX_PIXELS
    (tmp_path / "a.png").write_bytes(bomb(side, side))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ImageError, match=r"at most 134217728 pixels, found 12000 x 12000$"):
        read_image(tmp_path / "a.png")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_a_file_of_an_unknown_format_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"text", b"\x89PNG\r\n\x1a\nIEND", b"\xff\xd8\xff\xd9", b"II*\0\xff\xff\xff\xff"):
        (tmp_path / "a.png").write_bytes(content)
        with pytest.raises(ImageError, match=r"a\.png: expected an image that can be read"):
            read_image(tmp_path / "a.png")
