"""Operations on elements in memory: integers by lanes and tables, floats one by one with one rounding each."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from powderdsl.arrays.dtypes import bool_, dtype, float32, uint8
from powderdsl.arrays.lanes import Lanes, lanes
from powderdsl.arrays.memories import (
    Memory,
    filled,
    narrowed,
    number,
    numbers,
    own,
    packed,
    streamed,
)

_ISZERO = bytes([1]) + bytes(255)

_SWAPPED = {
    "less": "greater",
    "less_equal": "greater_equal",
    "greater": "less",
    "greater_equal": "less_equal",
}
COMPARISONS = ("equal", "not_equal", *_SWAPPED)


def _quotient(a: int, b: int) -> int:
    return a // b if b else 0


def _rest(a: int, b: int) -> int:
    return a % b if b else 0


def _left(a: int, b: int) -> int:
    return a << b if b < 64 else 0


def _power(a: int, b: int) -> int:
    if b < 0:
        raise ValueError("Integers to negative integer powers are not allowed.")
    return pow(a, b, 1 << 64)


_INTEGER: dict[str, Callable[[Any, Any], Any]] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "floor_divide": _quotient,
    "remainder": _rest,
    "left_shift": _left,
    "right_shift": operator.rshift,
    "bitwise_and": operator.and_,
    "bitwise_or": operator.or_,
    "bitwise_xor": operator.xor,
    "minimum": min,
    "maximum": max,
    "power": _power,
}
_COMPARED: dict[str, Callable[[Any, Any], bool]] = {
    "equal": operator.eq,
    "not_equal": operator.ne,
    "less": operator.lt,
    "less_equal": operator.le,
    "greater": operator.gt,
    "greater_equal": operator.ge,
}
_FLAGS = {
    "add": "bitwise_or",
    "multiply": "bitwise_and",
    "minimum": "bitwise_and",
    "maximum": "bitwise_or",
    "lowered": "bitwise_and",
    "raised": "bitwise_or",
    "bitwise_and": "bitwise_and",
    "bitwise_or": "bitwise_or",
    "bitwise_xor": "bitwise_xor",
}


def combined(op: str, a: Memory, b: Memory, kind: dtype, count: int) -> Memory:
    """An arithmetic operation on elements of one type; the result has it too. Raises TypeError if it has no such one."""
    if count == 0:
        one = Memory(bytes(kind.itemsize), kind)
        combined(op, one, one, kind, 1)  # raises what it would raise
        return Memory(b"", kind)
    if a.single and b.single:
        count = 1
    if kind.kind == "f":
        return _floats(op, a, b, kind, count)
    if kind is bool_:
        if op not in _FLAGS:
            raise TypeError(f"{op} of flags is not there without NumPy")
        found = _narrow(_FLAGS[op], filled(a, count).raw, filled(b, count).raw, uint8, count)
        assert found is not None
        return Memory(found.raw, bool_)
    op = {"raised": "maximum", "lowered": "minimum"}.get(op, op)
    if op not in _INTEGER:
        raise TypeError(f"{op} of integers is not there without NumPy")
    if op.endswith("shift") and min(numbers(b), default=0) < 0:
        raise ValueError("negative shift")
    if a.type.code == b.type.code == "B":
        if b.single and count > 1:
            found = _by_table(op, a.raw, b.raw[0], False, kind)
        elif a.single and count > 1:
            found = _by_table(op, b.raw, a.raw[0], True, kind)
        else:
            found = _narrow(op, a.raw, b.raw, kind, count)
        if found is not None:
            return found
    return _wide(op, a, b, kind, count)


def compared(op: str, a: Memory, b: Memory, kind: dtype, count: int) -> bytes:
    """A comparison of elements of one type: a byte of 0 or 1 for each, or one for all."""
    if count == 0:
        return b""
    if a.single and b.single:
        count = 1
    if kind.kind == "f":
        return bytes([*map(_COMPARED[op], streamed(a, count), streamed(b, count))])
    if a.type.code == b.type.code == "B":
        if count > 1 and (a.single or b.single):
            full, one = (b, a) if a.single else (a, b)
            return full.raw.translate(_compare_table(op, one.raw[0], a.single))
        kind = uint8
    found = lanes(count, kind.itemsize)
    x, y = _vector(a, kind, found), _vector(b, kind, found)
    if op in ("equal", "not_equal"):
        flags = found.flags(found.nonzero(x ^ y))
        return flags.translate(_ISZERO) if op == "equal" else flags
    if op in ("greater", "less_equal"):
        x, y = y, x
    flags = found.flags(found.less(x, y, kind.kind == "i"))
    return flags.translate(_ISZERO) if op.endswith("_equal") else flags


def chosen(flags: bytes, a: Memory, b: Memory, kind: dtype, count: int) -> Memory:
    """The elements of `a` where a flag is 1, those of `b` elsewhere."""
    if count == 0:
        return Memory(b"", kind)
    if len(flags) == 1:
        return a if flags[0] else b
    if a.single and b.single and a.type is b.type and a.raw == b.raw:
        return a
    if kind.kind != "f" and a.type.code == b.type.code == "B":
        if a.single and b.single:
            return Memory(flags.translate(bytes([b.raw[0], a.raw[0]]) + bytes(254)), a.type)
        held = a.type
        found = lanes(count, 1)
        x, y = (int.from_bytes(filled(one, count).raw, "little") for one in (a, b))
    else:
        held = kind
        found = lanes(count, kind.itemsize)
        x, y = (_vector(one, kind, found) for one in (a, b))
    return Memory(found.write(y ^ ((x ^ y) & found.mask(flags))), held)


def _vector(memory: Memory, kind: dtype, found: Lanes) -> int:
    raw = own(memory, kind)
    one = found.read(raw)
    return found.ones * one if memory.single else one


# Integers


@lru_cache(maxsize=1 << 12)
def _table(op: str, value: int, swapped: bool, kind: dtype) -> tuple[bytes, bytes]:
    """The results of an operation with one number for 0 to 255, and the numbers for which a byte holds it."""
    call = _INTEGER[op]
    results = [call(value, one) if swapped else call(one, value) for one in range(256)]
    if kind is uint8:
        return bytes(one & 255 for one in results), bytes(range(256))
    good = [0 <= one < 256 for one in results]
    return (
        bytes(one if fits else 0 for one, fits in zip(results, good, strict=True)),
        bytes(number for number, fits in enumerate(good) if fits),
    )


def _by_table(op: str, raw: bytes, value: int, swapped: bool, kind: dtype) -> Memory | None:
    table, good = _table(op, value, swapped, kind)
    if len(good) < 256 and raw.translate(None, good):
        return None
    return Memory(raw.translate(table), uint8)


@lru_cache(maxsize=1 << 10)
def _compare_table(op: str, value: int, swapped: bool) -> bytes:
    call = _COMPARED[_SWAPPED.get(op, op) if swapped else op]
    return bytes(call(one, value) for one in range(256))


def _narrow(op: str, a: bytes, b: bytes, kind: dtype, count: int) -> Memory | None:
    """An operation on bytes, or None if a result does not fit into one."""
    found = lanes(count, 1)
    if op not in _ON_LANES:
        return None
    x, y = int.from_bytes(a, "little"), int.from_bytes(b, "little")
    result = _on_lanes(op, x, y, found, False)
    if kind is not uint8:
        if op == "add" and found.carries(x, y, result):
            return None
        if op == "subtract" and found.borrows(x, y, result):
            return None
    return Memory(found.write(result), uint8)


_ON_LANES = ("bitwise_and", "bitwise_or", "bitwise_xor", "add", "subtract", "minimum", "maximum")


def _on_lanes(op: str, x: int, y: int, found: Lanes, signed: bool) -> int:
    """One of these operations on two vectors."""
    match op:
        case "bitwise_and":
            return x & y
        case "bitwise_or":
            return x | y
        case "bitwise_xor":
            return x ^ y
        case "add":
            return found.add(x, y)
        case "subtract":
            return found.subtract(x, y)
    return _extreme(op, x, y, found, signed)


def _extreme(op: str, x: int, y: int, found: Lanes, signed: bool) -> int:
    smaller = (found.less(x, y, signed) >> (found.bits - 1)) * ((1 << found.bits) - 1)
    return y ^ ((x ^ y) & smaller) if op == "minimum" else x ^ ((x ^ y) & smaller)


def _wide(op: str, a: Memory, b: Memory, kind: dtype, count: int) -> Memory:
    found = lanes(count, kind.itemsize)
    signed = kind.kind == "i"
    value = number(b) if b.single else None
    if op in _ON_LANES:
        result = _on_lanes(op, _vector(a, kind, found), _vector(b, kind, found), found, signed)
    elif op == "multiply" and (a.single or b.single):
        many, one = (a, b) if b.single else (b, a)
        result = found.multiply(_vector(many, kind, found), int(number(one)))
    elif op == "left_shift" and value is not None:
        result = found.left(_vector(a, kind, found), value) if value < kind.bits else 0
    elif op == "right_shift" and value is not None:
        result = found.right(_vector(a, kind, found), min(value, kind.bits - 1), signed)
        if value >= kind.bits and not signed:
            result = 0
    elif op in ("remainder", "floor_divide") and value is not None and value > 0 and value & (value - 1) == 0:
        x = _vector(a, kind, found)
        if op == "remainder":
            result = x & found.filled(value - 1)
        else:
            result = found.right(x, value.bit_length() - 1, signed)
    else:
        call = _INTEGER[op]
        if op in ("remainder", "floor_divide") and min(map(abs, numbers(b)), default=0) > 0:
            call = operator.mod if op == "remainder" else operator.floordiv
        return packed([*map(call, streamed(a, count), streamed(b, count))], kind)
    return narrowed(found.write(result), kind) if op != "multiply" else Memory(found.write(result), kind)


# Floats


def _quotient_of_floats(a: float, b: float) -> float:
    if b:
        return a / b
    if a == 0 or a != a:
        return math.nan
    return math.copysign(math.inf, a) * math.copysign(1.0, b)


def _floats(op: str, a: Memory, b: Memory, kind: dtype, count: int) -> Memory:
    x, y = streamed(a, count), streamed(b, count)
    if op == "minimum":
        values = [p if p < q or p != p else q for p, q in zip(x, y, strict=False)]
    elif op == "maximum":
        values = [p if p > q or p != p else q for p, q in zip(x, y, strict=False)]
    elif op == "raised":  # to a lower bound; of two zeros the first one stays
        values = [p if p >= q or p != p else q for p, q in zip(x, y, strict=False)]
    elif op == "lowered":
        values = [p if p <= q or p != p else q for p, q in zip(x, y, strict=False)]
    elif op == "true_divide":
        try:
            values = [*map(operator.truediv, x, y)]
        except ZeroDivisionError:
            values = [*map(_quotient_of_floats, streamed(a, count), streamed(b, count))]
    elif op == "hypot":
        values = [math.sqrt(p * p + q * q) for p, q in zip(x, y, strict=False)]
        if kind is not float32:
            raise TypeError("hypot of float64 is not there without NumPy")
    elif op in ("add", "subtract", "multiply"):
        values = [*map(_INTEGER[op], x, y)]
    elif op == "power" and b.single and number(b) == 2:
        values = [p * p for p in x]
    else:
        raise TypeError(f"{op} of floats is not there without NumPy")
    return packed(values, kind)


# Operations on one array


def negated(a: Memory, kind: dtype, count: int) -> Memory:
    found = lanes(1 if a.single else count, kind.itemsize)
    x = found.read(own(a, kind))
    if kind.kind == "f":
        return Memory(found.write(x ^ found.top), kind)
    return narrowed(found.write(found.subtract(0, x)), kind)


def inverted(a: Memory, kind: dtype, count: int) -> Memory:
    if kind is bool_:
        return Memory(a.raw.translate(_ISZERO), kind)
    found = lanes(1 if a.single else count, kind.itemsize)
    return narrowed(found.write(found.read(own(a, kind)) ^ found.all), kind)


def absolute(a: Memory, kind: dtype, count: int) -> Memory:
    if kind.kind == "f":
        found = lanes(1 if a.single else count, kind.itemsize)
        return Memory(found.write(found.read(a.raw) & found.low), kind)
    if a.type.kind != "i":
        return a
    return packed([*map(abs, numbers(a))], kind)


def _root(value: float) -> float:
    return math.sqrt(value) if value >= 0 else math.nan


def _floor(value: float) -> float:
    return float(math.floor(value)) if value and math.isfinite(value) else value


_FLOAT_CALLS: dict[str, Callable[[float], float]] = {"sqrt": _root, "floor": _floor}


def of_floats(op: str, a: Memory, kind: dtype) -> Memory:
    """`sqrt` or `floor` of floats."""
    if op == "sqrt":
        try:
            return packed([*map(math.sqrt, numbers(a))], kind)
        except ValueError:
            pass
    return packed([*map(_FLOAT_CALLS[op], numbers(a))], kind)


def is_nan(a: Memory) -> bytes:
    values = numbers(a)
    return bytes([*map(operator.ne, values, values)])


def is_finite(a: Memory) -> bytes:
    return bytes([*map(math.isfinite, numbers(a))])
