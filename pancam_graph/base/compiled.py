"""Loops that are compiled to machine code, kept on disk, and called without Numba.

Decorators: `entry` for functions that Python calls; `part`, `inlined` and `merged` for functions that only
other compiled functions call. Numba makes the machine code of an entry point at its first call, for the types
of its arguments (`by_numba`). The code is kept on disk (`kept_code`), and a later process links and calls it
without Numba (`native_code`), whose import and start take longer than a small solve.

Code is kept under a digest of all source files of the folder of its entry point: after an edit of any of
them it is looked for under another name, and compiled anew. A folder whose entry points take parts from
another one names that: `Compiling(parts_from=...)`.

`uncounted` has the same decorators for functions that make no arrays. Numba counts references to arrays
wherever a function hands them on, which costs half the time of a loop that hands on thirty of them; without
counting, the caller must keep all arrays alive.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial, update_wrapper
from hashlib import sha256
from pathlib import Path
from threading import RLock
from typing import Any, TypeVar, cast

import numpy as np

from pancam_graph.base.kept_code import KeptCode
from pancam_graph.base.native_code import NativeCode, NativeFunction, NotNativeError, OtherArraysError
from pancam_graph.base.parts import Part

__all__ = [
    "Compiling",
    "Entry",
    "chosen",
    "entry",
    "folder_digest",
    "inlined",
    "is_on_disk",
    "part",
    "uncounted",
]

_F = TypeVar("_F", bound=Callable[..., Any])
_LOCK = RLock()
"""Held while code is compiled or linked: several threads may call an entry point for the first time."""


@cache
def folder_digest(folder: Path) -> str:
    """A digest, 12 digits, of the names and contents of the Python files of a folder.

    Folders within are left out. The files are read once per process.
    """
    running = sha256()
    for path in sorted(folder.glob("*.py")):
        running.update(f"{path.name}\0".encode())
        running.update(path.read_bytes() + b"\0")
    return running.hexdigest()[:12]


def _is_off() -> bool:
    """Whether compilation is switched off: functions then are plain Python."""
    return os.environ.get("NUMBA_DISABLE_JIT", "") not in {"", "0"}


class _CallablePart(Part):
    """A part that tests call."""

    def __call__(self, *arguments: Any) -> Any:
        """Call it from Python: it is compiled in every process."""
        from pancam_graph.base.by_numba import part_dispatcher  # noqa: PLC0415  late: it imports Numba

        return part_dispatcher(self, for_python=True)(*arguments)


class Entry:
    """A compiled function that Python calls: with arrays, numbers, and tuples of these.

    Releases the interpreter's lock. A reference to each argument must be held until it returns.
    """

    def __init__(
        self, function: Callable[..., Any], options: dict[str, Any], folders: Sequence[Path]
    ) -> None:
        """`options` are those of Numba; `folders` have the sources that the code depends on."""
        update_wrapper(self, function)
        self._function = function
        self._options = options
        self._kept = KeptCode(
            folder=Path(function.__code__.co_filename).parent,
            name=_name(function),
            sources=partial(_digests, tuple(folders)),
        )
        self._linked = dict[tuple[Any, ...], NativeFunction]()
        """Code by what it is compiled for."""
        self._plans = dict[tuple[type, ...], _Plan]()
        """How arguments of some classes were handed on last."""
        self._dispatcher: Any = None
        """Numba's, where its code cannot be called without it."""
        self.n_found = 0
        """For how many types of arguments the code was on disk."""

    def __call__(self, *arguments: Any) -> Any:
        """Call the code for these types of arguments; the first call finds it on disk or compiles it.

        Raises TypeError for arguments of other kinds, RuntimeError where the code runs out of memory.
        """
        if self._dispatcher is not None:
            return self._dispatcher(*arguments)
        outer = tuple(map(type, arguments))
        plan = self._plans.get(outer)
        values = None if plan is None else plan.leaves(arguments)
        if plan is not None and values is not None:
            with suppress(OtherArraysError):
                return plan.native(*plan.handed(values))
        native = self._ready(arguments)
        if native is None:
            return self(*arguments)
        plan = self._plans[outer] = _Plan.of(arguments, native)
        values = plan.leaves(arguments)
        assert values is not None  # it is their own plan
        return native(*plan.handed(values), checked=True)

    @property
    def signatures(self) -> list[tuple[Any, ...]]:
        """The types of arguments for which the code is in memory."""
        return list(self._linked)

    @property
    def sources(self) -> str:
        """The digests of the sources that the code depends on."""
        return self._kept.sources()

    @property
    def is_on_disk(self) -> bool:
        """Whether code of the present sources is on disk, for any types of arguments."""
        return self._kept.is_there

    def _ready(self, arguments: tuple[Any, ...]) -> NativeFunction | None:
        """The code for the types of some arguments; None where only Numba's dispatcher can call it."""
        key = tuple(_kinds(arguments))
        with _LOCK:
            if key in self._linked or self._dispatcher is not None:
                return self._linked.get(key)
            name = " ".join(map(_word, key))
            for code in self._kept.found(name):
                try:
                    self._linked[key] = code.linked(_dtypes(key))
                except NotNativeError as error:
                    self._kept.say_damaged(error)
                else:
                    self.n_found += 1
                    return self._linked[key]
            return self._compiled(key, name, arguments)

    def _compiled(self, key: tuple[Any, ...], name: str, arguments: tuple[Any, ...]) -> NativeFunction | None:
        from pancam_graph.base import by_numba  # noqa: PLC0415  late: it imports Numba

        try:
            code: NativeCode = by_numba.native_code(self._function, self._options, arguments)
            linked = code.linked(_dtypes(key))
        except NotNativeError as error:
            self._kept.say_lost(f"cannot be called without Numba ({error})")
            self._dispatcher = by_numba.dispatcher(self._function, self._options, for_python=True)
            return None
        self._kept.keep(name, code)
        self._linked[key] = linked
        return linked


def _name(function: Callable[..., Any]) -> str:
    """Module, qualified name, and the numbers that tell functions made by one function from each other."""
    qualified = function.__qualname__.replace("<locals>.", "")
    numbers = [cell.cell_contents for cell in function.__closure__ or ()]
    own = [str(number) for number in numbers if isinstance(number, (int, float))]
    return "-".join((f"{Path(function.__code__.co_filename).stem}.{qualified}", *own))


def _digests(folders: tuple[Path, ...]) -> str:
    return "-".join(folder_digest(folder) for folder in folders)


def _word(kind: Any) -> str:
    if isinstance(kind, np.dtype):
        return kind.str
    return kind.__qualname__ if isinstance(kind, type) else str(kind)


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """How arguments of some classes are handed on: learnt once, since calls are short and many."""

    native: NativeFunction
    tuples: tuple[tuple[int, type, int], ...]
    """Tuples in the order in which they are opened: place, class and length of each."""
    classes: tuple[type, ...]
    """Classes of what is left when all are open."""
    whole: tuple[int, ...]
    """Places of whole numbers among these."""
    real: tuple[int, ...]
    """Places of other numbers."""

    @staticmethod
    def of(arguments: Sequence[Any], native: NativeFunction) -> "_Plan":
        """The plan for arguments that code takes. Raises TypeError where they are no arrays or numbers."""
        values, tuples = list[Any](arguments), list[tuple[int, type, int]]()
        whole, real, at = list[int](), list[int](), 0
        while at < len(values):
            value = values[at]
            if isinstance(value, tuple):
                tuples.append((at, type(value), len(value)))
                values[at : at + 1] = value
                continue
            if isinstance(value, (bool, np.bool_, int, np.integer)):
                whole.append(at)
            elif isinstance(value, (float, np.floating)):
                real.append(at)
            elif not isinstance(value, np.ndarray):
                raise TypeError(
                    f"compiled functions take arrays, numbers and tuples of these, not {type(value)}"
                )
            at += 1
        return _Plan(
            native=native,
            tuples=tuple(tuples),
            classes=tuple(map(type, values)),
            whole=tuple(whole),
            real=tuple(real),
        )

    def leaves(self, arguments: Sequence[Any]) -> list[Any] | None:
        """Arrays and numbers of some arguments, in order; None where they are not of the plan's classes."""
        values = list[Any](arguments)
        for at, own, length in self.tuples:
            if type(values[at]) is not own or len(values[at]) != length:
                return None
            values[at : at + 1] = values[at]
        return values if tuple(map(type, values)) == self.classes else None

    def handed(self, values: list[Any]) -> tuple[list[int], list[float]]:
        """Words and other numbers for the code, of `leaves`: of arrays the addresses of their objects."""
        words = list(map(id, values))
        for at in self.whole:
            words[at] = int(values[at])
        for at in reversed(self.real):
            del words[at]
        return words, [float(values[at]) for at in self.real]


def _kinds(values: Sequence[Any]) -> Iterator[Any]:
    """What code is compiled for: of an array its numbers' type, dimensions and order."""
    for value in values:
        if isinstance(value, np.ndarray):
            if not value.flags.aligned:
                raise TypeError("compiled functions take aligned arrays")
            yield from (value.dtype, value.ndim, "C" if value.flags.c_contiguous else "A")
        elif isinstance(value, tuple):
            yield from (type(value), len(value), *_kinds(value))
        elif isinstance(value, (bool, np.bool_)):
            yield "bool"
        else:
            yield "int" if isinstance(value, (int, np.integer)) else "float"


def _dtypes(key: tuple[Any, ...]) -> tuple[np.dtype[Any], ...]:
    return tuple(kind for kind in key if isinstance(kind, np.dtype))


@dataclass(frozen=True)
class Compiling:
    """A way to compile functions: for this machine, without the interpreter's lock, dividing as NumPy does.

    A product and a sum may be fused into one operation, which rounds once instead of twice; no operations are
    reordered.
    """

    counts_references: bool = True
    """Whether Numba counts references to arrays: needed where a function makes arrays."""
    parts_from: tuple[Path, ...] = ()
    """Other folders that have parts of the entry points: their sources are in the digest too."""

    def entry(self, function: _F) -> _F:
        """Compile a function that Python calls, and keep the machine code on disk."""
        if _is_off():
            return function
        folders = (Path(function.__code__.co_filename).parent, *self.parts_from)
        return cast(_F, Entry(function, self._options(), folders))

    def part(self, function: _F) -> _F:
        """Compile a function that only compiled functions call."""
        return self._part(function)

    def inlined(self, function: _F) -> _F:
        """Copy the body of a function into each compiled function that calls it.

        For functions with so many arguments that a call would cost as much as their work.
        """
        return self._part(function, inline="always")

    def merged(self, function: _F) -> _F:
        """Copy a function as `inlined` does, but not before LLVM: what is copied is not typed again.

        For functions that other functions of this kind call, and that take many arrays: a call hands on each
        array as a dozen numbers.
        """
        return self._part(function, forceinline=True)

    def _part(self, function: _F, **more: Any) -> _F:
        return function if _is_off() else cast(_F, _CallablePart(function, self._options(**more)))

    def _options(self, **more: Any) -> dict[str, Any]:
        counting = {} if self.counts_references else {"_nrt": False}
        return {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}} | counting | more


_counted = Compiling()
entry, part, inlined = _counted.entry, _counted.part, _counted.inlined
uncounted = Compiling(counts_references=False)


def chosen(choose: Callable[[_F], Callable[..., Any]]) -> Callable[[_F], _F]:
    """Decorate a part whose form in compiled functions `choose` returns, given the function in plain Python.

    It is asked when a function that calls the part is compiled.
    """

    def decorate(function: _F) -> _F:
        part = _CallablePart(function, _counted._options(), choose)
        return function if _is_off() else cast(_F, part)

    return decorate


def is_on_disk(function: Callable[..., Any]) -> bool:
    """Whether an entry point was compiled before, from the present sources: its next call then is quick.

    True where compilation is switched off (NUMBA_DISABLE_JIT), and where its code is in memory: the disk is
    then not looked at.
    """
    return not isinstance(function, Entry) or bool(function.signatures) or function.is_on_disk
