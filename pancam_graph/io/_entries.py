"""What all file formats share: strict entries, names, poses.

Keys and units are those of the file contract. Every model is strict: no unknown key, no number in a
string, nothing that is not finite. References between entries are checked by the data model.
"""

from typing import Annotated, ClassVar

import gtsam
from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from pancam_graph.base.errors import GeometryError, InputError
from pancam_graph.base.geometry import pose_from_wxyz, wxyz_from_rotation

__all__ = [
    "MOSAIC_FORMAT",
    "RIG_FORMAT",
    "SOLUTION_FORMAT",
    "TERRAIN_FORMAT",
    "TIES_FORMAT",
    "TRAVERSE_FORMAT",
    "VERSION",
    "Entry",
    "Label",
    "PoseEntry",
    "SparseEntry",
    "Text",
]

TRAVERSE_FORMAT = "pancam-graph/traverse"
RIG_FORMAT = "pancam-graph/rig"
SOLUTION_FORMAT = "pancam-graph/solution"
MOSAIC_FORMAT = "pancam-graph/mosaics"
TERRAIN_FORMAT = "pancam-graph/terrain"
TIES_FORMAT = "pancam-graph/ties"
VERSION = 1

Text = Annotated[str, Field(min_length=0)]
"""Any string that can be written in UTF-8: a constraint makes pydantic look for halves of characters."""
Label = Annotated[str, Field(pattern=r"^[^\p{Cc}\p{Zl}\p{Zp}]+$")]
"""An id, a name or a path: not empty, and without control characters, which would break lines and tables."""


class Entry(BaseModel):
    """Base of all entries."""

    # Deferred: to build the checks of all files takes longer than to read the one or two kinds of a process.
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True, defer_build=True)


class SparseEntry(Entry):
    """An entry that is written without the keys of `_OPTIONAL` that are null."""

    _OPTIONAL: ClassVar[frozenset[str]] = frozenset()

    @model_serializer(mode="wrap")
    def _without_nulls(self, handler: SerializerFunctionWrapHandler) -> dict[str, object]:
        content: dict[str, object] = handler(self)
        return {k: v for k, v in content.items() if v is not None or k not in self._OPTIONAL}


class PoseEntry(Entry):
    """A pose: quaternion (w, x, y, z), of any length but 0, and translation in metres."""

    rotation_wxyz: Annotated[list[float], Field(min_length=4, max_length=4)]
    translation_m: Annotated[list[float], Field(min_length=3, max_length=3)]

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
