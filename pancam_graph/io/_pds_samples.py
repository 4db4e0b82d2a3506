"""What a PDS3 label says of its image's samples."""

from pathlib import Path

import numpy as np

from pancam_graph.io._pds_label import PdsLabel, read_label
from pancam_graph.io._stored_image import STORED_IMAGES, StoredImage

__all__ = ["image_of_label", "pds3_image"]


def image_of_label(label: PdsLabel) -> StoredImage:
    """What a label says of its image; kept, so that decoding the file does not parse the label again.

    Raises ImageError for a label without an image, or with samples of a type that is not read.
    """
    host = label.top.items.get("INSTRUMENT_HOST_ID")
    image = StoredImage(
        layout=label.image_layout(),
        no_data=_no_data(label),
        host=None if host is None else label.top.text("INSTRUMENT_HOST_ID").upper(),
    )
    STORED_IMAGES.keep(label.file, image, made_from=[label.label_file])
    return image


def pds3_image(file: Path) -> StoredImage:
    """What the label of a file says, attached or in a .LBL beside it.

    Raises InputError for a label that cannot be read, and as `image_of_label` does.
    """
    return image_of_label(read_label(file))


def _no_data(label: PdsLabel) -> tuple[float, ...]:
    """Values that stand for missing samples; labels that write them in another way (16#...#) mean reals."""
    image = label.group("IMAGE").items
    entries = (image.get(key) for key in ("MISSING_CONSTANT", "INVALID_CONSTANT"))
    values = [v for entry in entries for v in (entry if isinstance(entry, list | tuple) else [entry])]
    numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
    return tuple(float(v) for v in numbers if abs(v) <= np.iinfo(np.int64).max)  # no sample is beyond
