"""Text of the user's made safe: what a terminal obeys is escaped, what is long loses its middle."""

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pancam_graph.base.errors import InputError
from pancam_graph.base.text import shortened, table_cell, visible

ANY = st.text(st.characters(codec=None))
"""Any characters, halves of surrogate pairs too."""


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("stop [/3] A", "stop [/3] A"),
        ("Šárka 火星 ü\u3000\u00a0x", "Šárka 火星 ü\u3000\u00a0x"),
        ("\x1b[31mred", r"\x1b[31mred"),
        ("\x9b31m", r"\x9b31m"),
        ("a\nb\r\tc", r"a\nb\r\tc"),
        ("\u202egnp.exe", r"\u202egnp.exe"),
        ("a\u2028b\x85c\x00", r"a\u2028b\x85c\x00"),
        ("caf\udce9", r"caf\udce9"),
        (r"a \x1b that was escaped", r"a \x1b that was escaped"),
        ("", ""),
    ],
)
def test_what_a_terminal_obeys_is_escaped(text: str, shown: str) -> None:
    assert visible(text) == shown


def test_lines_stay_where_there_may_be_several() -> None:
    assert visible("a\n\tb\x1b\r\n", lines=True) == "a\n\tb\\x1b\\r\n"


@given(ANY)
def test_visible_text_prints_and_stays_as_it_is(text: str) -> None:
    shown = visible(text)
    assert {unicodedata.category(c) for c in shown} & {"Cc", "Cf", "Cs", "Cn", "Co", "Zl", "Zp"} == set()
    assert visible(shown) == shown
    shown.encode()  # no half of a pair is left


@given(ANY, st.integers(0, 300))
def test_short_text_stays_and_long_text_is_short(text: str, most: int) -> None:
    if len(text) <= most:
        assert shortened(text, most) == text
    else:
        assert len(shortened(text, most)) <= max(most, len(f"[...{len(text)} characters...]"))


def test_a_long_message_keeps_its_place_and_what_was_found() -> None:
    name = "n" * 5000
    error = str(
        InputError(f"/data/traverse.json: stops[3].id: expected another name than {name}, found it twice")
    )
    assert len(error) < 300
    assert error.startswith("/data/traverse.json: stops[3].id: expected another name than nnn")
    assert error.endswith("nnn, found it twice")
    many = str(InputError(f"here: {'one of many ' * 500}, found 'x'"))
    assert len(many) == 1000
    assert many.startswith("here: one of")
    assert many.endswith(", found 'x'")


def test_an_error_shows_no_character_that_a_terminal_obeys() -> None:
    error = InputError("x.LBL: FRAME\x1b[2J: expected\na number")
    assert str(error) == r"x.LBL: FRAME\x1b[2J: expected\na number"
    assert error.args == ("x.LBL: FRAME\x1b[2J: expected\na number",)


@pytest.mark.parametrize("name", ["=1+1", "+1", "-1", "@x", " =1", "\uff1d1", "\u3000-2"])
def test_a_name_that_a_spreadsheet_would_compute_gets_an_apostrophe(name: str) -> None:
    assert table_cell(name) == f"'{name}"


@pytest.mark.parametrize("name", ["", "a=b", "1-2", "s0f0 left", "é"])
def test_other_names_stay(name: str) -> None:
    assert table_cell(name) == name


@given(ANY)
def test_no_cell_begins_a_formula(name: str) -> None:
    cell = table_cell(name)
    assert not cell.lstrip().startswith(("=", "+", "-", "@"))
    assert cell.removeprefix("'") == visible(name).removeprefix("'")
