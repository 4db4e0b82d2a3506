"""What decoding an uncompressed image needs of its label; kept, so that each label is parsed once."""

from dataclasses import dataclass

from pancam_graph.io._file_memory import FileMemory
from pancam_graph.io._image_layout import ImageLayout

__all__ = ["STORED_IMAGES", "StoredImage"]


@dataclass(frozen=True, kw_only=True)
class StoredImage:
    """What decoding an image needs of its label."""

    layout: ImageLayout
    no_data: tuple[float, ...]
    """Values that stand for missing or invalid samples."""
    host: str | None
    """The spacecraft, if the label names it."""


STORED_IMAGES = FileMemory[StoredImage]()
"""By the image's file."""
