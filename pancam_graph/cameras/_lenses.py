"""The camera models there are. To add one: a module with its class and its `Lens`, and a line in `LENSES`."""

from collections.abc import Mapping
from typing import Any

from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras._brown import BROWN_LENS
from pancam_graph.cameras._cahv import CAHV, CAHV_LENS
from pancam_graph.cameras._cahvor import CAHVOR, CAHVOR_LENS
from pancam_graph.cameras._cahvore import CAHVORE, CAHVORE_LENS
from pancam_graph.cameras._camera import PINHOLE_LENS, Camera
from pancam_graph.cameras._lens import Lens

__all__ = ["CAHVORE_TYPES", "LENSES", "as_cahv", "cahv_of_vectors", "cahvore_linearity", "lens_of"]

LENSES: tuple[Lens[Any], ...] = (PINHOLE_LENS, BROWN_LENS, CAHV_LENS, CAHVOR_LENS, CAHVORE_LENS)
"""All camera models, in the order in which error messages name them."""


def lens_of(camera: Camera) -> Lens[Any]:
    """The lens of a camera's own class.

    Raises CameraError for a class that is not among `LENSES`, also for a subclass of one that is: files
    would lose what the subclass adds.
    """
    for lens in LENSES:
        if lens.camera is type(camera):
            return lens
    *names, last = (lens.name for lens in LENSES)
    raise CameraError(f"expected {', '.join(names)} or {last}, found {type(camera).__name__}")


def as_cahv(camera: Camera) -> CAHV:
    """The same camera as a model of the CAHV family, vectors in the camera's own frame.

    A camera of the family is equal to its original. A pinhole is a CAHV, a Brown lens with k1 and k2 alone a
    CAHVOR.

    Raises CameraError for a camera of which the family has no equal, as a Brown lens with p1, p2 or k3, and
    as `lens_of` does.
    """
    vectors = dict(lens_of(camera).cahv_vectors(camera))
    linearity = vectors.pop("linearity", 1.0)
    return cahv_of_vectors(camera.width_px, camera.height_px, vectors, linearity)


CAHVORE_TYPES = (1, 2, 3)
"""Types of a CAHVORE: perspective, fish-eye, and general."""


def cahvore_linearity(kind: int, parameter: float) -> float:
    """Linearity of a CAHVORE by its type, one of `CAHVORE_TYPES`; `parameter` is that of a general one."""
    return {1: 1.0, 2: 0.0, 3: parameter}[kind]


def cahv_of_vectors(
    width_px: int, height_px: int, vectors: Mapping[str, FloatArray], linearity: float = 1.0
) -> CAHV:
    """The model whose vectors, each (3,), these are by letter: CAHV, with O and R CAHVOR, with E CAHVORE.

    `linearity` is CAHVORE's. Raises CameraError for vectors that make no camera.
    """
    by_letter = dict(vectors)
    if "E" in by_letter:
        return CAHVORE(width_px=width_px, height_px=height_px, linearity=linearity, **by_letter)
    return (CAHVOR if "R" in by_letter else CAHV)(width_px=width_px, height_px=height_px, **by_letter)
