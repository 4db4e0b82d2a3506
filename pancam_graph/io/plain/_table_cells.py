"""Cells of a table with numbers: what stands in a row, by the name of its column."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pancam_graph.base.choices import nearest
from pancam_graph.base.errors import InputError
from pancam_graph.io._csv_table import read_csv_table
from pancam_graph.io._json import prefixed, short

__all__ = ["Row", "read_rows"]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of a table."""

    line: int
    """Its line in the file."""
    cells: dict[str, str]
    """By column; of columns that are left out, and of empty cells, there is none."""

    def text(self, name: str) -> str | None:
        """What a cell says; None for an empty one.

        Raises InputError for one with characters that are not in a name.
        """
        text = self.cells.get(name)
        if text is not None and not text.isprintable():
            raise InputError(f"{self.place(name)}: expected a name of one line, found {short(text)}")
        return text

    def number(self, name: str, low: float, high: float) -> float:
        """A number. Raises InputError for an empty cell, for text, and outside the range."""
        text = self.cells.get(name, "")
        try:
            value = float(text)
        except ValueError as error:
            raise InputError(f"{self.place(name)}: expected a number, found {short(text)}") from error
        if not (math.isfinite(value) and low <= value <= high):
            raise InputError(
                f"{self.place(name)}: expected a number from {low:g} to {high:g}, found {short(text)}"
            )
        return value

    def number_or_none(self, name: str, low: float, high: float) -> float | None:
        """A number; None for an empty cell. Raises InputError likewise."""
        return self.number(name, low, high) if name in self.cells else None

    def place(self, name: str) -> str:
        """Where a cell is, as error messages say it."""
        return f"{name}, line {self.line}"


def read_rows(
    path: Path, required: str, optional: str, *, none_or_all: Sequence[str] = ()
) -> tuple[list[Row], list[str]]:
    """Rows of a table with the columns `required` and some of those `optional`, and warnings of others.

    Both are names with commas between; of those required, `none_or_all` may be missing together. Rows of
    empty cells are passed over. Raises InputError naming file, column and line.
    """
    table = read_csv_table(path)
    must, may = required.split(", "), optional.split(", ")
    with prefixed(path):
        if not table.header:
            raise InputError(f"line 1: expected the column names {required}, found an empty line")
        if len(table.header) == 1 and ";" in table.header[0]:
            raise InputError(f"line 1: expected commas between {required}, found semicolons")
        known = [*must, *may]
        if not set(none_or_all) & set(table.header):
            must = [name for name in must if name not in none_or_all]
        where = {name: table.column(name, required) for name in known if name in must or name in table.header}
        others = [name for name in table.header if name and name not in known]
        warnings = [f"{path}: the column {n!r} is not used{nearest(n, known)}" for n in others]
        rows = [
            Row(
                line=line,
                cells={name: cells[at].strip() for name, at in where.items() if cells[at].strip()},
            )
            for line, cells in table.rows
        ]
        rows = [row for row in rows if row.cells]
        if not rows:
            raise InputError("expected a line for each picture or stop, found none")
    return rows, warnings
