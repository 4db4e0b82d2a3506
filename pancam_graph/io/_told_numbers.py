"""Numbers as labels tell them in text: plain ones only, so that UNK, N/A, NaN and 1_0 are none."""

import re

__all__ = ["told_number"]

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,4})?", re.ASCII)
_LONGEST = 60
_NO_VALUE = 1e29
"""Numbers from this on mean none: labels have 1e30 where telemetry has no value."""


def told_number(text: str) -> float | None:
    """The number that a text tells, blanks around it left out; None for a text that tells none."""
    text = text.strip()
    if len(text) > _LONGEST or _NUMBER.fullmatch(text) is None:
        return None
    number = float(text)
    return number if abs(number) < _NO_VALUE else None
