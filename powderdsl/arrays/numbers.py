"""Types of numbers, and operations on the values of arrays, which are in C order and never change.

Flags and integers of 0 to 255 are `bytes`, whatever their type but int8: most arrays hold elements, flags and small
numbers, on which `bytes` and integers of Python work in C. Other values are an `array.array`. One value stands for any
number of equal ones.
"""

from __future__ import annotations

import math
import operator
from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import repeat
from operator import index
from typing import Any, TypeAlias

Values: TypeAlias = "bytes | array[Any]"


@dataclass(frozen=True, eq=False)
class Type:
    """A type of numbers. Calling it makes an array without axes: `float32(0.1)`."""

    name: str
    code: str
    kind: str
    itemsize: int
    low: int
    high: int

    @property
    def type(self) -> Type:
        """The constructor of numbers of this type: the type itself."""
        return self

    @property
    def str(self) -> Any:
        """The name in headers of files, such as ``<i4``."""
        return f"{'|' if self.itemsize == 1 else '<'}{self.kind}{self.itemsize}"

    def __call__(self, value: Any) -> Any:
        from powderdsl.arrays.plain import asarray

        return asarray(value, self)

    def __str__(self) -> Any:
        return self.name

    def __eq__(self, other: object) -> bool:
        return other is self or (isinstance(other, (str, type)) and dtype(other) is self)

    __hash__ = object.__hash__


def dtype(name_or_type: Any) -> Type:
    """Return the type with this name, or the one for a Python type."""
    name = name_or_type.__name__ if isinstance(name_or_type, type) else str(name_or_type)
    name = {"int": "int64", "float": "float64"}.get(name, name)
    if name not in _TYPES:
        raise TypeError(f"{name_or_type!r} is not a number type that powderdsl supports without NumPy")
    return _TYPES[name]


def _type(name: str, code: str) -> Type:
    kind = "b" if name == "bool" else "f" if code in "fd" else "u" if code.isupper() else "i"
    size, signed = array(code).itemsize, kind == "i"
    bits = 1 if name == "bool" else 8 * size
    return Type(name, code, kind, size, -(1 << bits - 1) if signed else 0, (1 << bits - signed) - 1)


_INTEGERS = (f"{sign}int{bits}" for bits in (8, 16, 32, 64) for sign in ("", "u"))
_NAMES = ("bool", *_INTEGERS, "float32", "float64")
_TYPES = {name: _type(name, code) for name, code in zip(_NAMES, "BbBhHiIqQfd", strict=True)}
bool_, float32, float64 = _TYPES["bool"], _TYPES["float32"], _TYPES["float64"]


@cache
def promote(a: Type, b: Type) -> Type:
    """The smallest type that holds the values of both."""
    if a is b or b is bool_:
        return a
    if a is bool_:
        return b
    if "f" in (a.kind, b.kind):
        narrow = all(kind is float32 or (kind.kind != "f" and kind.itemsize <= 2) for kind in (a, b))
        return float32 if narrow else float64
    large, small = (a, b) if a.itemsize >= b.itemsize else (b, a)
    if large.kind != small.kind and (large.kind == "u" or large.itemsize == small.itemsize):
        raise TypeError(f"{a} with {b} is not supported without NumPy")
    return large


# Values


def pack(numbers: list[Any], kind: Type) -> Values:
    """Numbers as values; integers wrap around, floats are rounded once."""
    if kind.kind == "f":
        return array(kind.code, numbers)
    if kind.code != "b":
        try:
            return bytes(numbers)
        except ValueError:
            pass
    try:
        values = array(kind.code, numbers)
    except OverflowError:
        span = kind.high - kind.low + 1
        values = array(kind.code, [(number - kind.low) % span + kind.low for number in numbers])
    return values.tobytes() if kind.code == "B" else values


def pack_exactly(numbers: Iterable[Any], kind: Type) -> Values:
    """Numbers that must fit. Raises OverflowError or TypeError."""
    items = list(numbers)
    if kind.kind == "f":
        if kind is float32 and any(type(number) is int and abs(number) > 1 << 53 for number in items):
            raise OverflowError("integers that would be rounded twice are not supported without NumPy")
        return array(kind.code, map(float, items))
    if kind is bool_:
        return bytes(map(bool, items))
    integers = [*map(index, items)]
    if integers and not kind.low <= min(integers) <= max(integers) <= kind.high:
        raise OverflowError(f"{min(integers)} to {max(integers)} are out of bounds for {kind}")
    return pack(integers, kind)


def convert(values: Values, old: Type, new: Type) -> Values:
    """Values of another type. Raises OverflowError or ValueError for floats that no integer of the type stands for, and
    OverflowError for integers that float32 would round twice."""
    if old is new or (isinstance(values, bytes) and new.kind in "iu" and new.high > 254):
        return values
    if new is bool_:
        return values.translate(_NONZERO) if isinstance(values, bytes) else bytes(map(bool, values))
    if old.kind == "f":
        return array(new.code, values) if new.kind == "f" else pack_exactly(map(int, values), new)
    if new.kind != "f":
        return pack(list(values), new)
    return pack_exactly(values, new)


def raw_of(values: Values, kind: Type) -> bytes:
    """The bytes of values as their type has them."""
    if isinstance(values, bytes) and kind.itemsize > 1:
        raw = bytearray(len(values) * kind.itemsize)
        raw[:: kind.itemsize] = values
        return bytes(raw)
    return values if isinstance(values, bytes) else values.tobytes()


def unpack(raw: bytes | bytearray, code: str) -> Values:
    """The values whose bytes these are, by the code of `array.array`."""
    if code == "B":
        return bytes(raw)
    values = array(code)
    values.frombytes(raw)
    return values


def unify(several: Sequence[Values], kind: Type) -> list[Values]:
    """Values of one type, all as bytes or all as an `array.array`."""
    if len({type(values) for values in several}) == 1:
        return list(several)
    return [unpack(raw_of(v, kind), kind.code) if isinstance(v, bytes) else v for v in several]


_NONZERO = bytes([0]) + bytes([1]) * 255
_ZERO = bytes([1]) + bytes(255)


def _repeat(values: Values, count: int) -> Iterable[Any]:
    return repeat(values[0], count) if len(values) == 1 else values


# Operations on two arrays


def _quotient(a: float, b: float) -> float:
    if b:
        return a / b
    return math.nan if a == 0 or a != a else math.copysign(math.inf, a) * math.copysign(1.0, b)


_OF_INTEGERS = ("add", "sub", "mul", "floordiv", "mod", "lshift", "rshift", "and_", "or_", "xor")
_OPERATIONS: dict[str, Callable[[Any, Any], Any]] = {
    **{op: getattr(operator, op) for op in (*_OF_INTEGERS, "truediv")},
    # NaN stays. If both are equal it is the second: one of two zeros may be negative.
    "minimum": lambda a, b: a if a < b or a != a else b,
    "maximum": lambda a, b: a if a > b or a != a else b,
}
_OF_FLAGS, _OF_FLOATS = ("and_", "or_", "xor"), ("add", "sub", "mul", "truediv", "minimum", "maximum")
_COMPARISONS: dict[str, Callable[[Any, Any], bool]] = {
    name: getattr(operator, name) for name in ("eq", "ne", "lt", "le", "gt", "ge")
}


def arithmetic(op: str, a: Values, b: Values, kind: Type, count: int) -> Values:
    """An operation on values of one type. Raises TypeError if the type does not have it."""
    if op not in {"b": _OF_FLAGS, "f": _OF_FLOATS}.get(kind.kind, (*_OF_INTEGERS, "minimum", "maximum")):
        raise TypeError(f"{op} of {kind} is not supported without NumPy")
    if len(a) == len(b) == 1:
        count = 1
    if op in (*_OF_FLAGS, "add") and isinstance(a, bytes) and isinstance(b, bytes):
        x, y = (int.from_bytes(values * count if len(values) == 1 else values, "little") for values in (a, b))
        if op != "add" or not (x | y) & int.from_bytes(b"\x80" * count, "little"):  # no byte carries
            return int(_OPERATIONS[op](x, y)).to_bytes(count, "little")
    try:
        numbers = [*map(_OPERATIONS[op], _repeat(a, count), _repeat(b, count))]
    except ZeroDivisionError:
        if op != "truediv":
            raise
        numbers = [*map(_quotient, _repeat(a, count), _repeat(b, count))]
    return pack(numbers, kind)


def compare(op: str, a: Values, b: Values, count: int) -> bytes:
    """A byte of 0 or 1 for each pair of values."""
    if len(a) == len(b) == 1:
        count = 1
    if isinstance(a, bytes) and isinstance(b, bytes) and count > 1:
        if len(a) == 1 or len(b) == 1:
            many, single, swapped = (b, a, True) if len(a) == 1 else (a, b, False)
            return many.translate(_comparison(op, single[0], swapped))
        if op in ("eq", "ne"):
            unequal = int.from_bytes(a, "little") ^ int.from_bytes(b, "little")
            return unequal.to_bytes(count, "little").translate(_ZERO if op == "eq" else _NONZERO)
    return bytes(map(_COMPARISONS[op], _repeat(a, count), _repeat(b, count)))


@lru_cache(maxsize=1 << 11)
def _comparison(op: str, number: int, swapped: bool) -> bytes:
    call = _COMPARISONS[op]
    return bytes(call(number, byte) if swapped else call(byte, number) for byte in range(256))


def choose(flags: bytes, a: Values, b: Values, kind: Type, count: int) -> Values:
    """The values of `a` where a flag is 1, and of `b` elsewhere."""
    if len(flags) == 1:
        return a if flags[0] else b
    if isinstance(a, bytes) and isinstance(b, bytes) and len(a) == len(b) == 1:
        return flags.translate(bytes([b[0], a[0]]) + bytes(254))
    a, b = (values * count if len(values) == 1 else values for values in unify((a, b), kind))
    size = 1 if isinstance(a, bytes) else kind.itemsize
    wide = bytearray(count * size)
    for place in range(size):
        wide[place::size] = flags
    # Bitwise choice on one large integer: 255 turns the flag of each byte into a mask of its bits.
    mask = int.from_bytes(wide, "little") * 255
    x, y = int.from_bytes(memoryview(a), "little"), int.from_bytes(memoryview(b), "little")
    return unpack((y ^ ((x ^ y) & mask)).to_bytes(count * size, "little"), getattr(a, "typecode", "B"))


# Values elsewhere

Offsets = Sequence[int]
"""The offsets of values along an axis, in values from the beginning."""


def _runs(axes: Sequence[Offsets]) -> tuple[list[int], int]:
    """The places at which runs of values begin, and their length. The last axis runs fastest."""
    length, base, count = 1, 0, len(axes)
    while count:
        offsets = axes[count - 1]
        if len(offsets) == 1:
            base += offsets[0]
        elif isinstance(offsets, range) and offsets.step == length:
            base, length = base + offsets.start, length * len(offsets)
        else:
            break
        count -= 1
    starts = [base]
    for offsets in axes[:count]:
        starts = [start + offset for start in starts for offset in offsets]
    return starts, length


def gather(values: Values, axes: Sequence[Offsets]) -> Values:
    """The values at the sums of one offset from each axis."""
    if not all(map(len, axes)):
        return values[:0]
    if len(values) == 1:
        return values
    starts, length = _runs(axes)
    if len(starts) == 1:
        return values[starts[0] : starts[0] + length]
    if length == 1:
        taken = operator.itemgetter(*starts)(values)
        return bytes(taken) if isinstance(values, bytes) else array(values.typecode, taken)
    if isinstance(values, bytes):
        return b"".join([values[start : start + length] for start in starts])
    raw, size = values.tobytes(), values.itemsize
    parts = [raw[start * size : (start + length) * size] for start in starts]
    return unpack(b"".join(parts), values.typecode)


def scatter(values: Values, axes: Sequence[Offsets], new: Values) -> Values:
    """The values with new ones, of one type and as many, at the sums of one offset from each axis."""
    if not all(map(len, axes)):
        return values
    changed: Any = bytearray(values) if isinstance(values, bytes) else values[:]
    starts, length = _runs(axes)
    for place, start in enumerate(starts):
        changed[start : start + length] = new[place * length : (place + 1) * length]
    return bytes(changed) if isinstance(values, bytes) else changed


def roll(values: Values, count: int, inner: int, shift: int) -> Values:
    """Values [outer, count, inner] in which number i of the middle axis comes from i - shift; it wraps around."""
    if len(values) == 1 or not values or shift % count == 0:
        return values
    block, cut = count * inner, shift % count * inner
    cut -= block if 2 * cut > block else 0
    # All values move at once; then values that leave their block return at its other end.
    either: Any = values
    moved = either[-cut:] + either[:-cut]
    changed: Any = bytearray(moved) if isinstance(values, bytes) else moved
    for place in range(cut) if cut > 0 else range(block + cut, block):
        changed[place::block] = values[(place - cut) % block :: block]
    return bytes(changed) if isinstance(values, bytes) else changed
