"""Compiled loops that write rows of a table as text: ten significant digits, those that Python writes.

Python's `format(x, ".10g")` takes half a microsecond a number. Here the ten digits are those of the integer
next to x times a power of ten. A product of two doubles is off by 1e-16 of itself, that is by 1e-6 of the
last digit: a number whose product is closer than `_NEAR` to the middle of two integers, and one that `.10g`
writes with an exponent, is left to Python.
"""

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.compiled import entry, part
from pancam_graph.base.geometry import FloatArray, IntArray

Bytes = NDArray[np.uint8]

__all__ = ["NAME", "NUMBER", "ROOM", "WHOLE", "write_rows"]

NAME, WHOLE, NUMBER = 0, 1, 2
"""Kinds of columns: a row of a list of texts, a whole number, a decimal number with ten digits."""
ROOM = 24
"""Bytes of 0 in place of a number that is left to Python: no text of `.10g` is longer."""
_NEAR = 1e-4
_DIGITS = 10
_FEWEST = -4
"""The smallest power of ten whose numbers `.10g` writes without an exponent; the largest is 10^9."""
_POWERS = np.array([float(f"1e{k}") for k in range(_FEWEST, _DIGITS + 1)])
_SCALES = np.array([float(f"1e{k}") for k in range(_DIGITS - _FEWEST)])


@part
def _decimal(a: float) -> tuple[int, int]:
    """The ten digits of a positive number as an integer, and the power of ten of the first; 0: Python's."""
    if not _POWERS[0] <= a < _POWERS[-1]:
        return 0, 0
    power = _FEWEST
    while a >= _POWERS[power + 1 - _FEWEST]:
        power += 1
    scaled = a * _SCALES[_DIGITS - 1 - power]
    digits = int(scaled)
    over = scaled - digits
    if abs(over - 0.5) < _NEAR:
        return 0, 0
    if over > 0.5:
        digits += 1
    if digits == 10_000_000_000:
        digits, power = 1_000_000_000, power + 1
    return (0, 0) if power >= _DIGITS else (digits, power)


@part
def _whole(value: int, out: Bytes, at: int) -> int:
    if value < 0:
        out[at] = 45
        at += 1
    else:
        value = -value  # the most negative number has no positive equal
    first = at
    while True:
        digit = value % -10
        out[at] = 48 - digit
        at += 1
        value = (value - digit) // 10
        if value == 0:
            break
    last = at - 1
    while first < last:
        out[first], out[last] = out[last], out[first]
        first, last = first + 1, last - 1
    return at


@part
def _number(x: float, digits: int, power: int, out: Bytes, at: int) -> int:
    if x < 0:
        out[at] = 45
        at += 1
    n = _DIGITS
    while n > 1 and digits % 10 == 0:  # zeros at the end
        digits //= 10
        n -= 1
    if power < 0:
        out[at], out[at + 1] = 48, 46
        at += 2
        for _ in range(-power - 1):
            out[at] = 48
            at += 1
        for k in range(n - 1, -1, -1):
            out[at + k] = 48 + digits % 10
            digits //= 10
        return at + n
    for _ in range(n, power + 1):  # zeros in front of the point
        digits *= 10
    n = max(n, power + 1)
    width = n + 1 if n > power + 1 else n
    for k in range(width - 1, -1, -1):
        if k == power + 1:
            out[at + k] = 46
        else:
            out[at + k] = 48 + digits % 10
            digits //= 10
    return at + width


@entry
def write_rows(
    kind: IntArray,
    whole: IntArray,
    numbers: FloatArray,
    text: Bytes,
    begin: IntArray,
    out: Bytes,
    late: IntArray,
    late_number: FloatArray,
) -> int:
    """Write rows of cells with commas between and line feeds after into `out`; returns how many bytes.

    `kind` (columns,) is NAME, WHOLE or NUMBER. `whole` (rows, of these columns) has for a name its row among
    the texts that `begin` (texts + 1,) cuts `text` into; `numbers` (rows, the other columns) is empty text
    where it is not finite. Numbers left to Python have ROOM bytes of 0; `late` and `late_number` get the
    places and values of these, and then a place of -1 where there is room for more.
    """
    at = n_late = 0
    for i in range(whole.shape[0]):
        a = b = 0
        for j in range(len(kind)):
            if j > 0:
                out[at] = 44
                at += 1
            if kind[j] == NAME:
                row = whole[i, a]
                for k in range(begin[row], begin[row + 1]):
                    out[at] = text[k]
                    at += 1
                a += 1
            elif kind[j] == WHOLE:
                at = _whole(whole[i, a], out, at)
                a += 1
            else:
                x = numbers[i, b]
                b += 1
                if not np.isfinite(x):
                    continue
                if x == 0.0 and 1.0 / x > 0.0:
                    out[at] = 48
                    at += 1
                    continue
                digits, power = _decimal(abs(x))
                if digits > 0:
                    at = _number(x, digits, power, out, at)
                else:
                    late[n_late], late_number[n_late] = at, x
                    n_late += 1
                    for k in range(ROOM):
                        out[at + k] = 0
                    at += ROOM
        out[at] = 10
        at += 1
    if n_late < len(late):
        late[n_late] = -1
    return at
