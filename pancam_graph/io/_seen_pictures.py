"""Pictures that a rig was calibrated with: used once more with that rig, they would count twice."""

import hashlib

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.regular_files import instead_of_file
from pancam_graph.data import Traverse
from pancam_graph.io._json import read_bytes
from pancam_graph.rigs import Rig

__all__ = ["picture_digests", "require_other_pictures"]


def picture_digests(traverse: Traverse) -> list[str]:
    """A digest of each image: of its file, or where there is none, of its observations; "" without either.

    The same picture in another file, as another product of one exposure, has another digest.
    """
    return [_of_file(traverse, row) or _of_observations(traverse, row) for row in range(len(traverse.images))]


def require_other_pictures(traverse: Traverse, rig: Rig) -> None:
    """Raise InputError where a rig was calibrated with pictures of a traverse."""
    covariance = rig.uncertainty.covariance
    if covariance is None or not covariance.pictures:
        return
    known = set(covariance.pictures)
    digests = zip(traverse.images, picture_digests(traverse), strict=True)
    twice = [image.id for image, digest in digests if digest in known]
    if twice:
        more = f" and {len(twice) - 1} more" if len(twice) > 1 else ""
        raise InputError(
            f"pictures: expected others than those that the rig was calibrated with, found {twice[0]}{more}: "
            "what they say would count twice"
        )


def _of_file(traverse: Traverse, row: int) -> str:
    names = traverse.images[row].files
    if not names or traverse.folder is None:
        return ""
    paths = [traverse.folder / name for name in names]
    if any(instead_of_file(path) is not None for path in paths):
        return ""
    try:
        return f"file:{hashlib.sha256(b''.join(map(read_bytes, paths))).hexdigest()}"
    except InputError:  # a file that cannot be read is left out by who needs it
        return ""


def _of_observations(traverse: Traverse, row: int) -> str:
    if traverse.observations is None:
        return ""
    uv_px = traverse.observations.uv_px[traverse.observations.image == row]
    if not len(uv_px):
        return ""
    ordered = np.ascontiguousarray(uv_px[np.lexsort(uv_px.T)], dtype="<f8")
    return f"points:{hashlib.sha256(ordered.tobytes()).hexdigest()}"
