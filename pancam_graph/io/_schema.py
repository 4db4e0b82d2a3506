"""The file formats as pydantic models: what may stand in `traverse.json` and `solution.json`.

Keys and units are those of the file contract. Every model is strict: no unknown key, no number in a
string, nothing that is not finite. References between entries are the data model's business.
"""

import math
from dataclasses import fields
from typing import Annotated, Any, Literal

import gtsam
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag

from pancam_graph.base.errors import GeometryError, InputError
from pancam_graph.base.geometry import pose_from_wxyz, wxyz_from_rotation
from pancam_graph.cameras import CAHV, CAHVOR, CAHVORE, Brown, Camera, Pinhole
from pancam_graph.data import Freedom, Sharing
from pancam_graph.io._json import prefixed
from pancam_graph.rigs import Eye, Rig, rig_template

__all__ = [
    "MOSAIC_FORMAT",
    "SOLUTION_FORMAT",
    "TRAVERSE_FORMAT",
    "VERSION",
    "CameraEntry",
    "FrameEntry",
    "ImageEntry",
    "OwnRigEntry",
    "PoseEntry",
    "SharingEntry",
    "StopEntry",
    "TemplateRigEntry",
    "TraverseFile",
    "camera_entry",
    "rig_entry",
]

TRAVERSE_FORMAT = "pancam-graph/traverse"
SOLUTION_FORMAT = "pancam-graph/solution"
MOSAIC_FORMAT = "pancam-graph/mosaics"
VERSION = 1

Text = Annotated[str, Field(min_length=0)]
"""Any string that can be written in UTF-8: a constraint makes pydantic look for halves of characters."""
Label = Annotated[str, Field(pattern=r"^[^\p{Cc}\p{Zl}\p{Zp}]+$")]
"""An id, a name or a path: not empty, and without control characters, which would break lines and tables."""
Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]


class Entry(BaseModel):
    """What all entries have in common."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


class PoseEntry(Entry):
    """A pose: quaternion (w, x, y, z), of any length but 0, and translation in metres."""

    rotation_wxyz: Annotated[list[float], Field(min_length=4, max_length=4)]
    translation_m: Vector3

    @staticmethod
    def of(pose: gtsam.Pose3) -> "PoseEntry":
        """The entry of a pose."""
        return PoseEntry(
            rotation_wxyz=wxyz_from_rotation(pose.rotation().matrix()).tolist(),
            translation_m=pose.translation().tolist(),
        )

    def pose(self, where: str) -> gtsam.Pose3:
        """The pose. Raises InputError naming `where` for a quaternion of norm 0."""
        try:
            return pose_from_wxyz(self.rotation_wxyz, self.translation_m)
        except GeometryError as error:
            raise InputError(
                f"{where}.rotation_wxyz: expected numbers of finite norm above 0, found {self.rotation_wxyz}"
            ) from error


class PinholeEntry(Entry):
    """A pinhole camera and how it sits on the head."""

    name: Label
    width_px: int
    height_px: int
    model: Literal["pinhole"]
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    skew_px: float = 0.0
    head_T_camera: PoseEntry

    def camera(self) -> Camera:
        """The camera in its own frame. Raises CameraError."""
        return Pinhole(**self.model_dump(exclude={"name", "model", "head_T_camera"}))

    def eye(self, where: str) -> Eye:
        """The eye. Raises InputError naming `where`."""
        with prefixed(where):
            camera = self.camera()
        return Eye(
            name=self.name, camera=camera, head_T_camera=self.head_T_camera.pose(f"{where}.head_T_camera")
        )


class BrownEntry(PinholeEntry):
    """A pinhole camera with distortion k1, k2, p1, p2, k3 in OpenCV's sense."""

    model: Literal["brown"]  # type: ignore[assignment]  # the tag of each model is another literal
    distortion: Annotated[list[float], Field(min_length=5, max_length=5)]

    def camera(self) -> Camera:
        """The camera in its own frame. Raises CameraError."""
        numbers = self.model_dump(exclude={"name", "model", "head_T_camera", "distortion"})
        k1, k2, p1, p2, k3 = self.distortion
        return Brown(**numbers, distortion=(k1, k2, p1, p2, k3))


class CAHVEntry(Entry):
    """A CAHV camera, its vectors in the head frame."""

    name: Label
    width_px: int
    height_px: int
    model: Literal["cahv"]
    C_m: Vector3
    A: Vector3
    H_px: Vector3
    V_px: Vector3

    def head_model(self) -> CAHV:
        """The camera with its vectors in the head frame. Raises CameraError."""
        return CAHV(**self._arguments())

    def _arguments(self) -> dict[str, Any]:
        names = {"C_m": "C", "H_px": "H", "V_px": "V"}
        return {names.get(k, k): v for k, v in self.model_dump(exclude={"name", "model"}).items()}

    def eye(self, where: str) -> Eye:
        """The eye. Raises InputError naming `where`."""
        with prefixed(where):
            return Eye.from_head_model(self.name, self.head_model())


class CAHVOREntry(CAHVEntry):
    """A CAHVOR camera, its vectors in the head frame."""

    model: Literal["cahvor"]  # type: ignore[assignment]  # the tag of each model is another literal
    O: Vector3  # noqa: E741  the literature's name of the optical axis
    R: Vector3

    def head_model(self) -> CAHV:
        """The camera with its vectors in the head frame. Raises CameraError."""
        return CAHVOR(**self._arguments())


class CAHVOREEntry(CAHVOREntry):
    """A CAHVORE camera, its vectors in the head frame; E in metres."""

    model: Literal["cahvore"]  # type: ignore[assignment]  # the tag of each model is another literal
    E: Vector3
    linearity: float

    def head_model(self) -> CAHV:
        """The camera with its vectors in the head frame. Raises CameraError."""
        return CAHVORE(**self._arguments())


def _camera_tag(value: Any) -> str:
    model = value.get("model") if isinstance(value, dict) else getattr(value, "model", None)
    return f"<{model}>"


CameraEntry = Annotated[
    Annotated[PinholeEntry, Tag("<pinhole>")]
    | Annotated[BrownEntry, Tag("<brown>")]
    | Annotated[CAHVEntry, Tag("<cahv>")]
    | Annotated[CAHVOREntry, Tag("<cahvor>")]
    | Annotated[CAHVOREEntry, Tag("<cahvore>")],
    Discriminator(_camera_tag),
]
"""A camera of any model; `model` says which."""


class TemplateRigEntry(Entry):
    """A rig that ships with the package."""

    template: Label

    def rig(self) -> Rig:
        """The rig. Raises InputError for an unknown template."""
        with prefixed("rig"):
            return rig_template(self.template)


class OwnRigEntry(Entry):
    """A rig of the user's own."""

    name: Text = "own rig"
    pan_T_tilt: PoseEntry
    cameras: list[CameraEntry]

    def rig(self) -> Rig:
        """The rig. Raises InputError naming the entry."""
        pan_T_tilt = self.pan_T_tilt.pose("rig.pan_T_tilt")
        eyes = tuple(c.eye(f"rig.cameras[{i}]") for i, c in enumerate(self.cameras))
        return Rig(name=self.name, pan_T_tilt=pan_T_tilt, eyes=eyes)


def _rig_tag(value: Any) -> str:
    template = isinstance(value, TemplateRigEntry) or (isinstance(value, dict) and "template" in value)
    return "<template>" if template else "<own>"


class StopEntry(Entry):
    """One place of the mast."""

    id: Label
    world_T_mast: PoseEntry
    sigma_rotation_rad: float
    sigma_translation_m: float


class FrameEntry(Entry):
    """One pointing of the head."""

    id: Label
    stop: Label
    pan_rad: float
    tilt_rad: float
    sigma_pan_rad: float
    sigma_tilt_rad: float


class ImageEntry(Entry):
    """One eye's picture of a frame."""

    id: Label
    frame: Label
    camera: Label
    file: Label | None = None
    mask: Label | None = None


class FreedomEntry(Entry):
    """How free a quantity of the rig is."""

    scope: str
    free: list[str] | None = None
    sigma: dict[str, float | None] = {}
    """Of the priors; null: none."""

    def freedom(self) -> Freedom:
        """The freedom. `Sharing` checks it."""
        sigma = {name: math.inf if value is None else value for name, value in self.sigma.items()}
        return Freedom(
            scope=self.scope,  # type: ignore[arg-type]  # checked by Sharing
            free=None if self.free is None else tuple(self.free),
            sigma=sigma,
        )

    @staticmethod
    def of(freedom: Freedom | None) -> "FreedomEntry | None":
        """The entry of a freedom."""
        if freedom is None:
            return None
        sigma = {name: value if math.isfinite(value) else None for name, value in freedom.sigma.items()}
        free = None if freedom.free is None else list(freedom.free)
        return FreedomEntry(scope=freedom.scope, free=free, sigma=sigma)


class SharingEntry(Entry):
    """What of the rig is free, and who shares it."""

    calibration: FreedomEntry | None = None
    mounts: FreedomEntry | None = None
    pan_T_tilt: FreedomEntry | None = None
    radius: FreedomEntry | None = None

    def sharing(self) -> Sharing:
        """The sharing. Raises InputError for what contradicts itself."""
        given = {field.name: getattr(self, field.name) for field in fields(Sharing)}
        return Sharing(**{name: entry.freedom() for name, entry in given.items() if entry is not None})

    @staticmethod
    def of(sharing: Sharing) -> "SharingEntry":
        """The entry of a sharing; it names what is not as it would be without."""
        quantities = [field.name for field in fields(Sharing)]
        given = {name: FreedomEntry.of(getattr(sharing, name)) for name in quantities}
        usual = {name: FreedomEntry.of(getattr(Sharing(), name)) for name in quantities}
        return SharingEntry(**{name: entry for name, entry in given.items() if entry != usual[name]})


class TraverseFile(Entry):
    """`traverse.json`."""

    format: Literal["pancam-graph/traverse"] = "pancam-graph/traverse"
    version: Literal[1] = 1
    name: Text | None = None
    rig: Annotated[
        Annotated[TemplateRigEntry, Tag("<template>")] | Annotated[OwnRigEntry, Tag("<own>")],
        Discriminator(_rig_tag),
    ]
    stops: list[StopEntry]
    frames: list[FrameEntry]
    images: list[ImageEntry]
    observations: Label | None
    sharing: SharingEntry | None = None


def camera_entry(eye: Eye) -> CameraEntry:
    """The entry of an eye; a model of the CAHV family is turned to the head frame.

    Raises InputError for a camera model that the format does not know.
    """
    camera = eye.camera
    size: dict[str, Any] = {"name": eye.name, "width_px": camera.width_px, "height_px": camera.height_px}
    if isinstance(camera, Pinhole):
        numbers: dict[str, Any] = {
            k: float(getattr(camera, k)) for k in ("fx_px", "fy_px", "cx_px", "cy_px", "skew_px")
        }
        mount = PoseEntry.of(eye.head_T_camera)
        if isinstance(camera, Brown):
            distortion = [float(k) for k in camera.distortion]
            return BrownEntry(model="brown", **size, **numbers, head_T_camera=mount, distortion=distortion)
        return PinholeEntry(model="pinhole", **size, **numbers, head_T_camera=mount)
    if isinstance(camera, CAHV):
        head = eye.head_model()
        vectors: dict[str, Any] = {
            "C_m": head.C.tolist(),
            "A": head.A.tolist(),
            "H_px": head.H.tolist(),
            "V_px": head.V.tolist(),
        }
        if isinstance(head, CAHVOR):
            vectors |= {"O": head.O.tolist(), "R": head.R.tolist()}
        if isinstance(head, CAHVORE):
            vectors |= {"E": head.E.tolist(), "linearity": float(head.linearity)}
            return CAHVOREEntry(model="cahvore", **size, **vectors)
        if isinstance(head, CAHVOR):
            return CAHVOREntry(model="cahvor", **size, **vectors)
        return CAHVEntry(model="cahv", **size, **vectors)
    raise InputError(
        f"camera {eye.name}: expected pinhole, brown, cahv, cahvor or cahvore, found {type(camera).__name__}"
    )


def rig_entry(rig: Rig) -> OwnRigEntry:
    """The entry of a rig, with its own numbers even where a template made it.

    So the file says the same with every version of the package. What only simulations and drawings use
    (the mast's height) and the sources are not in the format.
    """
    return OwnRigEntry(
        name=rig.name,
        pan_T_tilt=PoseEntry.of(rig.pan_T_tilt),
        cameras=[camera_entry(e) for e in rig.eyes],
    )
