"""The entries of `constraints` in `traverse.json`, one a kind, and the table of named points."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import gtsam
import numpy as np
from pydantic import Field

from pancam_graph.base.choices import expected_one_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import (
    CONSTRAINTS,
    Constraint,
    LandmarkSurface,
    NamedPoints,
    StopPlacement,
    StopPosition,
    Surface,
)
from pancam_graph.io._csv_table import read_csv_table
from pancam_graph.io._entries import Label, PoseEntry, SparseEntry
from pancam_graph.io._json import prefixed, short

__all__ = ["AnyConstraint", "constraint_entry", "points_csv", "read_points", "surface_files"]

_Landmark = Label | int
_Axes = Annotated[list[float | None], Field(min_length=3, max_length=3)]
_Three = Annotated[list[float], Field(min_length=3, max_length=3)]
_Two = Annotated[list[Label], Field(min_length=2, max_length=2)]
_CLASS = {one.kind: one for one in CONSTRAINTS}
_COLUMNS = ("name", "image", "u_px", "v_px", "sigma_px")


class _ConstraintEntry(SparseEntry):
    """Base of all kinds."""

    _OPTIONAL: ClassVar = frozenset(
        {"robust", "sigma_m", "sigma_rad", "covariance_m2", "position_m", "world_T_mast", "covariance"}
    )

    kind: str
    robust: bool | None = None

    def constraint(self, surfaces: Mapping[str, Surface]) -> Constraint:
        """The constraint; `surfaces` are those of `surface_files`. Raises InputError naming the entry."""
        known = {name: getattr(self, name) for name in type(self).model_fields if name != "kind"}
        for name in ("a_T_b", "world_T_mast"):
            if isinstance(known.get(name), PoseEntry):
                known[name] = known[name].pose(name)
        if "file" in known:
            known["surface"] = surfaces[known.pop("file")]
        for name in ("covariance", "covariance_m2"):
            if known.get(name) is not None:
                known[name] = _matrix(name, known[name])
        for name in ("stops", "landmarks"):
            if name in known:
                known["between"] = tuple(known.pop(name))
        known["robust"] = bool(known["robust"])
        return self._made(known)

    def _made(self, known: dict[str, Any]) -> Constraint:
        return _CLASS[self.kind](**known)


class _LandmarkPosition(_ConstraintEntry):
    kind: Literal["landmark-position"]
    landmark: _Landmark
    position_m: _Axes
    sigma_m: _Axes | None = None
    covariance_m2: list[list[float]] | None = None


class _LandmarkHeight(_ConstraintEntry):
    kind: Literal["landmark-height"]
    landmark: _Landmark
    height_m: float
    sigma_m: float


class _LandmarkPlane(_ConstraintEntry):
    kind: Literal["landmark-plane"]
    landmark: _Landmark
    normal: _Three
    offset_m: float
    sigma_m: float


class _LandmarkAzimuth(_ConstraintEntry):
    kind: Literal["landmark-azimuth"]
    landmark: _Landmark
    stop: Label
    azimuth_rad: float
    sigma_rad: float


class _LandmarkElevation(_ConstraintEntry):
    kind: Literal["landmark-elevation"]
    landmark: _Landmark
    stop: Label
    elevation_rad: float
    sigma_rad: float


class _LandmarkInfinity(_ConstraintEntry):
    kind: Literal["landmark-infinity"]
    landmark: _Landmark


class _LandmarkSurface(_ConstraintEntry):
    kind: Literal["landmark-surface"]
    landmark: _Landmark
    file: Label
    sigma_m: float


class _LandmarkDistance(_ConstraintEntry):
    kind: Literal["landmark-distance"]
    landmarks: Annotated[list[_Landmark], Field(min_length=2, max_length=2)]
    distance_m: float
    sigma_m: float


class _StopPosition(_ConstraintEntry):
    kind: Literal["stop-position"]
    stop: Label
    position_m: _Axes | None = None
    sigma_m: _Axes | None = None
    covariance_m2: list[list[float]] | None = None
    world_T_mast: PoseEntry | None = None
    covariance: list[list[float]] | None = None

    def _made(self, known: dict[str, Any]) -> Constraint:
        place, pose = ("position_m", "sigma_m", "covariance_m2"), ("world_T_mast", "covariance")
        told = [name for name in (*place, *pose) if known[name] is not None]
        if set(told) == set(pose):
            return StopPlacement(**{name: value for name, value in known.items() if name not in place})
        if "position_m" not in told or set(told) & set(pose):
            raise InputError(
                "expected position_m with sigma_m or covariance_m2, or world_T_mast with covariance; found "
                f"{' and '.join(told) or 'none'}"
            )
        return StopPosition(**{name: value for name, value in known.items() if name not in pose})


class _StopPose(_ConstraintEntry):
    kind: Literal["stop-pose"]
    stops: _Two
    a_T_b: PoseEntry
    covariance: list[list[float]]


class _StopDistance(_ConstraintEntry):
    kind: Literal["stop-distance"]
    stops: _Two
    distance_m: float
    sigma_m: float


class _StopHeading(_ConstraintEntry):
    kind: Literal["stop-heading"]
    stop: Label
    heading_rad: float
    sigma_rad: float


class _FramePoint(_ConstraintEntry):
    kind: Literal["frame-point"]
    frame: Label
    camera: Label
    u_px: float
    v_px: float
    sigma_px: float
    position_m: _Three
    sigma_m: float


class _FrameDirection(_ConstraintEntry):
    kind: Literal["frame-direction"]
    frame: Label
    camera: Label
    u_px: float
    v_px: float
    sigma_px: float
    azimuth_rad: float
    elevation_rad: float
    sigma_rad: float | None = None

    def _made(self, known: dict[str, Any]) -> Constraint:
        return super()._made({name: value for name, value in known.items() if value is not None})


AnyConstraint = Annotated[
    _LandmarkPosition
    | _LandmarkHeight
    | _LandmarkPlane
    | _LandmarkAzimuth
    | _LandmarkElevation
    | _LandmarkInfinity
    | _LandmarkSurface
    | _LandmarkDistance
    | _StopPosition
    | _StopPose
    | _StopDistance
    | _StopHeading
    | _FrameDirection
    | _FramePoint,
    Field(discriminator="kind"),
]
"""Any kind of constraint, as the type of an entry."""

_ENTRY = {
    entry.model_fields["kind"].annotation.__args__[0]: entry  # type: ignore[union-attr]  # a Literal
    for entry in _ConstraintEntry.__subclasses__()
}


def surface_files(constraints: Sequence[Constraint], folder: Path | None) -> dict[Surface, str]:
    """Surfaces of constraints, each with the name of its file in a folder that they are written to.

    A file in `folder`, where the traverse was read, keeps its path there.
    """
    out: dict[Surface, str] = {}
    for one in constraints:
        if not isinstance(one, LandmarkSurface) or one.surface in out:
            continue
        file = one.surface.file
        name = Path("surface.tif" if file is None else file.name)
        if file is not None and folder is not None and file.is_relative_to(folder):
            name = file.relative_to(folder)
        numbered = [name, *(name.with_name(f"{name.stem}_{n}{name.suffix}") for n in range(2, len(out) + 3))]
        out[one.surface] = next(str(one) for one in numbered if str(one) not in out.values())
    return out


def constraint_entry(constraint: Constraint, surfaces: Mapping[Surface, str]) -> "_ConstraintEntry":
    """The entry of a constraint; `surfaces` are those of `surface_files`."""
    entry = _ENTRY[constraint.kind]
    known: dict[str, object] = {"kind": constraint.kind}
    if isinstance(constraint, LandmarkSurface):
        known["file"] = surfaces[constraint.surface]
    for name in entry.model_fields:
        value = vars(constraint).get("between" if name in {"stops", "landmarks"} else name)
        if name == "landmarks":
            known[name] = list(value or ())
            continue
        if name == "kind" or value is None or (name == "robust" and not value):
            continue
        if isinstance(value, gtsam.Pose3):
            value = PoseEntry.of(value)
        elif isinstance(value, np.ndarray):
            value = value.tolist()
        elif isinstance(value, tuple | list):
            value = [float(v) if isinstance(v, int | float | np.number) else v for v in value]
        elif isinstance(value, np.number) or (isinstance(value, int) and name not in {"landmark", "robust"}):
            value = float(value)
        known[name] = value
    return entry(**known)  # type: ignore[arg-type]  # as the fields say


def _matrix(name: str, rows: list[list[float]]) -> FloatArray:
    n = 6 if name == "covariance" else 3
    lengths = sorted({len(row) for row in rows})
    if len(rows) != n or lengths != [n]:
        raise InputError(f"{name}: expected {n} rows of {n} numbers, found {len(rows)} of {lengths}")
    return np.array(rows, dtype=float)


def read_points(path: Path, images: list[str]) -> NamedPoints:
    """The table of named points: columns `name`, `image` (its id), `u_px`, `v_px`, `sigma_px`.

    Raises InputError naming file and line.
    """
    table = read_csv_table(path)
    with prefixed(path):
        at = {name: table.column(name, ", ".join(_COLUMNS)) for name in _COLUMNS}
        row_of = {name: row for row, name in enumerate(images)}
        names, rows, numbers = [], [], []
        for line, cells in table.rows:
            name, image = cells[at["name"]].strip(), cells[at["image"]].strip()
            if not name:
                raise InputError(f"line {line}: name: expected a name, found an empty cell")
            if image not in row_of:
                raise InputError(expected_one_of(f"line {line}: image", image, images))
            names.append(name)
            rows.append(row_of[image])
            numbers.append([_number(cells[at[c]], f"line {line}: {c}") for c in _COLUMNS[2:]])
        columns = np.array(numbers, dtype=float).reshape(-1, 3)
        return NamedPoints(
            name=tuple(names),
            image=np.array(rows, dtype=np.int64),
            uv_px=columns[:, :2],
            sigma_px=columns[:, 2],
        )


def points_csv(points: NamedPoints, images: list[str]) -> bytes:
    """The content of the table of named points, digits to double precision."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for name, image, uv, sigma in zip(
        points.name, points.image.tolist(), points.uv_px.tolist(), points.sigma_px.tolist(), strict=True
    ):
        writer.writerow([name, images[image], *map(repr, uv), repr(sigma)])
    return text.getvalue().encode()


def _number(cell: str, where: str) -> float:
    try:
        return float(cell)
    except ValueError as error:
        raise InputError(f"{where}: expected a number, found {short(cell)}") from error
