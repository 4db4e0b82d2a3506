"""The page on factors of a caller's own: its code runs, and prints what the page says."""

import numpy as np

from support.pages import numbers, printed_and_said


def test_the_code_of_the_page_prints_what_it_says() -> None:
    lines, expected = printed_and_said("gtsam.md")
    assert len(lines) == len(expected)
    for line, wanted in zip(lines, expected, strict=True):
        assert np.allclose(numbers(line), numbers(wanted), atol=0.101), (line, wanted)
    # What the page claims: a distance and a receiver bring the stop nearer to the truth.
    alone, _, sigmas, gps = (numbers(line) for line in lines)
    assert sigmas[1] < sigmas[0]
    assert np.abs(gps[:2]).max() < max(2.0, np.abs(alone[:2]).max())
