"""What files and conversions must know of a camera model; each model's module fills in one `Lens`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pancam_graph.base.geometry import FloatArray

__all__ = ["MOUNT", "Distorted", "Distortion", "Lens", "LensField", "linear_vectors"]

CameraT = TypeVar("CameraT")

_Vector: TypeAlias = tuple[float, float, float]
Distorted: TypeAlias = tuple[bool, _Vector, tuple[_Vector, _Vector, _Vector], _Vector]
"""What a compiled distortion returns: whether the ray is in the model's domain; the distorted ray; its
derivative by the ray, by rows; and its derivative by w."""


@dataclass(frozen=True, kw_only=True)
class LensField:
    """One entry of a camera in `traverse.json`."""

    key: str
    """Name of the entry in the file, with its unit."""
    attribute: str = ""
    """Name of the camera's attribute that the entry holds; empty for a mount."""
    kind: Literal["number", "vector", "mount"] = "number"
    """A number, a list of numbers, or the pose of the camera on the head."""
    length: int = 1
    """How many numbers a vector has."""
    default: float | None = None
    """Value of a number that the file leaves out; None: the file must have it."""

    def of(self, camera: Any) -> float | list[float]:
        """The entry's value for a camera."""
        value = getattr(camera, self.attribute)
        return float(value) if self.kind == "number" else [float(number) for number in value]


MOUNT = LensField(key="head_T_camera", kind="mount")
"""The pose of the camera on the head, for a model whose numbers do not say it."""


@dataclass(frozen=True, kw_only=True)
class Distortion(Generic[CameraT]):
    """The projection of a camera model in compiled loops: what it does to rays before K takes them to pixels.

    A ray (d, w) is a homogeneous point in the camera's own frame: the point d / w, and a direction where w is
    0. A factor above 0 on both changes no pixel. K times the distorted ray is the homogeneous pixel.
    """

    length: int
    """How many parameters there are."""
    parameters: Callable[[CameraT], ArrayLike]
    """(length,) parameters of a camera; its K is not among them."""
    distort: Callable[[FloatArray, int, float, float, float, float], Distorted]
    """Compiled (`base.compiled.uncounted.part`): takes a table (lenses, length or more), its row, the ray's d
    and w. Outside the model's domain all that it returns is finite and means nothing. The distorted ray may
    have any length that does not vanish; derivatives are those of what is returned."""


@dataclass(frozen=True, kw_only=True)
class Lens(Generic[CameraT]):
    """A camera model as files and conversions know it."""

    name: str
    """The value of `model` in files."""
    camera: type[CameraT]
    """The class itself; a subclass is another model and needs a lens of its own."""
    fields: tuple[LensField, ...]
    """The entries of the model, in the order of the file. Without `MOUNT` among them, the vectors of the
    camera are written in the head frame and so say where the camera sits."""
    cahv_vectors: Callable[[CameraT], Mapping[str, Any]]
    """The same camera as arguments of the CAHV family, in the camera's own frame: the vectors C, A, H, V, for
    CAHVOR also O and R, for CAHVORE also E and `linearity`. Raises CameraError saying why there are none."""
    distortion: Distortion[CameraT] | None
    """The projection in compiled loops; None for a model that K alone describes."""

    @property
    def in_head_frame(self) -> bool:
        """Whether files hold the camera's vectors in the head frame instead of a mount."""
        return MOUNT not in self.fields

    def attributes(self) -> tuple[str, ...]:
        """Names of the camera's attributes that the fields hold."""
        return tuple(field.attribute for field in self.fields if field != MOUNT)


def linear_vectors(calibration: FloatArray) -> dict[str, FloatArray]:
    """C, A, H and V of a pinhole with the calibration matrix K (3, 3): C is 0; H, V, A are its rows."""
    h, v, a = calibration
    return {"C": np.zeros(3), "A": a, "H": h, "V": v}
