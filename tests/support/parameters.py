"""Parameters of tests."""

from collections.abc import Iterable
from typing import Any

import pytest

__all__ = ["slow_but_for", "slow_for"]


def slow_for(slow: str, names: Iterable[str]) -> list[Any]:
    """The names as parameters of a test, with `slow` marked so. Raises ValueError if it is no name."""
    listed = list(names)
    listed.index(slow)
    return [pytest.param(name, marks=pytest.mark.slow) if name == slow else name for name in listed]


def slow_but_for(fast: str, names: Iterable[str]) -> list[Any]:
    """The names as parameters of a test, all but `fast` marked slow. Raises ValueError if it is no name."""
    listed = list(names)
    listed.index(fast)
    return [name if name == fast else pytest.param(name, marks=pytest.mark.slow) for name in listed]
