"""Pictures of a traverse: from the row of an image to its samples, and which pictures are the same."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.data import Tile, Traverse
from pancam_graph.io._file_memory import FileMemory
from pancam_graph.io._image_files import GreyImage, ImageContent, read_content
from pancam_graph.io._looks import Look, look_of, same_looks
from pancam_graph.io._picture_size import WantedSize

__all__ = [
    "left_out",
    "picture_file",
    "picture_look",
    "read_picture",
    "readable_picture",
    "same_pictures",
]

_NAMED = 5
_LOOKS = FileMemory[Look]()
"""Looks of files that were decoded, so that equal pictures are told without decoding again."""


def picture_file(traverse: Traverse, row: int) -> Path | None:
    """Where the file of an image is, of tiles the first; None if it has none."""
    file = traverse.images[row].file
    return None if file is None else (traverse.folder or Path()) / file


def read_picture(traverse: Traverse, row: int) -> ImageContent:
    """Decode the file of an image; see `read_image`.

    Tiles are put in their places; the image is 0, which means missing, where there is none.

    Raises ImageError as `read_image` does, for an image without a file, for one of another size than its
    camera's: a rig (most often a template) for another product, subframe or zoom; and for a tile that
    reaches beyond its camera's picture.
    """
    path, eye = picture_file(traverse, row), traverse.rig.eyes[int(traverse.image_eye[row])]
    image = traverse.images[row]
    if path is None:
        raise ImageError(f"image {image.id}: expected an image file, found none")
    width_px, height_px = eye.camera.width_px, eye.camera.height_px
    words = f"{width_px} x {height_px} pixels as of camera {eye.name} of the rig {traverse.rig.name}"
    size = WantedSize(width_px=width_px, height_px=height_px, words=words)
    folder = traverse.folder or Path()
    content = _tiled(folder, image.tiles, size) if image.tiles else read_content(path, size)
    if _known_look(traverse, row) is None:
        _LOOKS.keep(path, look_of(content), [folder / name for name in image.files])
    return content


def picture_look(traverse: Traverse, row: int) -> Look:
    """What is kept of the picture of an image; a file that was decoded before is not decoded again.

    Raises as `read_picture` does.
    """
    look = _known_look(traverse, row)
    if look is None:
        content = read_picture(traverse, row)
        look = _known_look(traverse, row) or look_of(content)  # the file may have changed since
    return look


def _known_look(traverse: Traverse, row: int) -> Look | None:
    """The look of an image whose file was decoded before, for a camera of this size, and has not changed."""
    path, camera = picture_file(traverse, row), traverse.rig.eyes[int(traverse.image_eye[row])].camera
    look = None if path is None else _LOOKS.recall(path)
    return look if look is not None and look.shape == (camera.height_px, camera.width_px) else None


def _tiled(folder: Path, tiles: Sequence[Tile], size: WantedSize) -> ImageContent:
    """The image that tiles make, 16 bits where one of them has 16; a later tile lies on those before."""
    read: list[ImageContent] = []
    for tile in tiles:
        path = folder / tile.file
        content = read_content(path)
        height_px, width_px = content.samples.shape
        if tile.left_px + width_px > size.width_px or tile.top_px + height_px > size.height_px:
            raise ImageError(
                f"{path}: expected a tile of {size.words}, found {width_px} x {height_px} from column "
                f"{tile.left_px} and row {tile.top_px} on"
            )
        read.append(content)
    samples: GreyImage = np.zeros(
        (size.height_px, size.width_px), dtype=np.result_type(*(content.samples.dtype for content in read))
    )
    for tile, content in zip(tiles, read, strict=True):
        height_px, width_px = content.samples.shape
        samples[tile.top_px : tile.top_px + height_px, tile.left_px : tile.left_px + width_px] = (
            content.samples
        )
    return ImageContent(samples=samples, colour=any(content.colour for content in read), host=read[0].host)


def readable_picture(traverse: Traverse, row: int) -> GreyImage | None:
    """The samples of an image; None without a file, or with one that cannot be read any more.

    Reading the traverse has refused broken files; a file that broke during a solve must not cost its results.
    """
    try:
        return read_picture(traverse, row).samples
    except (ImageError, OSError):
        return None


def same_pictures(traverse: Traverse) -> dict[int, int]:
    """Rows of images whose picture is the same as that of an image before, and the first such row.

    See `same_looks` for what is the same. Files that were decoded before and have not changed are not decoded
    again; files that cannot be read are the same as no other.
    """
    looks: dict[int, Look] = {}
    for row in range(len(traverse.images)):
        try:
            looks[row] = picture_look(traverse, row)
        except (ImageError, OSError):
            continue  # it has no file, or one that cannot be read any more
    return same_looks(traverse, looks)


def left_out(errors: Mapping[str, InputError]) -> list[str]:
    """Warnings of images, by id, whose files cannot be used: the first five, and a count of the others."""
    named = [f"image {name} is left out: {error}" for name, error in list(errors.items())[:_NAMED]]
    more = len(errors) - _NAMED
    if more > 0:
        named.append(f"{more} more images are left out, whose files cannot be used either")
    return named
