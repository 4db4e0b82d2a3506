"""Uncompressed image files of any format of label: which label a file has."""

from pathlib import Path

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.io._pds4_samples import pds4_image, pds4_label_of
from pancam_graph.io._pds_samples import pds3_image
from pancam_graph.io._stored_image import STORED_IMAGES, StoredImage

__all__ = ["STORED_SUFFIXES", "read_stored_image"]

STORED_SUFFIXES = frozenset({".img", ".vic", ".dat", ".raw"})
"""How files with uncompressed samples end, in small letters."""


def read_stored_image(file: Path) -> StoredImage:
    """What decoding a file needs of its label: a PDS4 label beside it, else a PDS3 label in it or beside it.

    Raises ImageError for a label that cannot be read, or with samples of a type that is not read.
    """
    image = STORED_IMAGES.recall(file)
    if image is not None:
        return image
    pds4 = pds4_label_of(file)
    try:
        return pds3_image(file) if pds4 is None else pds4_image(file, pds4)
    except ImageError:
        raise
    except InputError as error:
        raise ImageError(str(error)) from error
