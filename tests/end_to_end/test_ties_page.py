"""The page on ties: its code runs, and prints what the page says."""

import numpy as np

from support.pages import numbers, printed_and_said


def test_the_code_of_the_page_prints_what_it_says() -> None:
    lines, expected = printed_and_said("ties.md")
    assert len(lines) == len(expected)
    for line, wanted in zip(lines, expected, strict=True):
        assert np.allclose(numbers(line), numbers(wanted), atol=0.11), (line, wanted)
    # What the page claims: ties bring the last stop to within two sigmas of the truth, also if one is wrong.
    for line in lines[1:3]:
        off, sigma = numbers(line)
        assert off < 2 * sigma < 50
    assert "constraints[1] (landmark-position of" in lines[3]
