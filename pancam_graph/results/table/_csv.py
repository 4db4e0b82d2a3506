"""A table as CSV, a block of rows at a time."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.base.text import table_cell
from pancam_graph.results.table._digits import NAME, NUMBER, ROOM, WHOLE, write_rows

__all__ = ["Column", "Names", "csv_blocks"]

_ROWS = 20_000
"""Rows of a block."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Names:
    """A column of names that occur often."""

    row: IntArray
    """(rows,) which of the names each is"""
    names: Sequence[str]


Column = Names | IntArray | FloatArray
"""Names, whole numbers, or decimal numbers; (rows,) each."""


def csv_blocks(header: Sequence[str], columns: Sequence[Column]) -> Iterator[bytes]:
    """A table as blocks of a CSV file: `header`, then a line a row; all columns are equally long.

    Decimal numbers have ten significant digits, as `format(x, ".10g")` writes them; a cell is empty where one
    is not finite. Names are written as `base.text.table_cell` does, in quotes where they need them.
    """
    yield _line(header)
    texts: list[bytes] = []
    kind: list[int] = []
    whole: list[IntArray] = []
    numbers: list[FloatArray] = []
    for column in columns:
        if isinstance(column, Names):
            kind.append(NAME)
            whole.append(column.row + len(texts))
            texts += [_line(["", table_cell(name)])[1:-1] for name in column.names]  # alone, "" has quotes
        elif np.issubdtype(column.dtype, np.integer):
            kind.append(WHOLE)
            whole.append(column.astype(np.int64))
        else:
            kind.append(NUMBER)
            numbers.append(column.astype(np.float64))
    width = max([ROOM, *(len(text) for text in texts)]) + 1
    text = np.frombuffer(b"".join(texts), dtype=np.uint8)
    begin = np.concatenate([[0], np.cumsum([len(t) for t in texts])]).astype(np.int64)
    n_rows = len(columns[0].row if isinstance(columns[0], Names) else columns[0])
    for first in range(0, n_rows, _ROWS):
        n = min(n_rows - first, _ROWS)
        in_rows = _columns(whole, first, n, np.int64), _columns(numbers, first, n, np.float64)
        yield _block(np.array(kind), *in_rows, text, begin, np.empty(n * len(kind) * width, dtype=np.uint8))


def _columns(columns: Sequence[NDArray[Any]], first: int, n: int, dtype: type[np.generic]) -> NDArray[Any]:
    """Some rows (n, columns) of columns."""
    out = np.empty((n, len(columns)), dtype=dtype)
    for i, column in enumerate(columns):
        out[:, i] = column[first : first + n]
    return out


def _block(
    kind: IntArray,
    whole: IntArray,
    numbers: FloatArray,
    text: NDArray[np.uint8],
    begin: IntArray,
    out: NDArray[np.uint8],
) -> bytes:
    """Rows as text, in the memory `out`."""
    late, late_number = np.empty(numbers.size, dtype=np.int64), np.empty(numbers.size)
    n = write_rows(kind, whole, numbers, text, begin, out, late, late_number)
    for at, x in takewhile(lambda cell: cell[0] >= 0, zip(late, late_number, strict=True)):
        written = f"{x:.10g}".encode()
        out[at : at + len(written)] = np.frombuffer(written, dtype=np.uint8)
    return out[:n].tobytes().replace(b"\0", b"")


def _line(cells: Sequence[str]) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue().encode()
