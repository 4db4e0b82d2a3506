"""Parameters of tests."""

from collections.abc import Iterable
from typing import Any

import pytest

__all__ = ["slow_but_for", "slow_for"]


def slow_for(slow: str | list[Any], cases: Iterable[Any]) -> list[Any]:
    """The cases as parameters of a test, with `slow`, one of them or a list of some, marked so.

    A case is a value, or a tuple of values for several arguments. Raises ValueError if `slow` has no case.
    """
    listed = list(cases)
    marked = [slow] if isinstance(slow, str) else slow
    for case in marked:
        listed.index(case)
    return [_marked_slow(case) if case in marked else case for case in listed]


def slow_but_for(fast: str | list[Any], cases: Iterable[Any]) -> list[Any]:
    """The cases as parameters of a test, all marked slow but for `fast`, one of them or a list of some.

    A case is a value, or a tuple of values for several arguments. Raises ValueError if `fast` has no case.
    """
    listed = list(cases)
    kept = [fast] if isinstance(fast, str) else fast
    for case in kept:
        listed.index(case)
    return [case if case in kept else _marked_slow(case) for case in listed]


def _marked_slow(case: Any) -> Any:
    return pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
