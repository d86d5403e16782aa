"""Operations on two arrays or numbers, and the operators of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any

from powderdsl.arrays.arithmetic import COMPARISONS, combined, compared
from powderdsl.arrays.dtypes import bool_, dtype, float64, int64, promoted, result_type
from powderdsl.arrays.indexing import broadcast
from powderdsl.arrays.making import asarray
from powderdsl.arrays.memories import Memory, checked, constant, converted
from powderdsl.arrays.movement import Shape, expanded
from powderdsl.arrays.ndarray import Numbers, ndarray, result

ORDER = "biuf"
"""Kinds of types: an array can be changed in place by what stands not after its own."""


def operands(values: Sequence[Any]) -> tuple[list[Memory], dtype, Shape]:
    """Arrays and Python's numbers in one type and shape; memories of one element stand for any number.

    Raises:
        OverflowError: an integer of Python's that the type cannot hold.
    """
    first, second = values
    if isinstance(first, Numbers) and isinstance(second, Numbers):
        if first.dtype is second.dtype and first.shape == second.shape:
            return [first.memory, second.memory], first.dtype, first.shape
        kind, shape = promoted(first.dtype, second.dtype), broadcast((first.shape, second.shape))
    else:
        arrays = [one for one in values if isinstance(one, Numbers)]
        kind = result_type(
            [one.dtype for one in arrays], [one for one in values if not isinstance(one, Numbers)]
        )
        shape = arrays[0].shape if arrays else ()
    return [_operand(one, kind, shape) for one in values], kind, shape


def _operand(one: Any, kind: dtype, shape: Shape) -> Memory:
    if not isinstance(one, Numbers):
        return constant(one, kind)
    memory = converted(one.memory, one.dtype, kind)
    if memory.single or one.shape == shape:
        return memory
    return Memory(expanded(memory.raw, memory.type.itemsize, one.shape, shape), memory.type)


def binary(op: str, x: Any, y: Any) -> Any:
    """An operation on two arrays or numbers; NotImplemented for others."""
    values = []
    for one in (x, y):
        if not isinstance(one, Numbers) and not isinstance(one, (bool, int, float)):
            if not isinstance(one, (list, tuple)):
                return NotImplemented
            one = asarray(one)
        values.append(one)
    if op in COMPARISONS:
        return _comparison(op, values)
    if op == "power" and any(isinstance(one, bool) or getattr(one, "dtype", None) is bool_ for one in values):
        raise TypeError("power of flags is not there without NumPy")
    if op == "true_divide":
        kinds = [one.dtype for one in values if isinstance(one, Numbers)]
        kind = result_type(kinds, [one for one in values if not isinstance(one, Numbers)])
        if kind.kind != "f":
            values = [one.astype(float64) if isinstance(one, Numbers) else float(one) for one in values]
    (a, b), kind, shape = operands(values)
    return result(shape, kind, combined(op, a, b, kind, prod(shape)))


def _comparison(op: str, values: list[Any]) -> Any:
    try:
        (a, b), kind, shape = operands(values)
    except OverflowError:  # an integer that the type cannot hold compares by its value
        (a, b), kind, shape = _beyond(values)
    mixed = {one.dtype.kind for one in values if isinstance(one, Numbers)}
    if kind is float64 and mixed == {"i", "u"}:
        raise TypeError("comparing uint64 with signed integers is not there without NumPy")
    return result(shape, bool_, Memory(compared(op, a, b, kind, prod(shape)), bool_))


def _beyond(values: list[Any]) -> tuple[list[Memory], dtype, Shape]:
    """Operands of which one is an integer beyond the range of the other: 0 or 1 in its place, the other way round."""
    place = next(at for at, one in enumerate(values) if not isinstance(one, Numbers))
    shape = values[1 - place].shape
    low = values[place] < 0
    pair = [checked([int(not low)], int64), checked([int(low)], int64)]
    return (pair if place == 0 else pair[::-1]), int64, shape


def _changed(self: ndarray, op: str, other: Any) -> ndarray:
    """Change the array in place."""
    found = binary(op, self, other)
    if found is NotImplemented:
        raise TypeError(f"{op} takes arrays and numbers, found {type(other).__name__}")
    if found.shape != self.shape:
        raise ValueError(f"non-broadcastable output operand with shape {self.shape}")
    kinds = [ORDER.index(one.dtype.kind) for one in (found, self)]
    if kinds[0] > kinds[1] or (found.dtype.kind, self.dtype.kind) == ("i", "u"):
        raise TypeError(f"cannot cast the result of {op} from {found.dtype} to {self.dtype}")
    self.check_writable()
    self.memory = converted(found.memory, found.dtype, self.dtype)
    return self


def _clip(self: Numbers, min: Any = None, max: Any = None) -> Any:
    found = self if min is None else binary("raised", self, min)
    return found if max is None else binary("lowered", found, max)


def _operator(op: str, swapped: bool = False) -> Any:
    def call(self: Numbers, other: Any) -> Any:
        return binary(op, other, self) if swapped else binary(op, self, other)

    return call


def _in_place(op: str) -> Any:
    def call(self: ndarray, other: Any) -> ndarray:
        return _changed(self, op, other)

    return call


for _word, _op in (
    ("add", "add"),
    ("sub", "subtract"),
    ("mul", "multiply"),
    ("truediv", "true_divide"),
    ("floordiv", "floor_divide"),
    ("mod", "remainder"),
    ("pow", "power"),
    ("and", "bitwise_and"),
    ("or", "bitwise_or"),
    ("xor", "bitwise_xor"),
    ("lshift", "left_shift"),
    ("rshift", "right_shift"),
):
    setattr(Numbers, f"__{_word}__", _operator(_op))
    setattr(Numbers, f"__r{_word}__", _operator(_op, swapped=True))
    setattr(ndarray, f"__i{_word}__", _in_place(_op))
for _word, _op in zip(("eq", "ne", "lt", "le", "gt", "ge"), COMPARISONS, strict=True):
    setattr(Numbers, f"__{_word}__", _operator(_op))
Numbers.clip = _clip  # type: ignore[attr-defined]  # operations need arrays, which so cannot import them
