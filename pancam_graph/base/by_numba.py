"""Machine code of Python functions, made by Numba. The only module that imports it.

Numba compiles a function to one that takes arrays as a dozen numbers each. `call`, written in LLVM's own
instructions, takes these from the objects of arrays. Memory for arrays that a function makes comes from
malloc.
"""

from collections.abc import Callable, Iterator
from functools import cache
from types import CellType, CodeType, FunctionType
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba.core.runtime import nrtdynmod

from pancam_graph.base.native_code import (
    ALIGNED,
    ARRAY_FIELDS,
    C_ORDER,
    OTHER_ARRAYS,
    NativeCode,
    NotNativeError,
)
from pancam_graph.base.parts import Part

__all__ = ["dispatcher", "native_code", "part_dispatcher"]

types: Any = numba.types  # without types of their own
_WORD, _INT = ir.IntType(64), ir.IntType(32)
_NUMBER, _ADDRESS = ir.DoubleType(), ir.IntType(8).as_pointer()
_ALLOCATING = {"NRT_MemInfo_alloc_aligned", "NRT_MemInfo_alloc_safe_aligned"}
_FREEING = "NRT_MemInfo_call_dtor"
_OWNER = ir.LiteralStructType([_WORD, _ADDRESS, _ADDRESS, _ADDRESS, _WORD])
"""Numba's record of the memory of an array: references, destructor and its argument, address, size."""


def dispatcher(function: Callable[..., Any], options: dict[str, Any], *, for_python: bool) -> Any:
    """Numba's compiler of a function, whose parts are known to Numba too.

    Without `for_python` only other compiled functions can call the result.
    """
    wrappers = {} if for_python else {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    compiling: Any = numba.njit  # its types know nothing of the wrappers
    return compiling(**options, **wrappers)(_with_parts(function))


def native_code(
    function: Callable[..., Any], options: dict[str, Any], arguments: tuple[Any, ...]
) -> NativeCode:
    """The machine code of a function for the types of some arguments.

    Raises NotNativeError where it cannot be called without Numba. Errors of Numba's compiler pass through.
    """
    compiler = dispatcher(function, options, for_python=False)
    kinds = tuple(_type(value) for value in arguments)
    compiler.compile(kinds)
    (made,) = compiler.overloads.values()
    try:
        outside = _outside(made.library._final_module)
        loop = bytes(made.library._get_compiled_object())
        call, returns, allocates = _call(made, kinds, outside)
    except NotNativeError:
        raise
    except Exception as error:  # of Numba's insides, which change between versions
        raise NotNativeError(f"{type(error).__name__}: {error}") from error
    ours = {*_ALLOCATING, _FREEING}
    return NativeCode(
        objects=(loop, call),
        outside=tuple(sorted((outside - ours) | ({"malloc", "free"} if allocates else set()))),
        returns=returns,
    )


def _type(value: Any) -> Any:
    """Numba's type of an argument: arrays are writable, in C order or in any."""
    if isinstance(value, tuple):
        kinds = [_type(v) for v in value]
        return types.BaseTuple.from_types(kinds, None if type(value) is tuple else type(value))
    if isinstance(value, np.ndarray):
        layout = "C" if value.flags.c_contiguous else "A"
        return types.Array(numba.from_dtype(value.dtype), value.ndim, layout)
    if isinstance(value, (bool, np.bool_)):
        return types.boolean
    return types.int64 if isinstance(value, (int, np.integer)) else types.float64


# --- functions with their parts ---


@cache
def part_dispatcher(part: Part, *, for_python: bool = False) -> Any:
    """Numba's compiler of a part, the same for all functions that call it."""
    return dispatcher(part.choose(part.plain), part.options, for_python=for_python)


def _with_parts(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that refers to Numba's compilers of its parts, where it referred to the parts."""
    assert isinstance(function, FunctionType)
    names = set(_names(function.__code__))
    known = {n: v for n, v in function.__globals__.items() if n in names and isinstance(v, Part)}
    parts = {name: part_dispatcher(part) for name, part in known.items()}
    cells = function.__closure__ or ()
    replaced = tuple(
        CellType(part_dispatcher(cell.cell_contents)) if isinstance(cell.cell_contents, Part) else cell
        for cell in cells
    )
    if not parts and replaced == cells:
        return function
    out = FunctionType(
        function.__code__, function.__globals__ | parts, function.__name__, function.__defaults__, replaced
    )
    out.__qualname__, out.__kwdefaults__ = function.__qualname__, function.__kwdefaults__
    return out


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


# --- calls ---


def _outside(module: Any) -> set[str]:
    """The functions that a module calls and does not have.

    Raises NotNativeError where it needs anything else.
    """
    for variable in module.global_variables:
        if variable.is_declaration:
            raise NotNativeError(f"it needs {variable.name}")
    names = {f.name for f in module.functions if f.is_declaration and not f.name.startswith("llvm.")}
    inside = sorted(
        n for n in names - {*_ALLOCATING, _FREEING} if n.startswith(("NRT_", "numba_", "Py", "_"))
    )
    if inside:
        raise NotNativeError(f"it needs {', '.join(inside)}")
    return names


def _call(made: Any, kinds: tuple[Any, ...], outside: set[str]) -> tuple[bytes, str, bool]:
    """The object of `call`, what it returns, and whether it has the functions that allocate memory."""
    module = ir.Module("call")
    module.triple = llvm.get_process_triple()
    result = made.signature.return_type
    context = made.target_context
    loop = ir.Function(module, context.call_conv.get_function_type(result, kinds), made.fndesc.llvm_func_name)
    call = ir.Function(
        module,
        ir.FunctionType(_INT, [a.as_pointer() for a in (_WORD, _NUMBER, _WORD, _WORD)]),
        "call",
    )
    builder = ir.IRBuilder(call.append_basic_block())
    returned, failed, *places = loop.args
    unpacking = _Unpacking(builder, call.args[0], call.args[1])
    unpacking.check(kinds, call.args[3])
    values = list(unpacking.values(kinds))
    if len(values) != len(places):
        raise NotNativeError("Numba hands on arrays in another way")
    out = builder.alloca(returned.type.pointee)
    builder.store(ir.Constant(returned.type.pointee, None), out)
    failure = builder.alloca(failed.type.pointee)
    fitted = [_fitted(builder, v, p.type) for v, p in zip(values, places, strict=True)]
    status = builder.call(loop, [out, failure, *fitted])
    if isinstance(result, types.NoneType):
        returns = "none"
    elif isinstance(result, types.Float) and returned.type.pointee == _NUMBER:
        returns = "float"
        builder.store(builder.load(out), builder.bitcast(call.args[2], _NUMBER.as_pointer()))
    elif isinstance(result, types.Integer):
        returns = "int"
        builder.store(_fitted(builder, builder.load(out), _WORD), call.args[2])
    else:
        raise NotNativeError(f"it returns {result}")
    builder.ret(status)
    allocates = bool(outside & {*_ALLOCATING, _FREEING})
    if allocates:
        _allocation(module, sorted(outside & _ALLOCATING))
    return _object(module), returns, allocates


class _Unpacking:
    """The numbers that Numba's code takes, from addresses of arrays and from numbers."""

    def __init__(self, builder: Any, words: Any, numbers: Any) -> None:
        self._builder, self._words, self._numbers = builder, words, numbers
        self._n_words = self._n_numbers = 0

    def check(self, kinds: Any, expected: Any) -> None:
        """Return from `call` if arrays are not of some types, unless `expected` is no address.

        That is the address of those of their numbers' types (NumPy's objects).
        """
        builder, wrong = self._builder, ir.Constant(ir.IntType(1), 0)
        with builder.if_then(builder.icmp_unsigned("!=", expected, ir.Constant(expected.type, None))):
            for number, (place, kind) in enumerate(_arrays(kinds)):
                address = builder.load(builder.gep(self._words, [_WORD(place)]))
                dtype = builder.load(builder.gep(expected, [_WORD(number)]))
                flags = self._field(address, "flags", _INT)
                bits = _INT(ALIGNED | (C_ORDER if kind.layout == "C" else 0))
                for is_wrong in (
                    builder.icmp_unsigned("!=", self._field(address, "dtype", _WORD), dtype),
                    builder.icmp_unsigned("!=", self._field(address, "ndim", _INT), _INT(kind.ndim)),
                    builder.icmp_unsigned("!=", builder.and_(flags, bits), bits),
                ):
                    wrong = builder.or_(wrong, is_wrong)
            with builder.if_then(wrong):
                builder.ret(_INT(OTHER_ARRAYS))

    def _field(self, address: Any, name: str, kind: Any) -> Any:
        """A field of an array, by the address of its object."""
        place = self._builder.add(address, _WORD(ARRAY_FIELDS[name]))
        return self._builder.load(self._builder.inttoptr(place, kind.as_pointer()))

    def values(self, kinds: Any) -> Iterator[Any]:
        """The values of arguments of some types, in order."""
        for kind in kinds:
            if isinstance(kind, types.BaseTuple):
                yield from self.values(kind.types)
            elif isinstance(kind, types.Array):
                yield from self._array(self._word(), kind)
            elif isinstance(kind, types.Float):
                place = self._builder.gep(self._numbers, [_WORD(self._n_numbers)])
                self._n_numbers += 1
                yield self._builder.load(place)
            else:
                yield self._word()

    def _word(self) -> Any:
        place = self._builder.gep(self._words, [_WORD(self._n_words)])
        self._n_words += 1
        return self._builder.load(place)

    def _array(self, address: Any, kind: Any) -> Iterator[Any]:
        """Owner and Python object (none), entries, bytes of one, address, shape, strides."""
        builder = self._builder

        def column(name: str) -> list[Any]:
            first = builder.inttoptr(self._field(address, name, _WORD), _WORD.as_pointer())
            return [builder.load(builder.gep(first, [_WORD(k)])) for k in range(kind.ndim)]

        shape, strides = column("shape"), column("strides")
        entries = _WORD(1)
        for extent in shape:
            entries = builder.mul(entries, extent)
        size = np.dtype(str(kind.dtype) if kind.dtype is not types.boolean else "?").itemsize
        data = self._field(address, "data", _WORD)
        yield from (_WORD(0), _WORD(0), entries, _WORD(size), data, *shape, *strides)


def _arrays(kinds: Any) -> list[tuple[int, Any]]:
    """The types of all arrays among arguments of some types, each with its place among the words."""
    out, n_words, waiting = list[tuple[int, Any]](), 0, list(kinds)[::-1]
    while waiting:
        kind = waiting.pop()
        if isinstance(kind, types.BaseTuple):
            waiting += list(kind.types)[::-1]
        elif isinstance(kind, types.Array):
            out.append((n_words, kind))
            n_words += 1
        else:
            n_words += not isinstance(kind, types.Float)
    return out


def _fitted(builder: Any, value: Any, kind: Any) -> Any:
    """A number as the type that is expected of it: an address, or with more or fewer bits."""
    if isinstance(kind, ir.PointerType):
        return builder.inttoptr(value, kind)
    if not isinstance(kind, ir.IntType):
        return value
    if kind.width > value.type.width:
        return builder.sext(value, kind)
    return builder.trunc(value, kind) if kind.width < value.type.width else value


def _allocation(module: Any, allocating: list[str]) -> None:
    """Add the functions with which Numba's code makes and drops the memory of arrays."""
    if str(nrtdynmod._meminfo_struct_type) != str(_OWNER):
        raise NotNativeError("Numba owns memory in another way")
    malloc = ir.Function(module, ir.FunctionType(_ADDRESS, [_WORD]), "malloc")
    free = ir.Function(module, ir.FunctionType(ir.VoidType(), [_ADDRESS]), "free")
    for name in allocating:
        function = ir.Function(module, ir.FunctionType(_ADDRESS, [_WORD, _INT]), name)
        builder = ir.IRBuilder(function.append_basic_block())
        size, align = function.args[0], builder.zext(function.args[1], _WORD)
        head = _WORD(64)  # more than the record's bytes
        memory = builder.call(malloc, [builder.add(builder.add(size, align), head)])
        with builder.if_then(builder.icmp_unsigned("==", memory, ir.Constant(_ADDRESS, None))):
            builder.ret(memory)
        first = builder.add(builder.add(builder.ptrtoint(memory, _WORD), head), builder.sub(align, _WORD(1)))
        address = builder.inttoptr(builder.and_(first, builder.neg(align)), _ADDRESS)
        none = ir.Constant(_ADDRESS, None)
        owner = builder.bitcast(memory, _OWNER.as_pointer())
        for field, value in enumerate((_WORD(1), none, none, address, size)):
            builder.store(value, builder.gep(owner, [_INT(0), _INT(field)]))
        builder.ret(memory)
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [_ADDRESS]), _FREEING)
    builder = ir.IRBuilder(function.append_basic_block())
    builder.call(free, [function.args[0]])
    builder.ret_void()


def _object(module: Any) -> bytes:
    """Machine code of a module, for this processor."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    parsed = llvm.parse_assembly(str(module))
    parsed.verify()
    machine = llvm.Target.from_default_triple().create_target_machine(jit=True, codemodel="jitdefault")
    return bytes(machine.emit_object(parsed))
