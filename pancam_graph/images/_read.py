"""The image files of a traverse with the user's masks: what is odd about them, and their samples."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.geometry import BoolArray
from pancam_graph.data import Traverse
from pancam_graph.images._cache import digest
from pancam_graph.images._held import Held
from pancam_graph.io import (
    GreyImage,
    left_out,
    mask_file,
    picture_file,
    picture_look,
    read_mask,
    read_picture,
    same_pictures,
    samples_digest,
)

__all__ = ["PictureFiles", "Pictures", "for_workers", "image_name", "listed", "read_pictures"]

_NAMED = 3
_HELD_BYTES = 128 << 20
_HELD_MASK_BYTES = 32 << 20


@dataclass(frozen=True, kw_only=True, eq=False)
class Pictures:
    """What is known of the image files and the user's masks without their samples; by rows."""

    digests: tuple[bytes | None, ...]
    """Of all samples. None without a file that can be used, or where a file before it is the same picture."""
    masks: tuple[Path | None, ...]
    """The user's masks; None: there is none, or no picture."""
    mask_digests: tuple[str | None, ...]
    warnings: tuple[str, ...]
    """Of files that cannot be used, of colour, and of pictures that are there twice."""
    unusable: Mapping[int, ImageError]
    """Why the file of an image cannot be used, by row."""

    def has(self, row: int) -> bool:
        """Whether there is a picture of an image."""
        return self.digests[row] is not None


class PictureFiles:
    """Samples of images and the user's masks, read when they are asked for; the latest are held.

    Several threads may ask at once.
    """

    def __init__(self, traverse: Traverse, pictures: Pictures) -> None:
        """Pictures and masks are those that were found in the files of the traverse."""
        self._traverse = traverse
        self._pictures = pictures
        self._samples = Held[int, GreyImage](_HELD_BYTES, _n_bytes)
        self._masks = Held[tuple[Path, int, int], BoolArray](_HELD_MASK_BYTES, _n_bytes)

    def samples(self, row: int) -> GreyImage:
        """Samples (height, width) of an image that has a picture, not to be written to.

        Raises ImageError for a file that is no longer what it was.
        """
        return self._samples.get(row, lambda: self._read(row))

    def _read(self, row: int) -> GreyImage:
        samples = read_picture(self._traverse, row).samples
        if samples_digest(samples) != self._pictures.digests[row]:
            raise ImageError(
                f"{picture_file(self._traverse, row)}: expected the picture that was there at the beginning, "
                "found another one: the file was changed meanwhile"
            )
        return samples

    def user_mask(self, row: int) -> BoolArray | None:
        """Where the user's mask of an image is white, (height, width); None: there is none.

        Raises ImageError for a file that is no longer what it was.
        """
        path = self._pictures.masks[row]
        if path is None:
            return None
        camera = self._traverse.rig.eyes[int(self._traverse.image_eye[row])].camera

        def read() -> BoolArray:
            mask = _mask_of(self._traverse, row, path)
            if digest(mask) != self._pictures.mask_digests[row]:
                raise ImageError(
                    f"{path}: expected the mask that was there at the beginning, found another one: the file "
                    "was changed meanwhile"
                )
            return mask

        return self._masks.get((path, camera.width_px, camera.height_px), read)


def read_pictures(traverse: Traverse, progress: Callable[[int, int], None] | None = None) -> Pictures:
    """Decode all image files of a traverse, and the masks that belong to them, once and one by one.

    Files that this process has decoded before, and that have not changed since, are not decoded again.

    A file that is missing, cannot be read or has another size than its camera is warned of. Raises InputError
    if no image has a file, ImageError naming the file if none can be used, and for a mask that cannot: what
    it covers must not be used.
    """
    if all(image.file is None for image in traverse.images):
        raise InputError(f"traverse {traverse.name}: expected observations or image files, found neither")
    digests: list[bytes | None] = []
    coloured: list[str] = []
    unusable: dict[int, ImageError] = {}
    for row, entry in enumerate(traverse.images):
        look = None
        try:
            look = picture_look(traverse, row) if entry.file else None
        except ImageError as error:
            unusable[row] = error
        if entry.file and look and look.colour:
            coloured.append(entry.file)
        digests.append(None if look is None else look.digest)
        if progress is not None:
            progress(row + 1, len(traverse.images))
    same, warnings = same_pictures(traverse), list[str]()
    for row, first in same.items():
        digests[row] = None
        warnings.append(
            f"image {image_name(traverse, row)}: the same picture as image "
            f"{image_name(traverse, first)}; left out"
        )
    masks = tuple(None if known is None else mask_file(traverse, row) for row, known in enumerate(digests))
    mask_digests = _mask_digests(traverse, masks)
    if unusable and len(unusable) == sum(entry.file is not None for entry in traverse.images):
        raise next(iter(unusable.values()))
    warnings[:0] = left_out({traverse.images[row].id: error for row, error in unusable.items()})
    if coloured:
        warnings.insert(0, f"images in colour, of which the luma is used: {listed(coloured)}")
    return Pictures(
        digests=tuple(digests),
        masks=masks,
        mask_digests=mask_digests,
        warnings=tuple(warnings),
        unusable=unusable,
    )


def _mask_digests(traverse: Traverse, masks: Sequence[Path | None]) -> tuple[str | None, ...]:
    """The digest of each image's mask; a mask of many images is read once."""
    known: dict[tuple[Path, int, int], str] = {}
    digests: list[str | None] = []
    for row, path in enumerate(masks):
        if path is None:
            digests.append(None)
            continue
        camera = traverse.rig.eyes[int(traverse.image_eye[row])].camera
        key = path, camera.width_px, camera.height_px
        if key not in known:
            known[key] = digest(_mask_of(traverse, row, path))
        digests.append(known[key])
    return tuple(digests)


def _mask_of(traverse: Traverse, row: int, path: Path) -> BoolArray:
    camera = traverse.rig.eyes[int(traverse.image_eye[row])].camera
    name = Path(str(traverse.images[row].file)).name
    return read_mask(path, camera.width_px, camera.height_px, name)


def _n_bytes(array: NDArray[Any]) -> int:
    return array.nbytes


def image_name(traverse: Traverse, row: int) -> str:
    """An image as warnings name it: its id, and its file where the id does not say it."""
    image = traverse.images[row]
    return image.id if image.file is None else f"{image.id} ({image.file})"


def listed(names: Sequence[str]) -> str:
    """A few names, and how many more there are."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def for_workers(traverse: Traverse) -> Traverse:
    """What other processes need of a traverse to work on its pictures, wherever they run.

    That is without observations and what they say.
    """
    return replace(
        traverse,
        folder=(traverse.folder or Path()).resolve(),
        observations=None,
        matching=None,
        constraints=(),
        points=None,
        warnings=(),
    )
