"""Stops of plain pictures: where the mast stood."""

from collections.abc import Sequence
from pathlib import Path

import gtsam
import numpy as np

from pancam_graph.base.choices import some_of
from pancam_graph.base.errors import InputError
from pancam_graph.data import Stop
from pancam_graph.io._json import prefixed
from pancam_graph.io.plain._options import STOP_COLUMNS
from pancam_graph.io.plain._table_cells import Row, read_rows

__all__ = ["stops_of"]

_OPTIONAL = "yaw_deg, sigma_m, sigma_deg"
_MOST_M = 1e7
_SIGMA_M, _SIGMA_DEG = 0.2, 2.0
"""Of the place and the turn of a stop for which the table has none: our stated assumption for a tape and a
level. The first stop defines the world."""


def stops_of(
    names: Sequence[str], table: Path | None, folder: Path, *, clockwise: bool
) -> tuple[tuple[Stop, ...], list[str]]:
    """The stops of these names in the order of the table, and warnings.

    A single stop without a table is the world's origin. Raises InputError for several without one, and naming
    file, column and line for a table that is not as it should be or lacks one.
    """
    if table is None:
        if len(names) > 1:
            raise InputError(
                f"{folder}: expected --stops FILE.csv with the columns {STOP_COLUMNS} for the stops "
                f"{some_of(names)}, found none; one stop alone, or a column stop in the table of pointing, "
                "does without"
            )
        return (_stop(names[0], gtsam.Pose3(), 0.0, 0.0),), []
    rows, warnings = read_rows(table, STOP_COLUMNS, _OPTIONAL)
    stops: dict[str, Stop] = {}
    lines: dict[str, int] = {}
    with prefixed(table):
        for row in rows:
            name = row.text("stop")
            if name is None:
                raise InputError(f"{row.place('stop')}: expected the name of a stop, found an empty cell")
            if name in lines:
                raise InputError(
                    f"{row.place('stop')}: expected each stop once, found {name!r} in line {lines[name]} too"
                )
            lines[name] = row.line
            stop = _stop_of(row, name, first=not stops, clockwise=clockwise)
            if name in names:
                stops[name] = stop
            else:
                warnings.append(f"{table}: {row.place('stop')}: no picture is of stop {name!r}; left out")
        missing = [name for name in names if name not in stops]
        if missing:
            raise InputError(f"stop: expected a line for each stop, found none for {some_of(missing)}")
    return tuple(stops.values()), warnings


def _stop_of(row: Row, name: str, *, first: bool, clockwise: bool) -> Stop:
    place = np.array([row.number(f"{axis}_m", -_MOST_M, _MOST_M) for axis in "xyz"])
    yaw_rad = np.deg2rad(row.number_or_none("yaw_deg", -3600, 3600) or 0.0)
    sigma_m = row.number_or_none("sigma_m", 0, _MOST_M)
    sigma_deg = row.number_or_none("sigma_deg", 0, 180)
    usual_m, usual_deg = (0.0, 0.0) if first else (_SIGMA_M, _SIGMA_DEG)
    return _stop(
        name,
        gtsam.Pose3(gtsam.Rot3.Rz(float(-yaw_rad if clockwise else yaw_rad)), place),
        float(np.deg2rad(usual_deg if sigma_deg is None else sigma_deg)),
        usual_m if sigma_m is None else sigma_m,
    )


def _stop(
    name: str, world_T_mast: gtsam.Pose3, sigma_rotation_rad: float, sigma_translation_m: float
) -> Stop:
    return Stop(
        id=name,
        world_T_mast=world_T_mast,
        sigma_rotation_rad=sigma_rotation_rad,
        sigma_translation_m=sigma_translation_m,
    )
