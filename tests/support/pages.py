"""Pages of the documentation whose code is run."""

import contextlib
import io
import re
from pathlib import Path

import pytest

__all__ = ["numbers", "printed_and_said"]

DOCS = Path(__file__).parents[2] / "docs"


def numbers(text: str) -> list[float]:
    """The numbers with a point in a text."""
    return [float(n) for n in re.findall(r"-?\d+\.\d*", text)]


def printed_and_said(name: str) -> tuple[list[str], list[str]]:
    """Lines that the Python code of a page prints, and those that the page says it prints.

    Skips the test where there is no such page.
    """
    page = DOCS / name
    if not page.exists():
        pytest.skip(f"no docs/{name}: it is part of the repository, not of the installed package")
    text = page.read_text(encoding="utf-8")
    code = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    (said,) = re.findall(r"```text\n(.*?)```", text, re.DOTALL)
    printed, names = io.StringIO(), dict[str, object]()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, str(page), "exec"), names)
    return printed.getvalue().strip().splitlines(), said.strip().splitlines()
