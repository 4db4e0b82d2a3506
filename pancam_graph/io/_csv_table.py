"""A table in a CSV file: its column names, and its rows with their lines."""

import csv
import io
from dataclasses import dataclass
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.io._json import prefixed, read_bytes

__all__ = ["CsvTable", "read_csv_table"]


@dataclass(frozen=True, kw_only=True)
class CsvTable:
    """The cells of a CSV file as text."""

    header: tuple[str, ...]
    """Names of the columns, without blanks around them; none for an empty first line."""
    rows: tuple[tuple[int, tuple[str, ...]], ...]
    """Line in the file and cells of each row; of empty lines there is none."""

    def column(self, name: str, expected: str) -> int:
        """Index of a column. Raises InputError, which lists those `expected`, unless there is one of it."""
        if self.header.count(name) != 1:
            times = self.header.count(name)
            found = "none of this name" if times == 0 else f"it {times} times"
            raise InputError(f"{name}: expected one such column (of {expected}), found {found}")
        return self.header.index(name)


def read_csv_table(path: Path) -> CsvTable:
    """Read a CSV file in UTF-8.

    Raises InputError naming file and line for what cannot be read or is no CSV, and for a row with another
    number of cells than there are columns.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected CSV in UTF-8, found other bytes at {error.start}") from error
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    with prefixed(path):
        try:
            header = tuple(name.strip() for name in next(lines, []))
            rows = tuple((lines.line_num, tuple(cells)) for cells in lines if cells)
        except csv.Error as error:
            raise InputError(f"line {lines.line_num}: expected CSV, found an error: {error}") from error
        for row, (line, cells) in enumerate(rows if header else ()):
            if len(cells) != len(header):
                raise InputError(f"row {row} (line {line}): expected {len(header)} cells, found {len(cells)}")
    return CsvTable(header=header, rows=rows)
