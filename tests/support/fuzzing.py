"""Hostile files: mutations of bytes, texts, JSON and arrays by a seed, and what reading them must end in."""

import json
import math
import re
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from copy import deepcopy
from io import BytesIO
from pathlib import Path
from types import FrameType
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError

Arrays = dict[str, NDArray[Any]]

_HANG_S = 120
"""Seconds after which a case of some milliseconds has hung."""
_MOST_KB = 1 << 20
"""Growth of the process, kB, beyond which a file of some kB takes too much."""
_NUMBERS = ("0", "-1", "1e30", "1e308", "1e999", "-1e-320", "nan", "9" * 400, "2147483648", "0x1F", "1,5", "")
_TOKENS = (
    "(",
    ")",
    "{",
    "}",
    '"',
    "'",
    "=",
    "<",
    ">",
    "/*",
    "*/",
    "END",
    "\0",
    "\x1b[2J",
    "\u202e",
    "&",
    "#",
    "\n",
)
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1.5, 1e308, -1e308, 1e-320, math.nan, math.inf, 10**400, 2**63, "", "x", "a\nb",
    "\0", "\ud800", "x" * 5000, "../x", [], {}, [[]], [0] * 1000, {"a": {"b": {}}},
)  # fmt: skip


class Hang(Exception):  # noqa: N818  not of ours
    """A case that does not end."""


@contextmanager
def bounded() -> Iterator[None]:
    """Fail where the block hangs, or makes the process larger by a gigabyte."""

    def hang(_signal: int, _frame: FrameType | None) -> None:
        raise Hang

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    handler = signal.signal(signal.SIGALRM, hang)
    signal.alarm(_HANG_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < _MOST_KB


def outcome(read: Callable[[], object], place: Path) -> str:
    """The sentence with which a reader refuses a file or folder, "" for a result; anything else raises."""
    with bounded():
        try:
            read()
        except InputError as error:
            text = str(error)
            assert "\n" not in text, text
            assert str(place) in text, text
            assert "expected" in text, text
            return text
    return ""


# --- mutations ---


def mutated_bytes(rng: np.random.Generator, data: bytes, reach: int | None = None) -> bytes:
    """A few of: bits flipped, bytes set, cut out, doubled, inserted, and the end cut off.

    `reach` bytes from the beginning are meant, as headers are; None: all.
    """
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        if not out:
            break
        at = int(rng.integers(0, min(len(out), reach or len(out))))
        length = int(rng.integers(1, 1 + min(64, len(out))))
        kind = int(rng.integers(0, 7))
        if kind == 0:
            out[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            out[at : at + length] = rng.integers(0, 256, len(out[at : at + length]), dtype=np.uint8).tobytes()
        elif kind == 2:
            del out[at : at + length]
        elif kind == 3:
            out[at:at] = out[at : at + length]
        elif kind == 4:
            out[at:at] = bytes([int(rng.choice([0, 0xFF, 0x7F, 0x20]))]) * length
        elif kind == 5:
            out[at : at + 4] = int(rng.choice([0, 1, 0x7FFFFFFF, 0xFFFFFFFF])).to_bytes(4, "big")
        else:
            del out[at:]
    return bytes(out)


def mutated_text(rng: np.random.Generator, text: str) -> str:
    """A few of: a number or a word replaced, a line doubled, dropped or moved, a token or many put in."""
    for _ in range(int(rng.integers(1, 4))):
        lines = text.split("\n")
        row, kind = int(rng.integers(0, len(lines))), int(rng.integers(0, 7))
        if kind == 0:
            text = _replaced(rng, text, r"-?\d[\d.eE+-]*", _NUMBERS)
        elif kind == 1:
            text = _replaced(rng, text, r"[A-Za-z_]{3,}", (*_TOKENS, *_NUMBERS, "x" * 3000))
        elif kind == 2:
            text = "\n".join([*lines[: row + 1], *lines[row:]])
        elif kind == 3:
            text = "\n".join([*lines[:row], *lines[row + 1 :]])
        elif kind == 4:
            text = "\n".join([*lines[row:], *lines[:row]])
        else:
            at = int(rng.integers(0, len(text) + 1))
            token = str(rng.choice(_TOKENS)) * int(rng.choice([1, 2, 1000]))
            text = text[:at] + token + text[at:]
    return text


def _replaced(rng: np.random.Generator, text: str, pattern: str, by: tuple[str, ...]) -> str:
    found = list(re.finditer(pattern, text))
    if not found:
        return text
    match = found[int(rng.integers(0, len(found)))]
    return text[: match.start()] + by[int(rng.integers(0, len(by)))] + text[match.end() :]


def mutated_label(rng: np.random.Generator, text: str) -> bytes:
    """`mutated_text`, three times in ten with bytes changed too."""
    label = mutated_text(rng, text).encode("utf-8", "replace")
    return mutated_bytes(rng, label) if rng.random() < 0.3 else label


def mutated_tree(rng: np.random.Generator, tree: Any) -> Any:
    """A JSON value with an entry replaced, removed, renamed, doubled or put in the place of another."""
    tree = deepcopy(tree)
    for _ in range(int(rng.integers(1, 3))):
        places = list(_places(tree))
        if not places:
            return tree
        holder, key = places[int(rng.integers(0, len(places)))]
        kind = int(rng.integers(0, 6))
        if kind <= 2:
            holder[key] = deepcopy(_VALUES[int(rng.integers(0, len(_VALUES)))])
        elif kind == 3:
            del holder[key]
        elif kind == 4 and isinstance(holder, dict):
            holder[f"{key}_"] = holder.pop(key)
        elif isinstance(holder, list):
            holder.insert(key, deepcopy(holder[key]))
        else:
            other, at = places[int(rng.integers(0, len(places)))]
            holder[key] = deepcopy(other[at])
    return tree


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """All entries as a list or object, and the index or key in it."""
    children = (
        list(value.items())
        if isinstance(value, dict)
        else list(enumerate(value))
        if isinstance(value, list)
        else []
    )
    for key, child in children:
        yield value, key
        yield from _places(child)


def dumped(tree: Any) -> bytes:
    """JSON as a careless program writes it: NaN, and halves of characters."""
    return json.dumps(tree).encode()


def mutated_arrays(rng: np.random.Generator, arrays: Arrays) -> Arrays:
    """Arrays of which one is dropped, exchanged, or has another type, shape, or hostile numbers."""
    out = dict(arrays)
    names = list(out)
    name = names[int(rng.integers(0, len(names)))]
    array, kind = out[name], int(rng.integers(0, 12))
    if kind == 0:
        del out[name]
    elif kind == 1:
        out[name] = out[names[int(rng.integers(0, len(names)))]]
    elif kind == 2:
        other: Any = rng.choice(["<f2", ">f8", "<c16", "<i1", ">i4", "<u8", "?", "S3", "<U2", "O", "<M8[s]"])
        with np.errstate(all="ignore"), suppress(ValueError):  # a text that is no number
            out[name] = array.astype(other)
    elif kind == 3:
        out[name] = array[: int(rng.integers(0, len(array) + 1))] if array.ndim else array[None]
    elif kind == 4:
        out[name] = np.concatenate([np.atleast_1d(array)] * 2)
    elif kind == 5:
        out[name] = array.reshape(-1) if array.ndim != 1 else array[:, None]
    elif kind == 6:
        out[name] = array.T
    elif kind == 7:
        out[name] = np.zeros((), array.dtype)
    elif kind == 8:
        out[name] = rng.permutation(array) if array.ndim else array
    else:
        flat = array.reshape(-1).copy()
        rows = rng.integers(0, max(len(flat), 1), int(rng.integers(1, 4)))
        value = rng.choice([0, -1, 1, 2**31, 2**62, 1e-300, 1e18, 1e300, np.nan, np.inf])
        with np.errstate(all="ignore"):
            flat[rows[rows < len(flat)]] = np.array(value).astype(flat.dtype)  # of any type
        out[name] = flat.reshape(array.shape)
    return out


def packed(arrays: Arrays) -> bytes:
    """An archive of arrays; those of objects are pickled."""
    content = BytesIO()
    savez: Any = np.savez  # its stub takes every keyword for the flag allow_pickle
    savez(content, **arrays)
    return content.getvalue()


def claiming(arrays: Arrays, name: str, shape: tuple[int, ...]) -> bytes:
    """An archive of arrays, one of which says in its header that it has another shape."""
    content = BytesIO()
    with ZipFile(content, "w") as archive:
        for each, array in arrays.items():
            with archive.open(f"{each}.npy", "w") as member:
                header = {"descr": array.dtype.str, "fortran_order": False}
                npy.write_array_header_1_0(member, header | {"shape": shape if each == name else array.shape})
                member.write(array.tobytes())
    return content.getvalue()
