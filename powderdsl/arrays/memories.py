"""The memory of arrays, and conversions between types.

Integers of 0 to 255 are held as single bytes, whatever the type of their array: most arrays hold elements, flags and
small numbers. One element alone stands for any number of equal ones.
"""

from __future__ import annotations

import operator
from array import array
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import repeat
from typing import Any

from powderdsl.arrays.dtypes import bool_, dtype, float32, float64, uint8
from powderdsl.arrays.lanes import lanes

_NONZERO = bytes([0]) + bytes([1]) * 255
_SIGNS = bytes(128) + b"\xff" * 128
_EXACT = 1 << 53


class Memory:
    """Elements in C order. `type` is that of their array, or uint8 for integers that are held as bytes."""

    __slots__ = ("raw", "single", "type")

    def __init__(self, raw: bytes, kind: dtype):
        self.raw = raw
        self.type = kind
        self.single = len(raw) == kind.itemsize
        """Whether there is one element."""


def numbers(memory: Memory) -> Sequence[Any]:
    """The elements as numbers of Python."""
    return memory.raw if memory.type.code == "B" else array(memory.type.code, bytes(memory.raw))


def number(memory: Memory) -> Any:
    """The first element; flags are integers."""
    return numbers(memory)[0]


def streamed(memory: Memory, count: int) -> Iterable[Any]:
    """The elements; one alone as often as needed."""
    return repeat(number(memory), count) if memory.single else numbers(memory)


def filled(memory: Memory, count: int) -> Memory:
    """The memory of all elements."""
    return Memory(memory.raw * count, memory.type) if memory.single and count != 1 else memory


def packed(values: list[Any], kind: dtype) -> Memory:
    """Numbers of Python as elements; integers wrap around, floats are rounded once."""
    if kind.kind == "f":
        return Memory(array(kind.code, values).tobytes(), kind)
    if kind.code == "B":
        try:
            return Memory(bytes(values), kind)
        except ValueError:
            return Memory(bytes([value & 255 for value in values]), kind)
    if kind.itemsize > 1 and values and 0 <= values[0] < 256 and 0 <= values[-1] < 256:
        try:
            return Memory(bytes(values), uint8)
        except ValueError:
            pass
    try:
        return Memory(array(kind.code, values).tobytes(), kind)
    except OverflowError:
        low, span = kind.low, kind.high - kind.low + 1
        return Memory(array(kind.code, [(value - low) % span + low for value in values]).tobytes(), kind)


def checked(values: list[Any], kind: dtype) -> Memory:
    """Numbers of Python that must fit. Raises OverflowError for integers that do not, TypeError for others."""
    if kind.kind == "f":
        if {*map(type, values)} != {float}:
            values = [rounded(value, kind) for value in values]
        return packed(values, kind)
    if kind is bool_:
        return Memory(bytes(map(bool, values)), kind)
    if not {*map(type, values)} <= {int, bool}:
        values = [value if isinstance(value, int) else _whole(value) for value in values]
    if values and not (kind.low <= min(values) and max(values) <= kind.high):
        wrong = next(value for value in values if not kind.low <= value <= kind.high)
        raise OverflowError(f"Python integer {wrong} out of bounds for {kind}")
    return packed(values, kind)


def constant(value: bool | int | float, kind: dtype) -> Memory:
    """One number. Raises as `checked` does."""
    return _kept(value, kind) if value else checked([value], kind)  # two zeros are equal, but not the same


@lru_cache(maxsize=1 << 10, typed=True)
def _kept(value: bool | int | float, kind: dtype) -> Memory:
    return checked([value], kind)


def _whole(value: Any) -> int:
    if isinstance(value, float):
        return int(value)
    return operator.index(value)


def rounded(value: Any, kind: dtype) -> float:
    """A number as a float of Python that rounds to the nearest one of a type."""
    if (
        kind is float32 and isinstance(value, int) and abs(value) > _EXACT
    ):  # not by way of float64: once alone
        places = abs(value).bit_length() - 24
        whole, half = value >> places, 1 << (places - 1)
        part = value - (whole << places)
        return float((whole + (part > half or (part == half and whole % 2 == 1))) << places)
    return float(value)


def own(memory: Memory, kind: dtype) -> bytes:
    """Integers in the size of their type."""
    raw = memory.raw
    if memory.type is kind or kind.itemsize == 1:
        return raw
    wide = bytearray(len(raw) * kind.itemsize)
    wide[:: kind.itemsize] = raw
    return bytes(wide)


def narrowed(raw: bytes, kind: dtype) -> Memory:
    """Integers of a type, as bytes if they are small enough."""
    size = kind.itemsize
    if size == 1 or any(raw[1:size]) or any(raw[1 - size :]):
        return Memory(raw, kind)
    if any(raw[place::size].strip(b"\0") for place in range(size - 1, 0, -1)):
        return Memory(raw, kind)
    return Memory(raw[::size], uint8)


def converted(memory: Memory, old: dtype, new: dtype) -> Memory:
    """Elements of a type as elements of another, as `astype` does it.

    Raises:
        ValueError: floats that no integer of the type stands for.
    """
    if old is new:
        return memory
    if old.kind == "f":
        return _from_floats(memory, new)
    if new is bool_:
        return Memory(nonzero(memory), bool_)
    if new.kind == "f":
        return _to_floats(memory, new)
    return _between_integers(memory, new)


def nonzero(memory: Memory) -> bytes:
    """A byte of 0 or 1 for each element."""
    if memory.type.kind == "f":
        return bytes(map(bool, numbers(memory)))
    if memory.type.itemsize == 1:
        return memory.raw.translate(_NONZERO)
    found = lanes(len(memory.raw) // memory.type.itemsize, memory.type.itemsize)
    return found.flags(found.nonzero(found.read(memory.raw)))


def _from_floats(memory: Memory, new: dtype) -> Memory:
    if new is bool_:
        return Memory(nonzero(memory), new)
    if new.kind == "f":
        return Memory(array(new.code, numbers(memory)).tobytes(), new)
    try:
        whole = [*map(int, numbers(memory))]
    except (ValueError, OverflowError):
        raise ValueError(f"floats that are not finite cannot become {new}") from None
    if whole and not new.low <= min(whole) <= max(whole) <= new.high:
        raise ValueError(f"floats beyond the range of {new}")
    return packed(whole, new)


def _to_floats(memory: Memory, new: dtype) -> Memory:
    if memory.type.itemsize == 1 and memory.type.code == "B":
        wide = bytearray(len(memory.raw) * new.itemsize)
        for place, table in enumerate(_float_bytes(new)):
            if table is not None:
                wide[place :: new.itemsize] = memory.raw.translate(table)
        return Memory(bytes(wide), new)
    values = numbers(memory)
    if new is float64 or memory.type.itemsize < 8:
        return Memory(array(new.code, values).tobytes(), new)
    return Memory(array(new.code, [rounded(value, new) for value in values]).tobytes(), new)


@lru_cache(maxsize=2)
def _float_bytes(new: dtype) -> list[bytes | None]:
    """For each byte of a float its value for the integers 0 to 255; None where it is always 0."""
    raw = array(new.code, range(256)).tobytes()
    tables = [raw[place :: new.itemsize] for place in range(new.itemsize)]
    return [table if any(table) else None for table in tables]


def _between_integers(memory: Memory, new: dtype) -> Memory:
    raw, held = memory.raw, memory.type
    if held.code == "B":
        return Memory(raw, uint8 if new.itemsize > 1 else new)
    old_size, size = held.itemsize, new.itemsize
    if old_size == size:
        return narrowed(raw, new)
    wide = bytearray(len(raw) // old_size * size)
    for place in range(min(size, old_size)):
        wide[place::size] = raw[place::old_size]
    if size > old_size and held.kind == "i":
        signs = raw[old_size - 1 :: old_size].translate(_SIGNS)
        for place in range(old_size, size):
            wide[place::size] = signs
    return narrowed(bytes(wide), new)
