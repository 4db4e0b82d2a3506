r"""Text of the user's, made safe to show: on a terminal, in a log, in a message, in a table.

Names, paths and values of files may hold any character: a terminal obeys some of them (ESC), some turn the
direction of what follows (U+202E), a line end makes one message look like two. The doors through which
text leaves (the command's streams and log, the exceptions) call `visible`; nothing else needs to.
"""

import unicodedata

__all__ = ["shortened", "table_cell", "visible"]

_MOST = 1000
_WORD = 120
"""Characters that a word keeps in a text that is too long."""
_FORMULA = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")
"""What begins a formula for spreadsheets: the last four are the wide forms of = + - @."""


def visible(text: str, *, lines: bool = False) -> str:
    r"""The text with an escape in place of each character that does not print, as `repr` writes it: `\x1b`.

    Escaped are control characters, line ends, marks of direction, halves of surrogate pairs (as bytes of
    paths that are no text) and what Unicode has not assigned. With `lines`, line feeds and tabs stay. Text
    that prints comes back as it is, and so does what was escaped before.
    """
    if text.isprintable():
        return text
    kept = "\n\t" if lines else ""
    return "".join(c if _prints(c) or c in kept else repr(c)[1:-1] for c in text)


def _prints(character: str) -> bool:
    return character.isprintable() or unicodedata.category(character) == "Zs"  # blanks of other scripts


def shortened(text: str, most: int = _MOST) -> str:
    """The text, if it has more than `most` characters without the middle of long words, then of the whole.

    A message begins with the place of an error and ends with what was found: both stay.
    """
    if len(text) <= most:
        return text
    text = " ".join(_without_middle(word, _WORD) for word in text.split(" "))
    return _without_middle(text, most)


def _without_middle(text: str, most: int) -> str:
    """A text of at most `most` characters: two thirds of them the beginning, one third the end."""
    if len(text) <= most:
        return text
    gap = f"[...{len(text) - most} characters...]"
    left = max(most - len(gap), 0)
    head = left * 2 // 3
    return f"{text[:head]}{gap}{text[len(text) - (left - head) :]}"


def table_cell(name: str) -> str:
    """A name, made visible, as a cell of a CSV file: with an apostrophe in front of what begins a formula.

    A spreadsheet would compute a cell that begins with = + - @, also behind blanks. For names only: a number
    keeps its sign.
    """
    name = visible(name)
    return f"'{name}" if name.lstrip().startswith(_FORMULA) else name
