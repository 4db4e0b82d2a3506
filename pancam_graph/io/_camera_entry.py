"""Cameras as entries of files: one pydantic model for each registered lens, made from its fields."""

from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Union

import numpy as np
from pydantic import Discriminator, Field, GetCoreSchemaHandler, Tag, create_model
from pydantic_core import CoreSchema

from pancam_graph.base.errors import InputError
from pancam_graph.cameras import (
    FIELD_SHAPE,
    LENSES,
    Camera,
    FieldCamera,
    Lens,
    LensField,
    lens_of,
    with_field,
    without_field,
)
from pancam_graph.io._entries import Entry, Label, PoseEntry, SparseEntry
from pancam_graph.io._json import prefixed
from pancam_graph.rigs import Eye

__all__ = ["AnyCamera", "CameraEntry", "camera_entry"]


class FieldEntry(Entry):
    """Coefficients of the smooth distortion field of a camera, by rows of the image (`cameras.Fields`)."""

    u_px: list[list[float]]
    v_px: list[list[float]]

    def on(self, lens: Camera) -> Camera:
        """A lens with this field. Raises InputError for another number of coefficients."""
        _, rows, columns = FIELD_SHAPE
        for key, table in (("u_px", self.u_px), ("v_px", self.v_px)):
            if [len(row) for row in table] != [columns] * rows:
                found = f"{len(table)} of {', '.join(str(n) for n in sorted({len(row) for row in table}))}"
                raise InputError(
                    f"field: {key}: expected {rows} rows of {columns} numbers, found {found or 'none'}"
                )
        with prefixed("field"):
            return with_field(lens, np.array([self.u_px, self.v_px]))

    @staticmethod
    def of(camera: Camera) -> "FieldEntry | None":
        """The entry of a camera's field; None where it has none."""
        if not isinstance(camera, FieldCamera):
            return None
        u_px, v_px = camera.field_px.tolist()
        return FieldEntry(u_px=u_px, v_px=v_px)


class CameraEntry(SparseEntry):
    """A camera and how it sits on the head; the other entries are those of its lens (`LENSES`)."""

    _OPTIONAL: ClassVar = frozenset({"unit", "field"})

    name: Label
    unit: Label | None = None
    """The camera that it is, among those of its kind."""
    width_px: int
    height_px: int
    model: str
    field: FieldEntry | None = None
    """Smooth distortion field on top of the lens."""

    def eye(self, where: str) -> Eye:
        """The eye. Raises InputError naming `where`."""
        lens = next(lens for lens in LENSES if lens.name == self.model)
        values = {field.attribute: getattr(self, field.key) for field in lens.fields if field.kind != "mount"}
        numbers = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
        with prefixed(where):
            camera = lens.camera(width_px=self.width_px, height_px=self.height_px, **numbers)
            if self.field is not None:
                camera = self.field.on(camera)
            if lens.in_head_frame:
                return replace(Eye.from_head_model(self.name, camera), unit=self.unit or "")
        mount = next(getattr(self, field.key) for field in lens.fields if field.kind == "mount")
        head_T_camera = mount.pose(f"{where}.head_T_camera")
        return Eye(name=self.name, camera=camera, head_T_camera=head_T_camera, unit=self.unit or "")


def _field(field: LensField) -> Any:
    """Type and default of an entry, as pydantic's `create_model` takes them."""
    if field.kind == "mount":
        return (PoseEntry, ...)
    if field.kind == "vector":
        return (Annotated[list[float], Field(min_length=field.length, max_length=field.length)], ...)
    return (float, ... if field.default is None else field.default)


def _model_of(lens: Lens[Any]) -> type[CameraEntry]:
    entries = {field.key: _field(field) for field in lens.fields}
    model: Any = Literal[lens.name]
    return create_model(f"{lens.name.upper()}Entry", __base__=CameraEntry, model=(model, ...), **entries)


_MODELS = {lens.name: _model_of(lens) for lens in LENSES}


def _tag(value: Any) -> str:
    model = value.get("model") if isinstance(value, dict) else getattr(value, "model", None)
    return f"<{model}>"


class _OfItsModel:
    """Annotation that makes pydantic validate a camera by the model that its entry `model` names."""

    def __get_pydantic_core_schema__(self, _source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        tagged = tuple(Annotated[model, Tag(f"<{name}>")] for name, model in _MODELS.items())
        return handler.generate_schema(Annotated[Union[tagged], Discriminator(_tag)])  # noqa: UP007  of a tuple


AnyCamera = Annotated[CameraEntry, _OfItsModel()]
"""A camera of any lens, as the type of an entry; `model` says which."""


def camera_entry(eye: Eye) -> CameraEntry:
    """The entry of an eye; the vectors of a camera of the CAHV family are turned to the head frame.

    Raises InputError for a camera whose class is not registered: written as another model, it would lose what
    that model does not have.
    """
    with prefixed(f"camera {eye.name}"):
        lens = lens_of(without_field(eye.camera))
    camera = eye.head_model() if lens.in_head_frame else without_field(eye.camera)
    values = {
        field.key: PoseEntry.of(eye.head_T_camera) if field.kind == "mount" else field.of(camera)
        for field in lens.fields
    }
    return _MODELS[lens.name](
        name=eye.name,
        unit=eye.unit or None,
        width_px=camera.width_px,
        height_px=camera.height_px,
        model=lens.name,
        field=FieldEntry.of(eye.camera),
        **values,
    )
