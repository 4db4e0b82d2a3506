"""One sentence for a name that is not among those that there are."""

from collections.abc import Iterable, Sequence

__all__ = ["expected_one_of", "nearest", "some_of"]

_NAMED = 6


def expected_one_of(what: str, found: str, names: Sequence[str]) -> str:
    """Say what was expected, what was found, and which name is near it: "frame: expected one of f0, f1; ...".

    `what` begins the sentence.
    """
    return f"{what}: expected one of {some_of(names)}; found {found!r}{nearest(found, names)}"


def nearest(word: str, names: Iterable[str]) -> str:
    """The end of a sentence about an unknown word: the name that is probably meant, or nothing."""
    from difflib import get_close_matches  # noqa: PLC0415  help of the command does not wait for it

    near = get_close_matches(str(word), list(names), n=1, cutoff=0.5)
    return f"; is {near[0]!r} meant?" if near else ""


def some_of(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    shown = ", ".join(names[:_NAMED])
    return shown if len(names) <= _NAMED else f"{shown} and {len(names) - _NAMED} more"
