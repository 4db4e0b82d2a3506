"""Arrays that a caller or a file gives, turned into float64 and int64: nothing is dropped on the way."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError, PancamGraphError
from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = ["float_array", "int_array"]


def float_array(name: str, values: Any, error: type[PancamGraphError] = InputError) -> FloatArray:
    """Numbers as float64 in the byte order of the machine and in C order; the same array if it is that.

    Shapes and values, NaN included, are for the caller to check. Raises `error`, which names them, for
    complex numbers, truth values, texts, objects, ragged lists and masked entries.
    """
    array = _plain_array(name, values, "numbers", error)
    if array.dtype.kind not in "fiu":
        raise error(f"{name}: expected numbers, found {array.dtype}")
    return np.asarray(array, dtype=np.float64, order="C")


def int_array(name: str, values: Any, error: type[PancamGraphError] = InputError) -> IntArray:
    """Integers as int64, as `float_array` does; floats are refused too, and integers from 2^63."""
    array = _plain_array(name, values, "integers", error)
    if array.dtype.kind not in "iu" and array.size:
        raise error(f"{name}: expected integers, found {array.dtype}")
    if array.dtype.kind == "u" and array.size and array.max() > np.iinfo(np.int64).max:
        raise error(f"{name}: expected integers below 2^63, found {array.max()}")
    return np.asarray(array, dtype=np.int64, order="C")


def _plain_array(name: str, values: Any, expected: str, error: type[PancamGraphError]) -> NDArray[Any]:
    # NumPy imports its masked arrays when they are first asked for.
    is_special = isinstance(values, np.ndarray) and type(values) is not np.ndarray
    is_masked = is_special and isinstance(values, np.ma.MaskedArray)
    if is_masked and (masked := int(np.sum(np.ma.getmaskarray(values)))):
        raise error(f"{name}: expected {expected}, found {masked} masked entries")
    try:
        return np.asarray(values)
    except (TypeError, ValueError, OverflowError) as problem:
        raise error(f"{name}: expected {expected}, found {type(values).__name__} ({problem})") from problem
