"""Entries of TIFF directories: what a TIFF file, and EXIF in any other file, keep their numbers in.

Source: TIFF 6.0, section 2; BigTIFF as libtiff documents it.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

__all__ = ["ORIENTATION", "TIFF_STARTS", "TiffEntry", "entries_at", "first_entries"]

TIFF_STARTS = (b"II", b"MM")
"""How the bytes of a TIFF begin: little end first, big end first."""
ORIENTATION = 274
"""Tag of how rows and columns of a picture lie on a screen: 1 as they are."""

_TYPES = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 7: "B", 9: "i", 10: "ii", 13: "I", 16: "Q"}
"""Types of entries, as `struct` writes them: bytes, text, whole numbers, fractions."""
_MOST_TEXT = 256
"""Bytes of a text that are read."""


@dataclass(frozen=True, kw_only=True)
class TiffEntry:
    """One entry of a directory."""

    tag: int
    kind: int
    """Type of its numbers, as TIFF counts types."""
    count: int
    """How many numbers it has."""
    value_at: int
    """Offset of the bytes that hold the value, or the offset of it."""
    order: str
    """Order of bytes as `struct` writes it."""
    inline_bytes: int
    """How many bytes a value may have to stand in the entry itself."""

    def numbers(self, data: bytes) -> tuple[int, ...]:
        """The first value: one whole number, or two of a fraction; none of a type that is no number.

        Raises struct.error where the file ends before it.
        """
        form = _TYPES.get(self.kind)
        if form is None or form == "s":
            return ()
        size = struct.calcsize(f"{self.order}{form}")
        return struct.unpack_from(f"{self.order}{form}", data, self._at(data, size * self.count))

    def text(self, data: bytes) -> str:
        """The text of an entry, without what is no ASCII; "" of another type. Raises struct.error too."""
        if self.kind != 2:
            return ""
        at = self._at(data, self.count)
        raw = data[at : at + min(self.count, _MOST_TEXT)]
        return "".join(chr(b) for b in raw.split(b"\0")[0] if 32 <= b < 127).strip()

    def _at(self, data: bytes, size: int) -> int:
        if size <= self.inline_bytes:
            return self.value_at
        form = "Q" if self.inline_bytes == 8 else "I"
        (at,) = struct.unpack_from(f"{self.order}{form}", data, self.value_at)
        return _within(data, at)


def first_entries(data: bytes) -> Iterator[TiffEntry]:
    """Entries of the first directory of a TIFF. Raises struct.error where the file ends within it."""
    order = "<" if data.startswith(b"II") else ">"
    if struct.unpack_from(f"{order}H", data, 2)[0] == 42:
        return entries_at(data, struct.unpack_from(f"{order}I", data, 4)[0], order)
    return entries_at(data, struct.unpack_from(f"{order}Q", data, 8)[0], order, big=True)


def entries_at(data: bytes, at: int, order: str, *, big: bool = False) -> Iterator[TiffEntry]:
    """Entries of the directory at an offset, of TIFF or BigTIFF. Raises struct.error as `first_entries`."""
    at = _within(data, at)
    (count,) = struct.unpack_from(f"{order}{'Q' if big else 'H'}", data, at)
    at, step, inline = (at + 8, 20, 8) if big else (at + 2, 12, 4)
    for entry in range(at, min(at + count * step, len(data)), step):
        tag, kind, n = struct.unpack_from(f"{order}HH{'Q' if big else 'I'}", data, entry)
        value_at = entry + step - inline
        yield TiffEntry(tag=tag, kind=kind, count=n, value_at=value_at, order=order, inline_bytes=inline)


def _within(data: bytes, at: int) -> int:
    """An offset. Raises struct.error for one beyond the end, which `struct` may not take as a number."""
    if at >= len(data):
        raise struct.error("an offset beyond the end")
    return at
