"""Functions that only compiled functions call."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

__all__ = ["Part"]


@dataclass(frozen=True, eq=False)
class Part:
    """A function for compiled functions. Numba sees it only when one of these is compiled."""

    plain: Callable[..., Any]
    """The function in Python."""
    options: dict[str, Any]
    """Those of Numba."""
    choose: Callable[[Any], Callable[..., Any]] = lambda plain: plain
    """Returns the function that is compiled in its place."""
