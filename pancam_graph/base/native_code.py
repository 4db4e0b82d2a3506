"""Machine code that Numba made, linked and called without Numba.

The code of an entry point is two objects: its loop, as Numba compiles it, and a `call` that LLVM makes of the
way Numba hands on arguments. `call` takes the addresses of arrays as Python objects and reads where their
numbers are and how they lie from NumPy's C struct; the layout of that is tried once in each process. It also
sees whether the arrays are of the kinds that the code is for, in a tenth of the time that Python takes.
llvmlite alone links the objects; ctypes calls them, outside the interpreter's lock.
"""

import ctypes
import importlib.util
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from struct import pack
from typing import Any

import numpy as np

__all__ = [
    "ALIGNED",
    "ARRAY_FIELDS",
    "C_ORDER",
    "OTHER_ARRAYS",
    "NativeCode",
    "NativeFunction",
    "NotNativeError",
    "OtherArraysError",
    "environment",
]

ARRAY_FIELDS = {
    field: object.__basicsize__ + 8 * word
    for word, field in enumerate(("data", "ndim", "shape", "strides", "base", "dtype", "flags"))
}
"""Bytes of an array's object before each field of its C struct (`PyArrayObject_fields`)."""
C_ORDER, ALIGNED = 0x1, 0x100
"""Bits of its flags."""
OTHER_ARRAYS = -1000
"""What `call` returns for arrays of other kinds; Numba has no status of this number."""
_LOOPS = ("compiled.py", "by_numba.py", "native_code.py")
"""Files of this folder that decide what code is like."""
_WORD, _NUMBER = ctypes.c_int64, ctypes.c_double
_RESULTS: dict[str, Any] = {"none": lambda: None, "int": _WORD * 1, "float": _NUMBER * 1}
"""Where a result is written, by what is returned."""
_ENGINES = list[Any]()
"""What owns the linked code: it stays to the end of the process."""


class NotNativeError(Exception):
    """Why code cannot be called without Numba."""


class OtherArraysError(Exception):
    """The code was called with arrays of other kinds than those that it was compiled for."""


@dataclass(frozen=True, kw_only=True)
class NativeCode:
    """The machine code of an entry point for some types of arguments."""

    objects: tuple[bytes, ...]
    """Object files."""
    outside: tuple[str, ...]
    """Functions of the C library that they call."""
    returns: str
    """"none", "int" or "float"."""

    def linked(self, dtypes: Sequence[np.dtype[Any]]) -> "NativeFunction":
        """Bring the code, for arrays of some types of numbers, into memory.

        Raises NotNativeError where something that it needs is not there.
        """
        llvm = _llvm()
        _try_arrays()
        for name in self.outside:
            llvm.add_symbol(name, _address(name))
        module = llvm.parse_assembly("")
        module.triple = llvm.get_process_triple()
        machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
        engine = llvm.create_mcjit_compiler(module, machine)
        try:
            for content in self.objects:
                engine.add_object_file(llvm.ObjectFileRef.from_data(content))
            engine.finalize_object()
            address = engine.get_function_address("call")
        except RuntimeError as error:
            raise NotNativeError(str(error)) from error
        if not address:
            raise NotNativeError("it has no function to call")
        _ENGINES.append(engine)
        return NativeFunction(address, self.returns, dtypes)


class NativeFunction:
    """Linked code of an entry point."""

    def __init__(self, address: int, returns: str, dtypes: Sequence[np.dtype[Any]]) -> None:
        self._function = _CALL(address)
        self._result = _RESULTS[returns]
        self._dtypes = tuple(dtypes)  # keeps their addresses
        self._expected = (_WORD * len(dtypes))(*map(id, dtypes))

    def __call__(
        self, words: Sequence[int], numbers: Sequence[float], *, checked: bool = False
    ) -> int | float | None:
        """Call it with addresses of arrays and whole numbers, and with other numbers, in order.

        Raises OtherArraysError, unless the arrays were `checked`, and RuntimeError where the code ends with
        Numba's sign of an exception: it found no memory.
        """
        result = self._result()
        status = self._function(
            pack(f"={len(words)}q", *words),
            pack(f"={len(numbers)}d", *numbers),
            result,
            None if checked else self._expected,
        )
        if status == OTHER_ARRAYS:
            raise OtherArraysError
        if status:
            raise RuntimeError("compiled code failed, probably for want of memory")
        return None if result is None else result[0]


_CALL = ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_void_p] * 4)


@cache
def environment() -> str:
    """All that code depends on beside its sources: processor, versions, Numba's variables, this folder."""
    llvm = _llvm()
    own = sha256(b"\0".join((Path(__file__).parent / name).read_bytes() for name in _LOOPS)).hexdigest()
    variables = ("CPU_NAME", "CPU_FEATURES", "OPT", "ENABLE_AVX", "DEBUG", "DEBUGINFO", "BOUNDSCHECK")
    parts = (
        *(sys.version, np.__version__, sys.modules["llvmlite"].__version__, _numba_version(), own),
        *(llvm.get_process_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()),
        *(os.environ.get(f"NUMBA_{name}", "") for name in variables),
    )
    return sha256("\0".join(parts).encode()).hexdigest()


def _numba_version() -> str:
    """What tells the version of Numba, without an import of it; its metadata take ten times as long."""
    found = importlib.util.find_spec("numba")
    if found is None or found.origin is None:
        return ""
    folder = Path(found.origin).parent
    return sha256((folder / "_version.py").read_bytes()).hexdigest() + str(folder)


@cache
def _llvm() -> Any:
    import llvmlite.binding as llvm  # noqa: PLC0415  late: help and bad input need no code

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


@cache
def _address(name: str) -> int:
    """Where a function of the C library is."""
    for library in (None, "libm.so.6") if sys.platform.startswith("linux") else (None,):
        try:
            function = getattr(ctypes.CDLL(library), name)
        except (AttributeError, OSError):
            continue
        address = ctypes.cast(function, ctypes.c_void_p).value
        if address:
            return address
    raise NotNativeError(f"no function {name} in the C library")


@cache
def _try_arrays() -> None:
    """Raise NotNativeError where an array's object is not laid out as `call` reads it."""
    for trial in (np.empty((3, 4))[:, ::2], np.zeros((2, 5), dtype=np.int64)):
        if ctypes.sizeof(ctypes.c_void_p) != 8 or sys.implementation.name != "cpython":
            raise NotNativeError("objects of this Python are laid out in another way")
        head = (ctypes.c_int64 * 7).from_address(id(trial) + ARRAY_FIELDS["data"])
        data, ndim, shape, strides, _, dtype, flags = head
        found = (data, ndim & 0xFFFFFFFF, dtype, bool(flags & C_ORDER), bool(flags & ALIGNED))
        own = trial.flags
        if found != (trial.ctypes.data, 2, id(trial.dtype), own.c_contiguous, own.aligned):
            raise NotNativeError("arrays of this NumPy are laid out in another way")
        extents = tuple((ctypes.c_int64 * 2).from_address(shape))
        if (extents, tuple((ctypes.c_int64 * 2).from_address(strides))) != (trial.shape, trial.strides):
            raise NotNativeError("arrays of this NumPy are laid out in another way")
