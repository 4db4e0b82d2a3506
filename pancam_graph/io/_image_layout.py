"""Where the samples of an uncompressed image are in its file, and how they are written."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import ImageError
from pancam_graph.base.regular_files import instead_of_file
from pancam_graph.io._picture_size import MAX_PIXELS

__all__ = ["ImageLayout", "Storage", "require_sides"]

Storage = Literal["BAND_SEQUENTIAL", "LINE_INTERLEAVED", "SAMPLE_INTERLEAVED"]

_LARGEST_SAMPLE = 1e30
"""Reals beyond this are no measurements: special constants are near the largest real."""


@dataclass(frozen=True, kw_only=True)
class ImageLayout:
    """Where the samples of an image are, and how they are written."""

    file: Path
    """The file with the samples; another than the label's where the label is detached."""
    entry: str = "^IMAGE"
    """The entry of the label that says where they are, for errors."""
    offset_bytes: int
    """Offset of the first line from the start of that file."""
    width_px: int
    height_px: int
    bands: int
    dtype: np.dtype[Any]
    """One sample, with its byte order."""
    line_prefix_bytes: int = 0
    line_suffix_bytes: int = 0
    storage: Storage
    factor: float = 1.0
    """What stored samples are multiplied with, before `shift` is added."""
    shift: float = 0.0

    @property
    def line_bytes(self) -> int:
        """Bytes of one stored line, of all bands where samples are interleaved."""
        bands = self.bands if self.storage == "SAMPLE_INTERLEAVED" else 1
        samples = self.width_px * bands * self.dtype.itemsize
        return self.line_prefix_bytes + samples + self.line_suffix_bytes

    @property
    def end_bytes(self) -> int:
        """Offset of the end of the last line from the start of the file."""
        bands = 1 if self.storage == "SAMPLE_INTERLEAVED" else self.bands
        return self.offset_bytes + self.height_px * bands * self.line_bytes

    @property
    def sample_bits(self) -> int:
        """Bits of a sample as it is read: 8 or 16."""
        return 8 if self.dtype.itemsize == 1 else 16

    def require_complete(self) -> None:
        """Raise ImageError if the file is missing or shorter than its label says."""
        other = instead_of_file(self.file)
        if other is not None:
            raise ImageError(f"{self.file}: expected an image file, found {other}")
        size = self.file.stat().st_size
        if size < self.end_bytes:
            raise ImageError(
                f"{self.file}: {self.entry}: expected {self.end_bytes} bytes or more for {self.height_px} "
                f"lines of {self.width_px} samples, found {size}: the file is truncated"
            )

    def samples(self, no_data: tuple[float, ...]) -> NDArray[Any]:
        """All samples as (bands, rows, columns); 0 where a stored sample is `no_data` or not finite.

        They have the stored type, but where the label scales them, which makes them reals.
        Raises ImageError for a file shorter than its label says.
        """
        self.require_complete()
        size = self.end_bytes - self.offset_bytes
        raw = np.fromfile(self.file, dtype=np.uint8, count=size, offset=self.offset_bytes)
        lines = raw.reshape(-1, self.line_bytes)
        stop = self.line_bytes - self.line_suffix_bytes
        values: NDArray[Any] = np.ascontiguousarray(lines[:, self.line_prefix_bytes : stop]).view(self.dtype)
        stored = self._by_band(values)
        absent = np.isin(stored, no_data)
        if stored.dtype.kind == "f":
            absent |= ~(np.abs(stored) < _LARGEST_SAMPLE)
        if (self.factor, self.shift) != (1.0, 0.0):
            stored = np.where(absent, 0, stored) * self.factor + self.shift
        return np.where(absent, stored.dtype.type(0), stored)

    def _by_band(self, values: NDArray[Any]) -> NDArray[Any]:
        height, width, bands = self.height_px, self.width_px, self.bands
        if self.storage == "SAMPLE_INTERLEAVED":
            return np.asarray(values.reshape(height, width, bands).transpose(2, 0, 1))
        if self.storage == "LINE_INTERLEAVED":
            return np.asarray(values.reshape(height, bands, width).transpose(1, 0, 2))
        return values.reshape(bands, height, width)


def require_sides(where: str, names: str, height_px: int, width_px: int, bands: int) -> None:
    """Raise ImageError for an image without samples, or with more than `MAX_PIXELS`.

    `where` and `names` are the file with its group and the three entries, as the sentence names them.
    """
    if min(width_px, height_px, bands) < 1 or width_px * height_px * bands > MAX_PIXELS:
        raise ImageError(
            f"{where}: {names}: expected 1 or more of each and at most {MAX_PIXELS} in all, "
            f"found {height_px}, {width_px}, {bands}"
        )
