"""The spacecraft's clock at the start of an exposure, in one spelling whatever the label's."""

from pancam_graph.io._told_numbers import told_number

__all__ = ["plain_clock"]

_LONGEST = 40


def plain_clock(text: str) -> str | None:
    """A clock count without partition and outer zeros, so that equal counts are equal texts; None for none.

    `1/0000010332.16244` and `10332.16244` are one count. Behind the point may be ticks: it stays text.
    """
    count = text.strip().strip('"').rpartition("/")[2]
    number = told_number(count)
    if number is None:
        return None
    whole, _, ticks = count.partition(".")
    return f"{whole.lstrip('0') or '0'}.{ticks.rstrip('0')}"[:_LONGEST]
