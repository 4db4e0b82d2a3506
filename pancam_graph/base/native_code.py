"""Machine code that Numba made, linked and called without Numba.

The code of an entry point is two objects: its loop, as Numba compiles it, and a `call` that LLVM makes of the
way Numba hands on arguments. `call` takes the addresses of arrays as Python objects and reads where their
numbers are and how they lie from the head of NumPy's C struct; the layout is tried once in each process.
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
from typing import Any

import numpy as np

__all__ = ["ARRAY_HEAD", "NativeCode", "NativeFunction", "NotNativeError", "environment"]

ARRAY_HEAD = object.__basicsize__
"""Bytes in an array's object before its C struct: address of the numbers, an int, then addresses of its shape
and its strides (`PyArrayObject_fields`)."""
_LOOPS = ("compiled.py", "by_numba.py", "native_code.py")
"""Files of this folder that decide what code is like."""
_ENGINES = list[Any]()
"""What owns the linked code: it stays to the end of the process."""


class NotNativeError(Exception):
    """Why code cannot be called without Numba."""


@dataclass(frozen=True, kw_only=True)
class NativeCode:
    """The machine code of an entry point for some types of arguments."""

    objects: tuple[bytes, ...]
    """Object files."""
    outside: tuple[str, ...]
    """Functions of the C library that they call."""
    returns: str
    """"none", "int" or "float"."""

    def linked(self) -> "NativeFunction":
        """Bring the code into memory.

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
        return NativeFunction(address, self.returns)


class NativeFunction:
    """Linked code of an entry point."""

    def __init__(self, address: int, returns: str) -> None:
        self._function = _CALL(address)
        self._returns = returns

    def __call__(self, words: Sequence[int], numbers: Sequence[float]) -> int | float | None:
        """Call it with addresses of arrays and whole numbers, and with other numbers, in order.

        Raises RuntimeError where it ends with Numba's sign of an exception: it found no memory.
        """
        result = ctypes.c_double() if self._returns == "float" else ctypes.c_int64()
        if self._function(_words(len(words))(*words), _numbers(len(numbers))(*numbers), ctypes.byref(result)):
            raise RuntimeError("compiled code failed, probably for want of memory")
        return None if self._returns == "none" else result.value


_CALL = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


@cache
def _words(n: int) -> Any:
    return ctypes.c_int64 * n


@cache
def _numbers(n: int) -> Any:
    return ctypes.c_double * n


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
    trial = np.empty((3, 4))[:, ::2]
    word = ctypes.sizeof(ctypes.c_void_p)
    fields = (ctypes.c_int64 * 5).from_address(id(trial) + ARRAY_HEAD)
    if word != 8 or sys.implementation.name != "cpython" or trial.ctypes.data != fields[0]:
        raise NotNativeError("arrays of this NumPy are laid out in another way")
    shape = (ctypes.c_int64 * 2).from_address(fields[2])
    strides = (ctypes.c_int64 * 2).from_address(fields[3])
    if tuple(shape) != trial.shape or tuple(strides) != trial.strides:
        raise NotNativeError("arrays of this NumPy are laid out in another way")
