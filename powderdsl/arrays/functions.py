"""NumPy's functions on arrays."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from functools import lru_cache, reduce
from itertools import accumulate
from math import prod as _product
from typing import Any

from powderdsl.arrays import arithmetic
from powderdsl.arrays.dtypes import bool_, float32, float64, int64, promoted
from powderdsl.arrays.indexing import broadcast
from powderdsl.arrays.making import asarray, broadcast_to, zeros
from powderdsl.arrays.memories import Memory, checked, converted, number, numbers, own, packed
from powderdsl.arrays.movement import expanded, joined, repeated, rolled
from powderdsl.arrays.ndarray import Numbers, array_of, made, ndarray, result
from powderdsl.arrays.operations import binary, operands
from powderdsl.arrays.reductions import axes_of

inf = float("inf")


class _Grid:
    """`mgrid[:height, :width]`: the numbers of rows and columns of each cell."""

    def __getitem__(self, key: Any) -> ndarray:
        sides = [
            range(one.start or 0, one.stop, one.step or 1)
            for one in (key if isinstance(key, tuple) else (key,))
        ]
        shape = tuple(map(len, sides))
        parts = [
            broadcast_to(
                array_of(side, int64).reshape([-1 if at == axis else 1 for at in range(len(sides))]), shape
            )
            for axis, side in enumerate(sides)
        ]
        return stack(parts)


class _Index:
    def __getitem__(self, key: Any) -> Any:
        return key


mgrid, s_ = _Grid(), _Index()


# The same elements elsewhere


def reshape(values: Any, shape: Any) -> ndarray:
    return asarray(values).reshape(shape)


def transpose(values: Any, axes: Any = ()) -> ndarray:
    return asarray(values).transpose(axes)


def swapaxes(values: Any, first: int, second: int) -> ndarray:
    found = asarray(values)
    order = [*range(found.ndim)]
    order[first], order[second] = order[second], order[first]
    return found.transpose(order)


def moveaxis(values: Any, source: int, destination: int) -> ndarray:
    found = asarray(values)
    (first,), (last,) = axes_of(source, found.ndim), axes_of(destination, found.ndim)
    order = [axis for axis in range(found.ndim) if axis != first]
    order.insert(last, first)
    return found.transpose(order)


def expand_dims(values: Any, axis: int) -> ndarray:
    found = asarray(values)
    if not -found.ndim - 1 <= axis <= found.ndim:
        raise IndexError(f"axis {axis} is out of bounds for array of dimension {found.ndim + 1}")
    sides = list(found.shape)
    sides.insert(axis % (found.ndim + 1), 1)
    return found.reshape(sides)


def atleast_1d(values: Any) -> ndarray:
    found = asarray(values)
    return found.reshape(1) if found.ndim == 0 else found


def flip(values: Any, axis: int) -> ndarray:
    found = asarray(values)
    key = [slice(None)] * found.ndim
    key[axis] = slice(None, None, -1)
    return found[tuple(key)]


def rot90(values: Any, k: int = 1, axes: tuple[int, int] = (0, 1)) -> ndarray:
    found = asarray(values)
    first, second = axes
    turns = k % 4
    if turns == 0:
        return found[:]
    if turns == 2:
        return flip(flip(found, first), second)
    return (
        swapaxes(flip(found, second), first, second)
        if turns == 1
        else flip(swapaxes(found, first, second), second)
    )


def roll(values: Any, shift: Any, axis: Any = None) -> ndarray:
    found = asarray(values)
    if axis is None:
        return roll(found.ravel(), shift, 0).reshape(found.shape)
    shifts, axes = ([one] if isinstance(one, int) else list(one) for one in (shift, axis))
    axes = [axes_of(one, found.ndim)[0] for one in axes]
    raw, held = found.memory.raw, found.memory.type
    if not found.memory.single and raw:
        for places, place in zip(shifts, axes, strict=True):
            outer, inner = _product(found.shape[:place]), _product(found.shape[place + 1 :])
            raw = rolled(raw, held.itemsize, outer, found.shape[place], inner, places)
    return made(found.shape, found.dtype, Memory(raw, held))


def concatenate(arrays: Sequence[Any], axis: int = 0) -> ndarray:
    found = [asarray(one) for one in arrays]
    if not found:
        raise ValueError("need at least one array to concatenate")
    kind = reduce(promoted, [one.dtype for one in found])
    (place,) = axes_of(axis, found[0].ndim)
    rests = {(*one.shape[:place], *one.shape[place + 1 :]) for one in found}
    if len(rests) > 1:
        raise ValueError(
            "all the input array dimensions except for the concatenation axis must match exactly"
        )
    memories = [converted(one.full, one.dtype, kind) for one in found]
    held = kind if any(one.type.itemsize > 1 for one in memories) else memories[0].type
    raws = [own(one, held) if held.kind != "f" else one.raw for one in memories]
    lengths = [_product(one.shape[place:]) * held.itemsize for one in found]
    shape = list(found[0].shape)
    shape[place] = sum(one.shape[place] for one in found)
    kept = [(raw, length) for raw, length in zip(raws, lengths, strict=True) if raw]
    raw = joined([one for one, _ in kept], [length for _, length in kept]) if kept else b""
    return made(tuple(shape), kind, Memory(raw, held))


def stack(arrays: Sequence[Any], axis: int = 0) -> ndarray:
    found = [asarray(one) for one in arrays]
    if len({one.shape for one in found}) != 1:
        raise ValueError("all input arrays must have the same shape")
    return concatenate([expand_dims(one, axis) for one in found], axis)


def repeat(values: Any, repeats: int, axis: int | None = None) -> ndarray:
    found = asarray(values)
    if axis is None or not found.shape:
        found, axis = found.ravel(), 0
    shape = list(found.shape)
    shape[axis] *= repeats
    held = found.memory.type
    raw = repeated(
        found.full.raw, _product(found.shape[axes_of(axis, found.ndim)[0] + 1 :]) * held.itemsize, repeats
    )
    return made(tuple(shape), found.dtype, Memory(raw, held))


def take(values: Any, indices: Any, axis: int) -> ndarray:
    found = asarray(values)
    return found[(slice(None),) * axes_of(axis, found.ndim)[0] + (asarray(indices),)]


def delete(values: Any, obj: int, axis: int | None = None) -> ndarray:
    found = asarray(values)
    if axis is None:
        found, axis = found.ravel(), 0
    side = found.shape[axis]
    gone = range(side)[obj]
    return take(found, array_of([one for one in range(side) if one != gone], int64), axis)


def pad(values: Any, pad_width: int) -> ndarray:
    """Zeros around an array, as many on each side."""
    found = asarray(values)
    wide = zeros([side + 2 * pad_width for side in found.shape], found.dtype)
    wide[tuple(slice(pad_width, pad_width + side) for side in found.shape)] = found
    return wide


# Values


def where(condition: Any, yes: Any, no: Any) -> Any:
    flags = asarray(condition, bool_)
    try:
        (a, b), kind, shape = operands([_number(yes), _number(no)])
    except OverflowError as error:
        raise TypeError(f"{error}: where of it is not there without NumPy") from None
    whole = broadcast([flags.shape, shape])
    raw = flags.memory.raw
    if not flags.memory.single:
        raw = expanded(raw, 1, flags.shape, whole)
    if whole != shape:
        a, b = (
            one if one.single else Memory(expanded(one.raw, one.type.itemsize, shape, whole), one.type)
            for one in (a, b)
        )
    return made(whole, kind, arithmetic.chosen(raw, a, b, kind, _product(whole)))


def _number(value: Any) -> Any:
    return value if isinstance(value, (Numbers, bool, int, float)) else asarray(value)


def select(conditions: Sequence[Any], choices: Sequence[Any], default: Any = 0) -> ndarray:
    """The choice of the first condition that holds in each place."""
    found = asarray(default, reduce(promoted, [asarray(one).dtype for one in (*choices, default)]))
    for condition, choice in zip(reversed(conditions), reversed(choices), strict=True):
        found = where(condition, choice, found)
    return found


def isin(values: Any, test_elements: Any) -> Any:
    found = asarray(values)
    if isinstance(test_elements, list) and {*map(type, test_elements)} <= {int} and found.dtype.kind != "f":
        wanted = frozenset(test_elements)
    else:
        tests = asarray(test_elements)
        if found.dtype.kind == "f" or (tests.dtype.kind == "f" and tests.size):
            raise TypeError("isin of floats is not there without NumPy")
        wanted = frozenset(tests.ravel().tolist())
    if found.memory.type.itemsize == 1 and found.memory.type.code == "B":
        raw = found.memory.raw.translate(_members(wanted))
    else:
        raw = bytes(map(wanted.__contains__, numbers(found.memory)))
    return result(found.shape, bool_, Memory(raw, bool_), False)


@lru_cache(maxsize=256)
def _members(wanted: frozenset[int]) -> bytes:
    return bytes(one in wanted for one in range(256))


def clip(values: Any, low: Any, high: Any) -> Any:
    if isnan(low).any() or isnan(high).any():
        raise TypeError("clip to NaN is not there without NumPy")
    return binary("lowered", binary("raised", values, low), high)


def minimum(x: Any, y: Any) -> Any:
    return binary("minimum", x, y)


def maximum(x: Any, y: Any) -> Any:
    return binary("maximum", x, y)


class _LogicalOr:
    """`logical_or`, and its reduction over a list of arrays."""

    def __call__(self, x: Any, y: Any) -> Any:
        return binary("bitwise_or", asarray(x, bool_), asarray(y, bool_))

    def reduce(self, arrays: Sequence[Any]) -> Any:
        return reduce(self, arrays)


logical_or = _LogicalOr()


def absolute(x: Any) -> Any:
    found = _array(x)
    return found.__abs__()


def _array(x: Any) -> Numbers:
    return x if isinstance(x, Numbers) else asarray(x)


def sqrt(x: Any) -> Any:
    return _of_floats("sqrt", x)


def floor(x: Any) -> Any:
    return _of_floats("floor", x)


def _of_floats(op: str, x: Any) -> Any:
    found = _array(x)
    if found.dtype.kind != "f":
        if op == "floor" or found.dtype.itemsize < 4:
            raise TypeError(f"{op} of {found.dtype} is not there without NumPy")
        found = found.astype(float64)
    return result(found.shape, found.dtype, arithmetic.of_floats(op, found.memory, found.dtype))


def hypot(x: Any, y: Any) -> Any:
    return binary("hypot", x, y)


def isnan(x: Any) -> Any:
    found = _array(x)
    flags = arithmetic.is_nan(found.memory) if found.dtype.kind == "f" else b"\0"
    return result(found.shape, bool_, Memory(flags, bool_))


def isfinite(x: Any) -> Any:
    found = _array(x)
    flags = arithmetic.is_finite(found.memory) if found.dtype.kind == "f" else b"\1"
    return result(found.shape, bool_, Memory(flags, bool_))


def nan_to_num(x: Any) -> Any:
    """NaN as 0; infinities are not there without NumPy."""
    found = _array(x)
    kept = where(isnan(found), found.dtype(0), found)
    if not isfinite(kept).all():
        raise TypeError("nan_to_num of infinities is not there without NumPy")
    return kept


def nextafter(x: Any, toward: Any) -> Any:
    """The next float32 after a number."""
    (a, b), kind, shape = operands([x, toward])
    if kind is not float32 or shape:
        raise TypeError("nextafter is there for scalars of float32 alone without NumPy")
    value, end = number(a), number(b)
    if value == end or value != value:
        return result((), kind, b if value == end else a)
    bits = int.from_bytes(a.raw, "little")
    if value == 0:
        bits = 1 if end > 0 else (1 << 31) | 1
    else:
        bits += 1 if (end > value) == (value > 0) else -1
    return result((), kind, Memory(bits.to_bytes(4, "little"), kind))


# Questions


def array_equal(x: Any, y: Any) -> bool:
    a, b = asarray(x), asarray(y)
    return a.shape == b.shape and bool(binary("equal", a, b).all())


def nonzero(values: Any) -> tuple[ndarray, ...]:
    return asarray(values).nonzero()


def flatnonzero(values: Any) -> ndarray:
    return asarray(values).ravel().nonzero()[0]


def argwhere(values: Any) -> ndarray:
    return stack(nonzero(values), 1)


def unique(values: Any) -> ndarray:
    """The different numbers, in ascending order."""
    found = asarray(values)
    if found.dtype.kind == "f" and isnan(found).any():
        raise TypeError("unique of NaN is not there without NumPy")
    if found.memory.type.code == "B":
        there = sorted(set(found.full.raw))
    else:
        there = sorted(dict.fromkeys(numbers(found.full)))
    return array_of(there, found.dtype)


def searchsorted(values: Any, wanted: Any, side: str = "left") -> Any:
    call = bisect_left if side == "left" else bisect_right
    listed, found = asarray(values).tolist(), _array(wanted)
    if isnan(found).any():
        raise TypeError("searchsorted of NaN is not there without NumPy")
    places = [
        call(listed, one) for one in (bool(v) if found.dtype is bool_ else v for v in numbers(found.full))
    ]
    return result(found.shape, int64, checked(places, int64))


def cumsum(values: Any) -> ndarray:
    found = asarray(values)
    if found.dtype.kind not in "bi" or found.ndim != 1:
        raise TypeError("cumsum is there for one axis of signed integers alone without NumPy")
    sums = [*accumulate(numbers(found.full))]
    return made((len(sums),), int64, packed(sums, int64))


def product_of(values: Any) -> Any:
    return asarray(values).prod()
