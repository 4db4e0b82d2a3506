"""The page on ties: its code runs, and prints what the page says."""

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "docs" / "ties.md"


def numbers(text: str) -> list[float]:
    return [float(n) for n in re.findall(r"-?\d+\.\d*", text)]


def test_the_code_of_the_page_prints_what_it_says() -> None:
    if not PAGE.exists():
        pytest.skip("no docs/ties.md: it is part of the repository, not of the installed package")
    text = PAGE.read_text(encoding="utf-8")
    code = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    (said,) = re.findall(r"```text\n(.*?)```", text, re.DOTALL)
    printed, names = io.StringIO(), dict[str, object]()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, str(PAGE), "exec"), names)
    lines, expected = printed.getvalue().strip().splitlines(), said.strip().splitlines()
    assert len(lines) == len(expected)
    for line, wanted in zip(lines, expected, strict=True):
        assert np.allclose(numbers(line), numbers(wanted), atol=0.11), (line, wanted)
    # What the page claims: ties bring the last stop to within two sigmas of the truth, also if one is wrong.
    for line in lines[1:3]:
        off, sigma = numbers(line)
        assert off < 2 * sigma < 50
    assert "constraints[1] (landmark-position of" in lines[3]
