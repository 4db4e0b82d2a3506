"""Observations as columns in a file: `observations.npz` or `observations.csv`.

Columns `image` (row in the traverse's images), `track`, `uv_px` (n, 2; in CSV `u_px` and `v_px`) and
`sigma_px`. Rows count from 0; other columns are left alone.
"""

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.errors import InputError
from pancam_graph.io._json import prefixed, read_bytes, short
from pancam_graph.traverse import Observations

__all__ = ["observations_npz", "read_observations"]

_CSV_COLUMNS: dict[str, Callable[[str], float]] = {
    "image": int,
    "track": int,
    "u_px": float,
    "v_px": float,
    "sigma_px": float,
}


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
    np.savez(
        content,
        image=observations.image,
        track=observations.track,
        uv_px=observations.uv_px,
        sigma_px=observations.sigma_px,
    )
    return content.getvalue()


def _read_npz(path: Path) -> Observations:
    content = io.BytesIO(read_bytes(path))
    try:
        archive: Any = np.load(content, allow_pickle=False)
    except Exception as error:  # whatever zipfile and NumPy raise at bytes that are not theirs
        raise InputError(f"{path}: expected an .npz archive of arrays, found something else") from error
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise InputError(f"{path}: expected an .npz archive of arrays, found a single array")
    with archive, prefixed(path):
        image = _integers("image", _array(archive, "image"))
        track = _integers("track", _array(archive, "track"))
        uv_px = _numbers("uv_px", _array(archive, "uv_px"))
        sigma_px = _numbers("sigma_px", _array(archive, "sigma_px"))
        columns = {"image": image, "track": track, "uv_px": uv_px, "sigma_px": sigma_px}
        if len({len(c) for c in columns.values()}) > 1:
            found = ", ".join(f"{name} {c.shape}" for name, c in columns.items())
            raise InputError(f"columns: expected one length, found the shapes {found}")
    return Observations(image=image, track=track, uv_px=uv_px, sigma_px=sigma_px)


def _array(archive: Any, name: str) -> NDArray[Any]:
    if name not in archive.files:
        found = ", ".join(archive.files) or "an empty archive"
        raise InputError(f"{name}: expected an array of this name, found {found}")
    try:
        value = archive[name]
    except Exception as error:  # a damaged member, or one that would have to be unpickled
        if "allow_pickle" in str(error):
            raise InputError(
                f"{name}: expected numbers, found pickled objects (never loaded: they can run code)"
            ) from error
        raise InputError(f"{name}: expected a whole array, found a damaged one ({error})") from error
    if not isinstance(value, np.ndarray):
        raise InputError(f"{name}: expected an array, found other bytes")
    if value.ndim == 0:
        raise InputError(f"{name}: expected a column, found a single value")
    return value


def _integers(name: str, column: NDArray[Any]) -> NDArray[np.int64]:
    if column.dtype.kind not in "iu":
        raise InputError(f"{name}: expected integers, found {column.dtype}")
    if column.dtype.kind == "u" and column.size and column.max() > np.iinfo(np.int64).max:
        raise InputError(f"{name}: expected integers below 2^63, found {column.max()}")
    return column.astype(np.int64)


def _numbers(name: str, column: NDArray[Any]) -> NDArray[np.float64]:
    if column.dtype.kind not in "fiu":
        raise InputError(f"{name}: expected numbers, found {column.dtype}")
    return column.astype(np.float64)


def _read_csv(path: Path) -> Observations:
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected CSV in UTF-8, found other bytes at {error.start}") from error
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    with prefixed(path):
        try:
            header = [name.strip() for name in next(lines, [])]
            where = _csv_columns(header)
            rows = [(lines.line_num, cells) for cells in lines if cells]
        except csv.Error as error:
            raise InputError(f"line {lines.line_num}: expected CSV, found an error: {error}") from error
        table = {name: [0.0] * len(rows) for name in _CSV_COLUMNS}
        for row, (line, cells) in enumerate(rows):
            if len(cells) != len(header):
                raise InputError(f"row {row} (line {line}): expected {len(header)} cells, found {len(cells)}")
            for name, convert in _CSV_COLUMNS.items():
                table[name][row] = _number(cells[where[name]], convert, f"{name}, row {row} (line {line})")
    return Observations(
        image=np.array(table["image"], dtype=np.int64),
        track=np.array(table["track"], dtype=np.int64),
        uv_px=np.column_stack([table["u_px"], table["v_px"]]).reshape(-1, 2),
        sigma_px=np.array(table["sigma_px"], dtype=np.float64),
    )


def _csv_columns(header: list[str]) -> dict[str, int]:
    expected = ", ".join(_CSV_COLUMNS)
    if not header:
        raise InputError(f"line 1: expected the column names {expected}, found an empty line")
    for name in _CSV_COLUMNS:
        if header.count(name) != 1:
            found = "none of this name" if name not in header else f"it {header.count(name)} times"
            raise InputError(f"{name}: expected one such column (of {expected}), found {found}")
    return {name: header.index(name) for name in _CSV_COLUMNS}


def _number(cell: str, convert: Callable[[str], float], where: str) -> float:
    kind = "an integer" if convert is int else "a number"
    try:
        number = convert(cell)
    except ValueError as error:
        raise InputError(f"{where}: expected {kind}, found {short(cell)}") from error
    if convert is int and abs(number) >= 2**63:
        raise InputError(f"{where}: expected an integer below 2^63, found {short(cell)}")
    return number
