"""Values that memory holds while they fit into it, the latest used."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock
from typing import Generic, TypeVar

__all__ = ["Held"]

KeyT = TypeVar("KeyT")
ValueT = TypeVar("ValueT")


@dataclass(eq=False)
class _Place(Generic[ValueT]):
    """The place of one value, and whether it is there yet."""

    lock: Lock = field(default_factory=Lock)
    """Held by the thread that makes the value; others that ask for it wait."""
    values: list[ValueT] = field(default_factory=list)
    """The value, or nothing before it is made."""


class Held(Generic[KeyT, ValueT]):
    """Values by key. Of these as many are held as fit into a number of bytes, and one at the least.

    Several threads may ask at once; each value is made by one of them. A value that is dropped lives on for
    as long as somebody uses it.
    """

    def __init__(
        self,
        most_bytes: int,
        n_bytes: Callable[[ValueT], int],
        dropped: Callable[[KeyT, ValueT], None] | None = None,
    ) -> None:
        """`n_bytes` is the size of a value; `dropped` is called with each that is held no longer."""
        self._most_bytes = most_bytes
        self._n_bytes = n_bytes
        self._dropped = dropped
        self._places = OrderedDict[KeyT, _Place[ValueT]]()
        self._bytes = 0
        self._lock = Lock()

    def get(self, key: KeyT, make: Callable[[], ValueT]) -> ValueT:
        """The value of a key: held, or else made, which raises what `make` does."""
        with self._lock:
            place = self._places.setdefault(key, _Place())
            self._places.move_to_end(key)
        with place.lock:
            if not place.values:
                place.values.append(make())
                self._arrived(key, place)
            return place.values[0]

    def _arrived(self, key: KeyT, place: _Place[ValueT]) -> None:
        """Count a new value, and drop others, those used longest ago first, until all fit."""
        with self._lock:
            self._places[key] = place
            self._bytes += self._n_bytes(place.values[0])
            for other in [k for k, p in self._places.items() if p.values and k != key]:
                if self._bytes <= self._most_bytes:
                    break
                gone = self._places.pop(other).values[0]
                self._bytes -= self._n_bytes(gone)
                if self._dropped is not None:
                    self._dropped(other, gone)
