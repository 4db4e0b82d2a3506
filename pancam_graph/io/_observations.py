"""Observations as columns in a file: `observations.npz` or `observations.csv`.

Columns `image` (row in the traverse's images), `track`, `uv_px` (n, 2; in CSV `u_px` and `v_px`) and
`sigma_px`, or `covariance_px2` (n, 2, 2; in CSV `cov_uu_px2`, `cov_uv_px2`, `cov_vv_px2`), or both where they
agree. Rows count from 0; other columns are ignored.
"""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.arrays import float_array, int_array
from pancam_graph.base.errors import InputError
from pancam_graph.data import Observations, mean_sigma_px
from pancam_graph.io._csv_table import CsvTable, read_csv_table
from pancam_graph.io._json import prefixed, short
from pancam_graph.io._npz import NpzFile

__all__ = ["observations_npz", "read_observations"]

_INTEGERS = ("image", "track")
_CSV_COLUMNS = (*_INTEGERS, "u_px", "v_px")
_COVARIANCE = ("cov_uu_px2", "cov_uv_px2", "cov_vv_px2")


def read_observations(path: Path) -> Observations:
    """Observations of an .npz or .csv file.

    Shapes and types are checked here; that numbers are finite and in range, by `Traverse`. Nothing is ever
    unpickled. Raises InputError naming file, column and row.
    """
    if path.suffix == ".npz":
        return _read_npz(path)
    if path.suffix == ".csv":
        return _read_csv(path)
    raise InputError(f"{path}: expected a file that ends in .npz or .csv, found {path.name!r}")


def observations_npz(observations: Observations) -> bytes:
    """The content of an .npz file of these observations; the same bytes for the same observations."""
    content = io.BytesIO()
    columns = {name: getattr(observations, name) for name in ("image", "track", "uv_px", "sigma_px")}
    if observations.covariance_px2 is not None:
        columns["covariance_px2"] = observations.covariance_px2
    np.savez(content, **columns)
    return content.getvalue()


def _read_npz(path: Path) -> Observations:
    archive = NpzFile(path)
    with prefixed(path):
        columns: dict[str, NDArray[Any]] = {
            "image": int_array("image", _array(archive, "image")),
            "track": int_array("track", _array(archive, "track")),
            "uv_px": float_array("uv_px", _array(archive, "uv_px")),
        }
        has_covariance = "covariance_px2" in archive.names
        if has_covariance:
            columns["covariance_px2"] = float_array("covariance_px2", _array(archive, "covariance_px2"))
        if "sigma_px" in archive.names or not has_covariance:
            columns["sigma_px"] = float_array("sigma_px", _array(archive, "sigma_px"))
        if len({len(c) for c in columns.values()}) > 1:
            found = ", ".join(f"{name} {c.shape}" for name, c in columns.items())
            raise InputError(f"columns: expected one length, found the shapes {found}")
        covariance = columns.get("covariance_px2")
        if covariance is not None and covariance.shape[1:] != (2, 2):
            expected = (len(covariance), 2, 2)
            raise InputError(f"covariance_px2: expected shape {expected}, found {covariance.shape}")
    return _observations(columns)


def _observations(columns: dict[str, NDArray[Any]]) -> Observations:
    """Observations of columns; without sigmas, those that follow from the covariances."""
    covariance = columns.get("covariance_px2")
    return Observations(
        image=columns["image"],
        track=columns["track"],
        uv_px=columns["uv_px"],
        sigma_px=columns["sigma_px"]
        if covariance is None
        else columns.get("sigma_px", mean_sigma_px(covariance)),
        covariance_px2=covariance,
    )


def _array(archive: NpzFile, name: str) -> NDArray[Any]:
    column = archive.array(name)
    if column.ndim == 0:
        raise InputError(f"{name}: expected a column, found a single value")
    return column


def _read_csv(path: Path) -> Observations:
    csv_table = read_csv_table(path)
    rows = csv_table.rows
    with prefixed(path):
        where = _csv_columns(csv_table)
        table: dict[str, NDArray[Any]] = {
            name: np.zeros(len(rows), np.int64 if name in _INTEGERS else np.float64) for name in where
        }
        for row, (line, cells) in enumerate(rows):
            for name, column in where.items():
                convert = int if name in _INTEGERS else float
                table[name][row] = _number(cells[column], convert, f"{name}, row {row} (line {line})")
    columns: dict[str, NDArray[Any]] = {name: c for name, c in table.items() if name not in _COVARIANCE}
    columns["uv_px"] = np.column_stack([table["u_px"], table["v_px"]])
    if _COVARIANCE[0] in table:
        uu, uv, vv = (table[name] for name in _COVARIANCE)
        columns["covariance_px2"] = np.stack([uu, uv, uv, vv], axis=1).reshape(-1, 2, 2)
    return _observations(columns)


def _csv_columns(table: CsvTable) -> dict[str, int]:
    """Indices of the columns that are read: with sigma, the three of a covariance, or both."""
    has_covariance = any(name in table.header for name in _COVARIANCE)
    wanted = [*_CSV_COLUMNS, *(_COVARIANCE if has_covariance else ())]
    if not has_covariance or "sigma_px" in table.header:
        wanted.append("sigma_px")
    expected = ", ".join(wanted)
    if not table.header:
        raise InputError(f"line 1: expected the column names {expected}, found an empty line")
    return {name: table.column(name, expected) for name in wanted}


def _number(cell: str, convert: Callable[[str], float], where: str) -> float:
    kind = "an integer" if convert is int else "a number"
    try:
        number = convert(cell)
    except ValueError as error:
        raise InputError(f"{where}: expected {kind}, found {short(cell)}") from error
    if convert is int and abs(number) >= 2**63:
        raise InputError(f"{where}: expected an integer below 2^63, found {short(cell)}")
    return number
