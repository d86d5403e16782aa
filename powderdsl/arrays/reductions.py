"""Sums, extremes and places of elements along axes."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import reduce
from math import prod
from typing import Any

from powderdsl.arrays.arithmetic import combined
from powderdsl.arrays.dtypes import bool_, dtype, float64, int64, uint64
from powderdsl.arrays.memories import Memory, converted, filled, nonzero, numbers, packed
from powderdsl.arrays.movement import Shape, permuted

_FOLDED = {"sum": "add", "min": "minimum", "max": "maximum", "any": "bitwise_or", "all": "bitwise_and"}


def reduced(
    name: str, memory: Memory, kind: dtype, shape: Shape, axis: int | tuple[int, ...] | None
) -> tuple[Memory, dtype]:
    """A reduction along some axes, or all of them: its values in the order of the axes that remain, and their type."""
    axes = () if shape == () and axis in (0, -1) and name != "mean" else axes_of(axis, len(shape))
    count = prod(shape)
    if memory.single and count and name in ("any", "all", "min", "max"):
        return (Memory(nonzero(memory), bool_), bool_) if name in ("any", "all") else (memory, kind)
    full = filled(memory, count)
    rest = [one for one in range(len(shape)) if one not in axes]
    size = full.type.itemsize
    raw = permuted(full.raw, size, shape, [*rest, *axes]) if rest and axes else full.raw
    length, outer = prod(shape[one] for one in axes), prod(shape[one] for one in rest)
    full = Memory(raw, full.type)
    if name in ("any", "all"):
        full, kind = Memory(nonzero(full), bool_), bool_
    elif name in ("sum", "prod", "mean"):
        if kind.kind == "f":
            raise TypeError(f"{name} of floats is not there without NumPy: its rounding depends on an order")
        if name == "mean" and kind is not bool_:
            raise TypeError("mean of integers is not there without NumPy")
        wanted = uint64 if kind.kind == "u" and name != "mean" else int64
        full, kind = converted(full, kind, wanted), wanted
    elif length == 0:
        raise ValueError(f"zero-size array to reduction operation {name} which has no identity")
    if name in _FOLDED and 0 < length <= outer:
        columns = [_column(full, place, length) for place in range(length)]
        return reduce(lambda a, b: combined(_FOLDED[name], a, b, kind, outer), columns), kind
    values = numbers(full)
    starts = range(0, outer * length, length) if length else [0] * outer
    found = [_CALLS[name](values[start : start + length]) for start in starts]
    if name == "mean":
        return packed([_share(total, length) for total in found], float64), float64
    if name in ("argmax", "argmin"):
        return packed(found, int64), int64
    return packed(found, kind), kind


def axes_of(axis: int | tuple[int, ...] | None, count: int) -> tuple[int, ...]:
    if axis is None:
        return tuple(range(count))
    found = axis if isinstance(axis, tuple) else (axis,)
    for one in found:
        if not -count <= one < count:
            raise IndexError(f"axis {one} is out of bounds for array of dimension {count}")
    return tuple(sorted(one % count for one in found))


def _column(memory: Memory, place: int, length: int) -> Memory:
    if length == 1:
        return memory
    if memory.type.itemsize == 1:
        return Memory(memory.raw[place::length], memory.type)
    return Memory(array(memory.type.code, bytes(memory.raw))[place::length].tobytes(), memory.type)


def _share(total: int, length: int) -> float:
    return total / length if length else float("nan")


def _extreme(call: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def found(values: Any) -> Any:
        wrong = [value for value in values if value != value]
        return wrong[0] if wrong else call(values)

    return found


def _place(call: Callable[[Any], Any]) -> Callable[[Any], int]:
    def found(values: Any) -> int:
        listed = list(values)
        wrong = [place for place, value in enumerate(listed) if value != value]
        return wrong[0] if wrong else int(listed.index(call(listed)))

    return found


_CALLS: dict[str, Callable[[Any], Any]] = {
    "any": lambda values: 1 in values,
    "all": lambda values: 0 not in values,
    "sum": sum,
    "mean": sum,
    "prod": prod,
    "min": _extreme(min),
    "max": _extreme(max),
    "argmax": _place(max),
    "argmin": _place(min),
}
