"""The image files of a traverse with the user's masks, and what is odd about them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.geometry import BoolArray
from pancam_graph.data import Traverse
from pancam_graph.io import GreyImage, left_out, mask_file, read_mask, read_picture, same_pictures

__all__ = ["Pictures", "image_name", "listed", "read_pictures"]

_NAMED = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Pictures:
    """Images as arrays, and the user's masks; by rows of the traverse."""

    images: tuple[GreyImage | None, ...]
    """None without a file that can be used, or where a file before it is the same picture."""
    user_masks: tuple[BoolArray | None, ...]
    """True where white; None: there is none."""
    warnings: tuple[str, ...]
    """Of files that cannot be used, of colour, and of pictures that are there twice."""
    unusable: Mapping[int, ImageError]
    """Why the file of an image cannot be used, by row."""


def read_pictures(traverse: Traverse, progress: Callable[[int, int], None] | None = None) -> Pictures:
    """Read all image files of a traverse and the masks that belong to them.

    A file that is missing, cannot be read or has another size than its camera is warned of. Raises InputError
    if no image has a file, ImageError naming the file if none can be used, and for a mask that cannot: what
    it covers must not be used.
    """
    if all(image.file is None for image in traverse.images):
        raise InputError(f"traverse {traverse.name}: expected observations or image files, found neither")
    images: list[GreyImage | None] = []
    coloured: list[str] = []
    unusable: dict[int, ImageError] = {}
    for row, entry in enumerate(traverse.images):
        content = None
        try:
            content = read_picture(traverse, row) if entry.file else None
        except ImageError as error:
            unusable[row] = error
        if entry.file and content and content.colour:
            coloured.append(entry.file)
        images.append(None if content is None else content.samples)
        if progress is not None:
            progress(row + 1, len(traverse.images))
    same, warnings = same_pictures(traverse), list[str]()
    for row, first in same.items():
        images[row] = None
        warnings.append(
            f"image {image_name(traverse, row)}: the same picture as image "
            f"{image_name(traverse, first)}; left out"
        )
    masks = _user_masks(traverse, images)
    if unusable and len(unusable) == sum(entry.file is not None for entry in traverse.images):
        raise next(iter(unusable.values()))
    warnings[:0] = left_out({traverse.images[row].id: error for row, error in unusable.items()})
    if coloured:
        warnings.insert(0, f"images in colour, of which the luma is used: {listed(coloured)}")
    return Pictures(
        images=tuple(images),
        user_masks=masks,
        warnings=tuple(warnings),
        unusable=unusable,
    )


def _user_masks(traverse: Traverse, images: Sequence[GreyImage | None]) -> tuple[BoolArray | None, ...]:
    """The mask of each image that is used; a mask of many images is read once."""
    read: dict[tuple[Path, tuple[int, ...]], BoolArray] = {}
    masks: list[BoolArray | None] = []
    for row, (entry, image) in enumerate(zip(traverse.images, images, strict=True)):
        path = None if image is None else mask_file(traverse, row)
        if image is None or path is None:
            masks.append(None)
            continue
        if (path, image.shape) not in read:
            height, width = image.shape
            read[path, image.shape] = read_mask(path, width, height, Path(str(entry.file)).name)
        masks.append(read[path, image.shape])
    return tuple(masks)


def image_name(traverse: Traverse, row: int) -> str:
    """An image as warnings name it: its id, and its file where the id does not say it."""
    image = traverse.images[row]
    return image.id if image.file is None else f"{image.id} ({image.file})"


def listed(names: Sequence[str]) -> str:
    """A few names, and how many more there are."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
