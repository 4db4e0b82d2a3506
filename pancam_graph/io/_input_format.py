"""What `read_input` must know of a format of input folders; each format's module fills in one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pancam_graph.data import Traverse

__all__ = ["InputFormat"]


@dataclass(frozen=True, kw_only=True)
class InputFormat:
    """A format of input folders."""

    needs: str
    """What a folder of the format has, as error messages say it."""
    matches: Callable[[Sequence[str]], bool]
    """Whether a folder with files of these names is of the format."""
    read: Callable[[Path, Sequence[Path]], Traverse]
    """Read a drive from one or more folders that lie within the first argument, which becomes its `folder`.

    Raises InputError saying where, what was expected and what was found.
    """
