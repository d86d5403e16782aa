"""The names of NumPy that this project uses, on arrays in plain Python. Other names raise ModuleNotFoundError.

In NumPy a slice is a view, which sees later writes to its array. Here it is a copy that cannot be written to, and using
it after its array was written to is an error.
"""

from __future__ import annotations

import math
import operator
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from fractions import Fraction
from functools import partial, reduce
from itertools import compress
from math import prod
from typing import Any

from powderdsl.arrays import numbers
from powderdsl.arrays.numbers import Offsets, Type, Values

dtype = _dtype = numbers.dtype  # `_dtype` where an argument has the name
bool_, int8, int16, int32, int64 = map(dtype, ("bool", "int8", "int16", "int32", "int64"))
uint8, uint16, uint32, uint64 = map(dtype, ("uint8", "uint16", "uint32", "uint64"))
float32, float64 = dtype("float32"), dtype("float64")

Shape = tuple[int, ...]


def __getattr__(name: str) -> Any:
    message = f"`{name}` is not supported without NumPy"
    raise AttributeError(message) if name.startswith("_") else ModuleNotFoundError(message, name="numpy")


def _reduction(call: Callable[[Values], Any], result: Type | None = None) -> Any:
    """A method that reduces an axis, some axes, or all of them to one number."""

    def method(self: ndarray, axis: Any = None) -> ndarray:
        full, kind = self.full, result or self.dtype
        real = self.dtype.kind == "f" and kind is not bool_
        if (call is sum and self.dtype.kind not in "bi") or (real and any(value != value for value in full)):
            raise TypeError("sums of such numbers and extremes of NaN are not supported without NumPy")
        axes = range(self.ndim)
        reduced = [axes[i] for i in (axes if axis is None else [axis] if isinstance(axis, int) else axis)]
        rest = [i for i in axes if i not in reduced]
        shape = tuple(self.shape[i] for i in rest)
        if rest and rest[-1] > reduced[0]:
            offsets = self.offsets()
            full = numbers.gather(full, [offsets[i] for i in (*rest, *reduced)])
        length = prod(self.shape[i] for i in reduced)
        rows = [full[at * length : (at + 1) * length] for at in range(prod(shape))]
        return ndarray(shape, kind, numbers.pack([*map(call, rows)], kind))

    return method


class ndarray:
    """An array. One without axes is a number, as reductions and indices of single cells return it."""

    __slots__ = ("_base", "_seen", "_values", "_written", "dtype", "shape")

    def __init__(self, shape: Shape, kind: Type, values: Values, base: ndarray | None = None):
        """`values`: all of them, or one if they are equal. `base`: the array of which this is a view."""
        self.shape, self.dtype, self._values, self._written = shape, kind, values, 0
        self._base: ndarray | None = base if base is None or base._base is None else base._base
        self._seen = 0 if self._base is None else self._base._written

    def __class_getitem__(cls, _: Any) -> Any:
        return cls

    @property
    def values(self) -> Values:
        """All values, or one if they are equal."""
        if self._base is not None and self._base._written != self._seen:
            raise ValueError(
                "a view of an array that was written to is not supported without NumPy: copy it first"
            )
        return self._values

    @property
    def full(self) -> Values:
        values, size = self.values, self.size
        return values if len(values) == size else values * size

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def size(self) -> int:
        return prod(self.shape)

    any, all = _reduction(any, bool_), _reduction(all, bool_)
    min, max, sum = _reduction(min), _reduction(max), _reduction(sum, int64)
    argmax = _reduction(lambda values: list(values).index(max(values)), int64)

    # To Python's values

    def tolist(self) -> Any:
        listed: Any = list(map(bool, self.full)) if self.dtype is bool_ else list(self.full)
        if self.shape == ():
            return listed[0]
        for side in reversed(self.shape[1:]):
            listed = [listed[at : at + side] for at in range(0, len(listed), side)] if side else []
        return listed

    def tobytes(self) -> bytes:
        return numbers.raw_of(self.full, self.dtype)

    def _number(self) -> Any:
        if self.size != 1:
            raise ValueError("an array of several numbers is not one: use any() or all()")
        return self.values[0]

    def __bool__(self) -> bool:
        return bool(self._number())

    def __int__(self) -> int:
        return int(self._number())

    def __float__(self) -> float:
        return float(self._number())

    def __index__(self) -> int:
        return operator.index(self.tolist())

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[ndarray]:
        return (self[place] for place in range(len(self)))

    # The same values in another form

    def copy(self) -> ndarray:
        return ndarray(self.shape, self.dtype, self.values)

    def astype(self, kind: Any) -> ndarray:
        wanted = dtype(kind)
        return ndarray(self.shape, wanted, numbers.convert(self.values, self.dtype, wanted))

    def reshape(self, *shape: Any) -> ndarray:
        sides = list(shape[0] if len(shape) == 1 and not isinstance(shape[0], int) else shape)
        if -1 in sides:
            rest = prod(side for side in sides if side != -1)
            sides[sides.index(-1)] = self.size // rest if rest else -1
        if prod(sides) != self.size or min(sides, default=0) < 0:
            raise ValueError(f"{self.size} values do not have the shape {sides}")
        return ndarray(tuple(sides), self.dtype, self.values, self)

    def offsets(self) -> list[range]:
        """The offsets of the values along each axis."""
        steps = [prod(self.shape[axis + 1 :]) or 1 for axis in range(self.ndim)]
        return [range(0, side * step, step) for side, step in zip(self.shape, steps, strict=True)]

    # Indexing

    def __getitem__(self, key: Any) -> ndarray:
        values = self.values
        if isinstance(key, ndarray) and isinstance(values, bytes) and self.ndim == 1 and len(values) > 1:
            places, there = key.values, bytes(range(min(len(values), 256)))
            if key.dtype is not bool_ and isinstance(places, bytes) and not places.translate(None, there):
                return ndarray(key.shape, self.dtype, places.translate(values[:256].ljust(256, b"\0")))
        axes, shape, picked = self._select(key)
        base = None if picked or not shape else self
        return ndarray(shape, self.dtype, numbers.gather(values, axes), base)

    def __setitem__(self, key: Any, value: Any) -> None:
        if self._base is not None:
            raise ValueError("writing to a view is not supported without NumPy: copy it first")
        new_values = asarray(value, self.dtype)
        axes, shape, _ = self._select(key)
        old, new = numbers.unify([self.full, broadcast_to(new_values, shape).full], self.dtype)
        self._values = numbers.scatter(old, axes, new)
        self._written += 1

    def _select(self, key: Any) -> tuple[list[Offsets], Shape, bool]:
        """The offsets along each axis of the values that a key selects, their shape, and True if arrays select them."""
        items = [_part(item) for item in (key if isinstance(key, tuple) else (key,))]
        rest = [slice(None)] * (self.ndim - sum(map(_axes_taken, items)))
        dots = next((place for place, item in enumerate(items) if item is ...), None)
        items = items + rest if dots is None else items[:dots] + rest + items[dots + 1 :]
        arrays = []
        if any(isinstance(item, ndarray) for item in items):  # integers beside arrays are like them
            arrays = [at for at, item in enumerate(items) if isinstance(item, (ndarray, int))]
            if arrays != [*range(arrays[0], arrays[-1] + 1)]:
                raise IndexError("arrays that are apart in an index are not supported without NumPy")
        axes: list[Offsets] = []
        shape: list[int] = []
        together: list[ndarray] = []
        steps, axis = [offset.step for offset in self.offsets()], 0
        for place, item in enumerate(items):
            if item is None:
                shape.append(1)
            elif isinstance(item, slice):
                side, step = range(*item.indices(self.shape[axis])), steps[axis]
                axes.append(range(side.start * step, side.stop * step, side.step * step))
                shape.append(len(side))
            elif place not in arrays:
                axes.append([_within([item], self.shape[axis])[0] * steps[axis]])
            else:
                together.append(_places(item, self.shape[axis:], steps[axis:]))
                if place == arrays[-1]:
                    offsets = reduce(operator.add, together)
                    axes.append(list(offsets.full))
                    shape += offsets.shape
            axis += _axes_taken(item)
        return axes, tuple(shape), bool(arrays)

    # Operations

    def __neg__(self) -> ndarray:
        return _map(operator.neg, self, "iuf")

    def __invert__(self) -> ndarray:
        return _binary("xor", self, True if self.dtype is bool_ else -1)

    def __abs__(self) -> ndarray:
        return _map(operator.abs, self, "if")


def _map(call: Callable[[Any], Any], array: ndarray, kinds: str) -> ndarray:
    if array.dtype.kind not in kinds:
        raise TypeError(f"{call} of {array.dtype} is not supported without NumPy")
    return ndarray(array.shape, array.dtype, numbers.pack([*map(call, array.values)], array.dtype))


def _part(item: Any) -> Any:
    """A part of a key: None, Ellipsis, a slice, an integer, or an array of places or flags."""
    if item is None or item is ... or isinstance(item, slice) or type(item) is int:
        return item
    array = asarray(item, int64) if isinstance(item, list) and not item else asarray(item)
    if array.dtype.kind == "f" or (array.dtype is bool_ and not array.shape):
        raise IndexError(f"an index of {array.dtype} is not supported without NumPy")
    return array if array.shape else int(array)


def _axes_taken(item: Any) -> int:
    if item is None or item is ...:
        return 0
    return item.ndim if isinstance(item, ndarray) and item.dtype is bool_ else 1


def _places(item: int | ndarray, sides: Shape, steps: Sequence[int]) -> ndarray:
    """The offsets that an integer or an array selects along the first of some axes, or flags along several."""
    if isinstance(item, ndarray) and item.dtype is bool_:
        if item.shape != sides[: item.ndim]:
            raise IndexError(f"flags of the shape {item.shape} in an index of {sides}")
        step = steps[item.ndim - 1]
        flagged = [*compress(range(0, item.size * step, step), item.full)]
        return ndarray((len(flagged),), int64, numbers.pack(flagged, int64))
    shape, listed = ((), [item]) if isinstance(item, int) else (item.shape, item.full)
    places = [place * steps[0] for place in _within(listed, sides[0])]
    return ndarray(shape, int64, numbers.pack(places, int64))


def _within(places: Sequence[int], side: int) -> Sequence[int]:
    """Places along an axis, counted from its beginning."""
    if not len(places) or 0 <= min(places) <= max(places) < side:
        return places
    return [range(side)[place] for place in places]


# New arrays


def asarray(values: Any, dtype: Any = None) -> ndarray:
    """An array of an array, of a number, or of nested lists."""
    if isinstance(values, ndarray):
        return values if dtype is None or dtype is values.dtype else values.astype(dtype)
    shape, leaves = _nested(values)
    types = dict.fromkeys(map(type, leaves))
    arrays = [leaf for leaf in leaves if isinstance(leaf, ndarray)] if ndarray in types else []
    if dtype is None:
        kinds = [leaf.dtype for leaf in arrays] + [_dtype(leaf) for leaf in types if leaf is not ndarray]
        kind = reduce(numbers.promote, kinds) if kinds else float64
    else:
        kind = _dtype(dtype)
    if arrays:
        leaves = [n for leaf in leaves for n in (leaf.full if isinstance(leaf, ndarray) else (leaf,))]
    return ndarray(shape, kind, numbers.pack_exactly(leaves, kind))


def _nested(values: Any) -> tuple[Shape, list[Any]]:
    """The shape of nested lists, and the numbers and arrays in them."""
    if isinstance(values, ndarray):
        return values.shape, [values]
    if not isinstance(values, (list, tuple, range)):
        if not isinstance(values, (bool, int, float, Fraction)):
            raise TypeError(f"without NumPy, {type(values).__name__} cannot become an array")
        return (), [values]
    if not {*map(type, values)} & {list, tuple, range, ndarray}:
        return (len(values),), list(values)
    parts = [_nested(part) for part in values]
    if len({shape for shape, _ in parts}) > 1:
        raise ValueError("lists of different lengths cannot form an array")
    return (len(values), *parts[0][0]), [leaf for _, leaves in parts for leaf in leaves]


def array(values: Any, dtype: Any = None) -> ndarray:
    return asarray(values, dtype).copy()


ascontiguousarray = asarray


def full(shape: Any, fill_value: Any, dtype: Any = None) -> ndarray:
    value = asarray(fill_value, dtype)
    return broadcast_to(value, (shape,) if isinstance(shape, int) else shape).copy()


def zeros(shape: Any, dtype: Any = float64) -> ndarray:
    return full(shape, 0, dtype)


def ones(shape: Any, dtype: Any = float64) -> ndarray:
    return full(shape, 1, dtype)


def full_like(values: ndarray, fill_value: Any) -> ndarray:
    return full(values.shape, fill_value, values.dtype)


def zeros_like(values: ndarray) -> ndarray:
    return full_like(values, 0)


def arange(start: int, stop: int | None = None, *, dtype: Any = int64) -> ndarray:
    return asarray(range(start) if stop is None else range(int(start), int(stop)), dtype)


def frombuffer(buffer: Any, dtype: Any) -> ndarray:
    """A copy, which cannot be written to."""
    kind = _dtype(dtype)
    values = numbers.unpack(bytes(buffer), kind.code)
    return ndarray((len(values),), kind, values)[:]


# The same values elsewhere


def broadcast_to(values: Any, shape: Any) -> ndarray:
    """A view of values repeated along new axes and along those of one."""
    array, target = asarray(values), tuple(shape)
    if array.shape == target:
        return array
    while array.ndim > len(target) and array.shape[0] == 1:
        array = array.reshape(array.shape[1:])
    missing = len(target) - array.ndim
    sides = (1,) * missing + array.shape
    if missing < 0 or any(side not in (1, wanted) for side, wanted in zip(sides, target, strict=True)):
        raise ValueError(f"{array.shape} does not fit {target}")
    offsets: list[Offsets] = [*[range(1)] * missing, *array.offsets()]
    axes = [
        [0] * wanted if side == 1 != wanted else offset
        for side, wanted, offset in zip(sides, target, offsets, strict=True)
    ]
    return ndarray(target, array.dtype, numbers.gather(array.values, axes), array)


def moveaxis(values: ndarray, source: int, destination: int) -> ndarray:
    moved = range(values.ndim)[source]
    order = [axis for axis in range(values.ndim) if axis != moved]
    order.insert(range(values.ndim)[destination], moved)
    axes, shape = values.offsets(), tuple(values.shape[axis] for axis in order)
    return ndarray(shape, values.dtype, numbers.gather(values.values, [axes[axis] for axis in order]), values)


def roll(values: ndarray, shift: Any, axis: Any) -> ndarray:
    rolled, shape = values.values, values.shape
    for places, axis_number in [(shift, axis)] if isinstance(axis, int) else zip(shift, axis, strict=True):
        at = range(len(shape))[axis_number]
        rolled = numbers.roll(rolled, shape[at], prod(shape[at + 1 :]), places)
    return ndarray(shape, values.dtype, rolled)


def concatenate(arrays: Sequence[ndarray], axis: int = 0) -> ndarray:
    kind = reduce(numbers.promote, [a.dtype for a in arrays])
    at = range(arrays[0].ndim)[axis]
    ((before, after),) = dict.fromkeys((a.shape[:at], a.shape[at + 1 :]) for a in arrays)
    parts = numbers.unify([numbers.convert(a.full, a.dtype, kind) for a in arrays], kind)
    lengths = [prod(a.shape[at:]) for a in arrays]
    blocks = [
        part[row * length : (row + 1) * length]
        for row in range(prod(before))
        for part, length in zip(parts, lengths, strict=True)
    ]
    shape = (*before, sum(a.shape[at] for a in arrays), *after)
    return ndarray(shape, kind, numbers.unpack(b"".join(blocks), getattr(parts[0], "typecode", "B")))


def stack(arrays: Sequence[ndarray], axis: int = 0) -> ndarray:
    at = range(arrays[0].ndim + 1)[axis]
    return concatenate([a.reshape(*a.shape[:at], 1, *a.shape[at:]) for a in arrays], at)


def repeat(values: ndarray, repeats: int, axis: int) -> ndarray:
    at, shape = range(values.ndim)[axis], list(values.shape)
    axes: list[Offsets] = [*values.offsets()]
    axes[at] = [offset for offset in axes[at] for _ in range(repeats)]
    shape[at] *= repeats
    return ndarray(tuple(shape), values.dtype, numbers.gather(values.values, axes))


# Operations on values


def _together(first: Shape, second: Shape) -> Shape:
    """The shape of two arrays together; `broadcast_to` refuses arrays that do not fit it."""
    count = max(len(first), len(second))
    pairs = zip((1,) * (count - len(first)) + first, (1,) * (count - len(second)) + second, strict=True)
    return tuple(b if a == 1 else a for a, b in pairs)


def _match(x: Any, y: Any) -> tuple[Values, Values, Type, Shape]:
    """Two arrays or numbers as values of one type, and their shape. Numbers of Python adapt to the type of the other.

    Raises OverflowError for an integer that the type cannot hold.
    """
    if type(x) is not ndarray and type(y) is not ndarray:
        x, y = asarray(x), asarray(y)
    if type(x) is type(y) is ndarray:
        if x.shape == y.shape and x.dtype is y.dtype:
            return x.values, y.values, x.dtype, x.shape
        kind, shape = numbers.promote(x.dtype, y.dtype), _together(x.shape, y.shape)
    else:
        array, number = (x, y) if type(x) is ndarray else (y, x)
        kind, shape, own = array.dtype, array.shape, dtype(type(number))
        kind = own if "biuf".index(kind.kind) < "biuf".index(own.kind) else kind
    return _operand(x, kind, shape), _operand(y, kind, shape), kind, shape


def _operand(number: Any, kind: Type, shape: Shape) -> Values:
    if type(number) is not ndarray:
        return numbers.pack_exactly([number], kind)
    values = number.values if number.shape == shape else broadcast_to(number, shape).values
    return numbers.convert(values, number.dtype, kind)


def _binary(op: str, x: Any, y: Any) -> ndarray:
    a, b, kind, shape = _match(x, y)
    return ndarray(shape, kind, numbers.arithmetic(op, a, b, kind, prod(shape)))


def _compare(op: str, x: Any, y: Any) -> ndarray:
    a, b, _, shape = _match(x, y)
    return ndarray(shape, bool_, numbers.compare(op, a, b, prod(shape)))


def _operator(call: Callable[[str, Any, Any], ndarray], op: str, swapped: bool = False) -> Any:
    def operator(self: ndarray, other: Any) -> Any:
        return call(op, other, self) if swapped else call(op, self, other)

    return operator


for _op in ("add", "sub", "mul", "truediv", "floordiv", "mod", "and_", "or_", "xor", "lshift", "rshift"):
    setattr(ndarray, f"__{_op.strip('_')}__", _operator(_binary, _op))
    setattr(ndarray, f"__r{_op.strip('_')}__", _operator(_binary, _op, swapped=True))
    setattr(ndarray, f"__i{_op.strip('_')}__", None)  # `+=` is an error: views would see it in NumPy
for _op in ("eq", "ne", "lt", "le", "gt", "ge"):
    setattr(ndarray, f"__{_op}__", _operator(_compare, _op))


def where(condition: Any, yes: Any, no: Any) -> ndarray:
    flags = asarray(condition, bool_)
    a, b, kind, shape = _match(yes, no)
    whole = _together(flags.shape, shape)
    mask, yes, no = (
        broadcast_to(operand, whole).values
        for operand in (flags, ndarray(shape, kind, a), ndarray(shape, kind, b))
    )
    return ndarray(whole, kind, numbers.choose(bytes(mask), yes, no, kind, prod(whole)))


def isin(values: ndarray, test_elements: Sequence[int]) -> ndarray:
    wanted, stored = frozenset(test_elements), values.values
    if isinstance(stored, bytes):
        table = bytes(number in wanted for number in range(256))
        return ndarray(values.shape, bool_, stored.translate(table))
    return ndarray(values.shape, bool_, bytes(map(wanted.__contains__, stored)))


minimum, maximum = partial(_binary, "minimum"), partial(_binary, "maximum")
abs = operator.abs


def clip(values: Any, low: Any, high: Any) -> ndarray:
    return minimum(high, maximum(low, asarray(values)))


def sqrt(x: ndarray) -> ndarray:
    """NaN below 0."""
    return _map(lambda value: math.sqrt(value) if value >= 0 else math.nan, x, "f")


def floor(x: ndarray) -> ndarray:
    return _map(lambda value: float(math.floor(value)) if value and math.isfinite(value) else value, x, "f")


def isnan(x: ndarray) -> ndarray:
    return _compare("ne", x, x)


def isfinite(x: ndarray) -> ndarray:
    return ndarray(x.shape, bool_, bytes(map(math.isfinite, x.values)))


def errstate(**_: str) -> nullcontext[None]:
    """Arithmetic never warns here."""
    return nullcontext()


# Comparisons and searches


def array_equal(x: Any, y: Any) -> bool:
    a, b = asarray(x), asarray(y)
    return a.shape == b.shape and bool(_compare("eq", a, b).all())


def nonzero(values: ndarray) -> tuple[ndarray, ...]:
    places, coordinates = [*compress(range(values.size), values.full)], []
    for side in reversed(values.shape):
        coordinates.append(asarray([place % side for place in places], int64))
        places = [place // side for place in places]
    return tuple(reversed(coordinates))


def unique(values: Any) -> ndarray:
    """The different numbers, in ascending order; NaN counts once and comes last."""
    array = asarray(values)
    different = {value for value in array.values if value == value}
    nan = [math.nan] if any(value != value for value in array.values) else []
    return asarray([*sorted(different), *nan], array.dtype)


def searchsorted(values: ndarray, wanted: ndarray, side: str = "left") -> ndarray:
    """The number of ascending numbers below each of others, or not above each (``right``)."""
    call, listed = bisect_left if side == "left" else bisect_right, values.tolist()
    if bool(isnan(wanted).any()):
        raise TypeError("searchsorted of NaN is not supported without NumPy")
    counts = [call(listed, number) for number in wanted.values]
    return ndarray(wanted.shape, int64, numbers.pack_exactly(counts, int64))
