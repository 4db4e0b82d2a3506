"""Tables as text: the digits that Python writes, whatever the numbers, names and blocks."""

import csv
import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pancam_graph.base.text import table_cell
from pancam_graph.results.table import Column, Names, csv_blocks
from pancam_graph.results.table import _csv as table_csv

HALVES = [0.5, 1.5, 0.125, 12345678.25, 1234567890.5, 1234567891.5, 999999999.95, 9999999999.5, 9999999999.4]
EDGES = [
    0.0,
    -0.0,
    1e-4,
    9.9999999999e-5,
    9.99999999995e-5,
    1e10,
    -1e10,
    1e-320,
    1e300,
    np.inf,
    -np.inf,
    np.nan,
]


def texts(numbers: list[float]) -> list[str]:
    """The cells of a column of numbers, as the table has them."""
    array = np.array(numbers, dtype=float)
    lines = b"".join(csv_blocks(["i", "x"], [np.arange(len(array)), array])).decode().splitlines()
    return [line.split(",")[1] for line in lines[1:]]


def by_python(numbers: list[float]) -> list[str]:
    return [f"{x:.10g}" if np.isfinite(x) else "" for x in numbers]


@settings(deadline=None)
@given(st.lists(st.floats(allow_nan=True), max_size=30))
def test_digits_are_those_of_python(numbers: list[float]) -> None:
    assert texts(numbers) == by_python(numbers)


def test_digits_next_to_a_half_and_at_the_edges_of_the_notation() -> None:
    numbers = [s * x for x in [*HALVES, *EDGES] for s in (1, -1)]
    numbers += [float(np.nextafter(x, to)) for x in [*HALVES, *EDGES[2:6]] for to in (0.0, 1e300)]
    assert texts(numbers) == by_python(numbers)


def test_digits_of_many_magnitudes() -> None:
    rng = np.random.default_rng(0)
    exponents = rng.uniform(-6, 11, 20_000)
    plain = (rng.choice([-1.0, 1.0], len(exponents)) * 10**exponents).tolist()
    few = np.round(plain, 3).tolist()  # few digits: zeros at the end, and halves of the last digit
    assert texts(plain) == by_python(plain)
    assert texts(few) == by_python(few)


@settings(deadline=None)
@given(st.lists(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=20))
def test_whole_numbers(numbers: list[int]) -> None:
    lines = b"".join(csv_blocks(["n"], [np.array(numbers, dtype=np.int64)])).decode().splitlines()
    assert lines == ["n", *map(str, numbers)]


@settings(deadline=None)
@given(st.lists(st.text(st.characters(categories=["L", "N", "P", "Z"]), max_size=8), min_size=1, max_size=6))
def test_names_come_back_as_a_reader_of_tables_reads_them(names: list[str]) -> None:
    rows = np.arange(2 * len(names)) % len(names)
    numbers = np.linspace(0.0, 1.0, len(rows))
    columns: list[Column] = [
        Names(row=rows, names=names),
        numbers,
        Names(row=rows[::-1], names=["", "b", *names]),
    ]
    text = b"".join(csv_blocks(["a", "x", "b"], columns)).decode()
    assert text.splitlines()[0] == "a,x,b"
    read = list(csv.reader(io.StringIO(text, newline="")))[1:]
    assert len(read) == len(rows)
    assert [float(cells[1]) for cells in read] == pytest.approx(numbers, abs=1e-9)
    for row, cells in zip(rows, read, strict=True):
        assert cells[0].lstrip("'") == table_cell(names[row]).lstrip("'")


def test_blocks_are_no_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    columns: list[Column] = [np.arange(100), np.geomspace(1e-7, 1e12, 100)]
    whole = b"".join(csv_blocks(["n", "x"], columns))
    monkeypatch.setattr(table_csv, "_ROWS", 7)
    blocks = list(csv_blocks(["n", "x"], columns))
    assert len(blocks) == 1 + 15
    assert b"".join(blocks) == whole
