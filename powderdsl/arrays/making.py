"""Arrays of numbers from Python's values and from memory."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import reduce
from typing import Any

from powderdsl.arrays.dtypes import dtype, float64, int64, promoted, result_type
from powderdsl.arrays.indexing import broadcast
from powderdsl.arrays.memories import Memory, checked, constant, converted, own
from powderdsl.arrays.movement import Shape, expanded
from powderdsl.arrays.ndarray import Numbers, array_of, generic, made, ndarray, result

_PLAIN = {bool, int, float}


def asarray(values: Any, dtype: Any = None) -> ndarray:
    """An array of anything that is one, or of nested lists."""
    kind = None if dtype is None else _type(dtype)
    if isinstance(values, ndarray):
        return values if kind is None or kind is values.dtype else values.astype(kind)
    if isinstance(values, generic):
        wanted = kind or values.dtype
        return made((), wanted, converted(values.memory, values.dtype, wanted))
    if isinstance(values, Fraction) and kind is not None:
        values = float(values)
    if not isinstance(values, (list, tuple, range)):
        if not isinstance(values, (bool, int, float)):
            raise TypeError(f"without NumPy, {type(values).__name__} cannot become an array")
        wanted = kind or result_type([], [values])
        return made((), wanted, constant(values, wanted))
    types = {*map(type, values)} if values else set()
    if len(types) == 1 and types <= _PLAIN:
        wanted = kind or result_type([], [values[0]])
        # Equal numbers are held as one; of zeros there are two.
        one = isinstance(values, list) and values[0] and values.count(values[0]) == len(values)
        return made((len(values),), wanted, checked([values[0]] if one else list(values), wanted))
    shape, leaves = _nested(values)
    found = [one.dtype for one in leaves if isinstance(one, Numbers)]
    weak = [one for one in leaves if not isinstance(one, Numbers)]
    if kind is None:  # Python's numbers in a list are as strong as others
        found += {result_type([], [one]) for one in weak}
        kind = reduce(promoted, sorted(found, key=str)) if found else float64
    if not weak:
        raw = [converted(one.full, one.dtype, kind) for one in leaves]
        memory = together(raw, kind) if raw else Memory(b"", kind)
    else:
        memory = checked([one.item() if isinstance(one, Numbers) else one for one in leaves], kind)
    return made(shape, kind, memory)


def _type(given: Any) -> dtype:
    return given if isinstance(given, dtype) else dtype(given)


def array(values: Any, dtype: Any = None) -> ndarray:
    """Like `asarray`, in memory of its own."""
    found = asarray(values, dtype)
    return found.copy() if found is values else found


def ascontiguousarray(values: Any, dtype: Any = None) -> ndarray:
    return asarray(values, dtype)


def scalar(value: Any, kind: dtype) -> Any:
    """A number, or a text of one, as a scalar of a type."""
    if isinstance(value, str):
        value = float(value) if kind.kind == "f" else int(value)
    if isinstance(value, (list, tuple, ndarray)):
        return asarray(value).astype(kind)
    if isinstance(value, Numbers):
        return result((), kind, converted(value.memory, value.dtype, kind))
    return result((), kind, checked([value], kind))


def _nested(values: Any) -> tuple[Shape, list[Any]]:
    """The shape of nested lists, and their parts: numbers, or arrays of one shape."""
    if isinstance(values, Numbers):
        return values.shape, [values]
    if not isinstance(values, (list, tuple, range)):
        if not isinstance(values, (bool, int, float)):
            raise TypeError(f"without NumPy, {type(values).__name__} cannot become an array")
        return (), [values]
    if values and all(type(one) in (int, float, bool) for one in values):
        return (len(values),), list(values)
    parts = [_nested(one) for one in values]
    if len({shape for shape, _ in parts}) > 1:
        raise ValueError("setting an array element with a sequence: the array has an inhomogeneous shape")
    return (len(values), *(parts[0][0] if parts else ())), [leaf for _, leaves in parts for leaf in leaves]


def sides_of(shape: Any) -> Shape:
    return tuple(map(operator.index, shape)) if isinstance(shape, Iterable) else (operator.index(shape),)


def full(shape: Any, fill_value: Any, dtype: Any = None) -> ndarray:
    value = asarray(fill_value, dtype)
    return broadcast_to(value, sides_of(shape)).copy()


def zeros(shape: Any, dtype: Any = float64) -> ndarray:
    return full(shape, 0, dtype)


def ones(shape: Any, dtype: Any = float64) -> ndarray:
    return full(shape, 1, dtype)


empty = zeros


def zeros_like(values: Any, dtype: Any = None) -> ndarray:
    return full_like(values, 0, dtype)


def ones_like(values: Any, dtype: Any = None) -> ndarray:
    return full_like(values, 1, dtype)


def full_like(values: Any, fill_value: Any, dtype: Any = None) -> ndarray:
    like = asarray(values)
    return full(like.shape, fill_value, dtype or like.dtype)


def arange(start: int, stop: int | None = None, step: int = 1, dtype: Any = None) -> ndarray:
    first, last = (0, start) if stop is None else (start, stop)
    if any(isinstance(one, float) for one in (first, last, step)):
        raise TypeError("ranges of floats are not there without NumPy")
    return array_of(range(int(first), int(last), int(step)), _type(dtype or int64))


def frombuffer(buffer: Any, dtype: Any = float64, count: int = -1, offset: int = 0) -> ndarray:
    """Elements in the memory of an object, which is read again in each operation if it is a `bytearray`."""
    kind = _type(dtype)
    raw: Any = buffer if isinstance(buffer, (bytes, bytearray)) else bytes(buffer)
    if offset or count >= 0:
        end = offset + count * kind.itemsize if count >= 0 else len(raw)
        if end > len(raw):
            raise ValueError("buffer is smaller than requested size")
        raw = bytes(raw[offset:end])
    if len(raw) % kind.itemsize:
        raise ValueError("buffer size must be a multiple of element size")
    return made((len(raw) // kind.itemsize,), kind, Memory(raw, kind), fixed=True)


def broadcast_to(values: Any, shape: Any) -> ndarray:
    found, target = asarray(values), sides_of(shape)
    if broadcast([found.shape, target]) != target:
        raise ValueError(f"operands could not be broadcast together with shapes {found.shape} {target}")
    raw, held = found.memory.raw, found.memory.type
    if not found.memory.single:
        raw = expanded(raw, held.itemsize, found.shape, target)
    view = found.viewed(target, Memory(raw, held))
    view.fixed = True
    return view


def together(memories: Sequence[Memory], kind: dtype) -> Memory:
    held = kind if any(one.type.itemsize > 1 for one in memories) else memories[0].type
    raws = [own(one, held) if held.kind != "f" else one.raw for one in memories]
    return Memory(b"".join(raws), held)
