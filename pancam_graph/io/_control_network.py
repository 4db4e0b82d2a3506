"""ISIS control networks as CSV: a row a measure, columns as plio names the entries of the binary file.

Samples and lines count from 1 at the centre of the first pixel. Coordinates are in the body's own frame,
metres, where the drive has a place on a body; else in the world.
"""

import csv
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.text import table_cell
from pancam_graph.data import Constraint, LandmarkPosition, Traverse
from pancam_graph.io._csv_table import read_csv_table
from pancam_graph.io._json import prefixed, short
from pancam_graph.io._told_numbers import told_number
from pancam_graph.io.vicar import Mark, image_rows, joined, picture_identities

__all__ = ["NETWORK_COLUMNS", "network_csv", "with_network"]

NETWORK_COLUMNS = (
    "id",
    "pointType",
    "pointIgnore",
    "aprioriX",
    "aprioriY",
    "aprioriZ",
    "aprioriCovar",
    "adjustedX",
    "adjustedY",
    "adjustedZ",
    "adjustedCovar",
    "serialnumber",
    "measureType",
    "measureIgnore",
    "sample",
    "line",
    "sampleResidual",
    "lineResidual",
    "samplesigma",
    "linesigma",
)
_NEEDED = ("id", "serialnumber", "sample", "line")
_NAMES = ("id", "serialnumber")
_FIRST_PIXEL = 1.0
_CONSTRAINED = {3, 4}
"""Types of points whose a priori coordinates are known: constrained and fixed."""
_FIXED_M = 1e-3
"""Sigma of a fixed point, and of a constrained one whose covariance is not told."""
_SIGMA_PX = 0.5
_TRUE = {"true", "1", "1.0"}


def network_csv(rows: Sequence[dict[str, str]]) -> bytes:
    """The content of a control network; cells by the names of `NETWORK_COLUMNS`, empty where one has none."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(NETWORK_COLUMNS)
    for row in rows:
        writer.writerow(
            [table_cell(row[n]) if n in _NAMES and n in row else row.get(n, "") for n in NETWORK_COLUMNS]
        )
    return text.getvalue().encode()


def with_network(traverse: Traverse, path: Path) -> Traverse:
    """A traverse with the measures of a control network in place of its observations.

    A point whose type is constrained (3) or fixed (4) becomes a constraint on its a priori position, with the
    covariance that is told. Ignored points and measures are left out. Raises InputError naming file, line and
    column for what is missing or malformed, where no image is there, and where nothing joins two images.
    """
    table = read_csv_table(path)
    with prefixed(path):
        at = {name: table.column(name, ", ".join(_NEEDED)) for name in _NEEDED}
        at |= {name: table.header.index(name) for name in NETWORK_COLUMNS if table.header.count(name) == 1}

    def cell(cells: tuple[str, ...], name: str) -> str:
        return cells[at[name]].strip() if name in at else ""

    if not table.rows:
        raise InputError(f"{path}: expected rows of measures under the head, found none")
    serials = list(dict.fromkeys(cells[at["serialnumber"]].strip() for _, cells in table.rows))
    rows = image_rows(serials, picture_identities(traverse), path, traverse)
    groups: dict[object, list[Mark]] = {}
    said: dict[object, tuple[object, Callable[[int], Constraint]]] = {}
    missing = 0
    for line, cells in table.rows:
        with prefixed(f"{path}: line {line}"):
            if any(cell(cells, name).lower() in _TRUE for name in ("pointIgnore", "measureIgnore")):
                continue
            name = cell(cells, "id")
            if not name:
                raise InputError("id: expected a name, found an empty cell")
            if cell(cells, "serialnumber") not in rows:
                missing += 1
                continue
            uv = tuple(_number(cell(cells, c), c) - _FIRST_PIXEL for c in ("sample", "line"))
            sigmas = [_number(cell(cells, c) or "0", c) or _SIGMA_PX for c in ("samplesigma", "linesigma")]
            if min(sigmas) < 0:
                raise InputError(f"samplesigma: expected numbers above 0, found {min(sigmas)}")
            groups.setdefault(name, []).append(
                Mark(
                    image=rows[cell(cells, "serialnumber")],
                    uv=(uv[0], uv[1]),
                    covariance_px2=(sigmas[0] ** 2, 0.0, sigmas[1] ** 2),
                )
            )
            kind = _number(cell(cells, "pointType") or "2", "pointType")
            if kind in _CONSTRAINED and name not in said:
                said[name] = (name, _position(traverse, cells, cell))
    notes = [f"{path.name}: {missing} measures are of images that are not there"] if missing else []
    return joined(traverse, groups, list(said.values()), path, notes)


def _position(
    traverse: Traverse, cells: tuple[str, ...], cell: Callable[[tuple[str, ...], str], str]
) -> Callable[[int], Constraint]:
    """What makes the constraint of a constrained point of its track."""
    place = np.array([_number(cell(cells, f"apriori{axis}"), f"apriori{axis}") for axis in "XYZ"])
    text = cell(cells, "aprioriCovar")
    covariance = np.eye(3) * _FIXED_M**2
    if text and text != "[]":
        try:
            told = np.array(json.loads(text), dtype=float)
        except (ValueError, TypeError) as error:
            raise InputError(f"aprioriCovar: expected a list of six numbers, found {short(text)}") from error
        if told.shape != (6,) or not np.isfinite(told).all():
            raise InputError(f"aprioriCovar: expected a list of six numbers, found {short(text)}")
        covariance = np.array([told[[0, 1, 2]], told[[1, 3, 4]], told[[2, 4, 5]]])
    if traverse.site is not None:
        rotation, origin = traverse.site.body_frame
        place, covariance = (place - origin) @ rotation, rotation.T @ covariance @ rotation
    position = tuple(place.tolist())
    LandmarkPosition(landmark=0, position_m=position, covariance_m2=covariance)  # refuses what is none
    return lambda track: LandmarkPosition(
        landmark=track, position_m=position, covariance_m2=covariance, robust=True
    )


def _number(text: str, name: str) -> float:
    number = told_number(text)
    if number is None:
        raise InputError(f"{name}: expected a number, found {short(text)}")
    return number
