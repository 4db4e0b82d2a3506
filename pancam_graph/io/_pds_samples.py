"""Samples of PDS image files. Of each file's label, what decoding needs is kept: it is parsed once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.io._file_memory import FileMemory
from pancam_graph.io._pds_label import ImageLayout, PdsLabel, read_label

__all__ = ["PdsImage", "image_of_label", "read_pds_image", "read_samples"]


@dataclass(frozen=True, kw_only=True)
class PdsImage:
    """What decoding a PDS image needs of its label."""

    layout: ImageLayout
    no_data: tuple[float, ...]
    """Values that stand for missing or invalid samples."""
    host: str | None
    """The spacecraft, if the label names it."""


_IMAGES = FileMemory[PdsImage]()


def image_of_label(label: PdsLabel) -> PdsImage:
    """What a label says of its image; kept, so that decoding the file does not parse the label again.

    Raises ImageError for a label without an image, or with samples that are not integers of 8 or 16 bits.
    """
    layout = label.image_layout()
    host = label.top.items.get("INSTRUMENT_HOST_ID")
    image = PdsImage(
        layout=layout,
        no_data=_no_data(label),
        host=None if host is None else label.top.text("INSTRUMENT_HOST_ID").upper(),
    )
    _IMAGES.keep(label.file, image, made_from=[label.label_file])
    return image


def read_pds_image(file: Path) -> PdsImage:
    """What decoding a file needs of its label, attached or beside it; the label is parsed if it is new.

    Raises ImageError for a label that cannot be read, and as `image_of_label` does.
    """
    image = _IMAGES.recall(file)
    if image is None:
        try:
            image = image_of_label(read_label(file))
        except ImageError:
            raise
        except InputError as error:
            raise ImageError(str(error)) from error
    return image


def read_samples(image: PdsImage) -> NDArray[Any]:
    """All samples as (bands, rows, columns), as they are stored; 0 where there is no data.

    Raises ImageError for a file shorter than its label says.
    """
    layout = image.layout
    layout.require_complete()
    size = layout.end_bytes - layout.offset_bytes
    raw = np.fromfile(layout.file, dtype=np.uint8, count=size, offset=layout.offset_bytes)
    lines = raw.reshape(-1, layout.line_bytes)
    stop = layout.line_bytes - layout.line_suffix_bytes
    values: NDArray[Any] = np.ascontiguousarray(lines[:, layout.line_prefix_bytes : stop]).view(layout.dtype)
    samples = _by_band(values, layout)
    return np.where(np.isin(samples, image.no_data), samples.dtype.type(0), samples)


def _by_band(values: NDArray[Any], layout: ImageLayout) -> NDArray[Any]:
    height, width, bands = layout.height_px, layout.width_px, layout.bands
    if layout.storage == "SAMPLE_INTERLEAVED":
        return np.asarray(values.reshape(height, width, bands).transpose(2, 0, 1))
    if layout.storage == "LINE_INTERLEAVED":
        return np.asarray(values.reshape(height, bands, width).transpose(1, 0, 2))
    return values.reshape(bands, height, width)


def _no_data(label: PdsLabel) -> tuple[float, ...]:
    """Values that stand for missing samples; labels that write them in another way (16#...#) mean reals."""
    image = label.group("IMAGE").items
    entries = (image.get(key) for key in ("MISSING_CONSTANT", "INVALID_CONSTANT"))
    values = [v for entry in entries for v in (entry if isinstance(entry, list | tuple) else [entry])]
    numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
    return tuple(float(v) for v in numbers if abs(v) <= np.iinfo(np.int64).max)  # no sample is beyond
