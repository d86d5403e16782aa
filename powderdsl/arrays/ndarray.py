"""Arrays of numbers with any number of axes, and scalars, as NumPy has them.

Memory is never changed, only replaced, so that arrays can share it. In NumPy a slice is a view, which sees what is
written to its array later. Here writing is refused while there are other arrays on the same memory.
"""

from __future__ import annotations

import operator
import sys
from collections.abc import Iterator, Sequence
from math import prod
from typing import Any, ClassVar

from powderdsl.arrays.arithmetic import (
    absolute,
    chosen,
    inverted,
    negated,
)
from powderdsl.arrays.dtypes import bool_, dtype, int64
from powderdsl.arrays.indexing import Mask, Picks, Ranges, broadcast, selected
from powderdsl.arrays.memories import Memory, checked, converted, filled, number, numbers, own
from powderdsl.arrays.movement import (
    Shape,
    expanded,
    looked_up,
    permuted,
    put,
    put_shuffled,
    put_sliced,
    shuffled,
    sliced,
)
from powderdsl.arrays.reductions import axes_of, reduced
from powderdsl.arrays.shown import shown


class Numbers:
    """What arrays and scalars have in common."""

    __slots__ = ("dtype", "fixed", "memory", "owner", "shape")
    __hash__: ClassVar[None] = None  # type: ignore[assignment]  # arrays have no hash, as in NumPy

    shape: Shape
    dtype: dtype
    memory: Memory
    owner: Any
    """Shared with arrays that NumPy would give the same memory; None while there are none."""
    fixed: bool
    """Whether it must not be written to."""

    def __class_getitem__(cls, _: Any) -> Any:
        return cls

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def size(self) -> int:
        return prod(self.shape)

    @property
    def itemsize(self) -> int:
        return self.dtype.itemsize

    @property
    def nbytes(self) -> int:
        return self.size * self.dtype.itemsize

    @property
    def T(self) -> ndarray:
        return self.transpose()

    @property
    def full(self) -> Memory:
        """The memory of all elements."""
        return filled(self.memory, self.size)

    # To Python's values

    def tolist(self) -> Any:
        memory = self.memory if self.shape == () else self.full
        values: Any = numbers(memory)
        values = [*map(bool, values)] if self.dtype is bool_ else list(values)
        if self.shape == ():
            return values[0]
        for side in reversed(self.shape[1:]):
            values = [values[at : at + side] for at in range(0, len(values), side)] if side else []
        return values

    def item(self) -> Any:
        if self.size != 1:
            raise ValueError("can only convert an array of size 1 to a Python scalar")
        value = number(self.memory)
        return bool(value) if self.dtype is bool_ else value

    def tobytes(self) -> bytes:
        full = self.full
        return bytes(full.raw if self.dtype.kind == "f" else own(full, self.dtype))

    def __bool__(self) -> bool:
        if self.size != 1:
            raise ValueError("The truth value of an array with more than one element is ambiguous. Use a.any() or a.all()")  # fmt: skip
        return bool(self.item())

    def __int__(self) -> int:
        return int(self.item())

    def __float__(self) -> float:
        return float(self.item())

    def __index__(self) -> int:
        if self.shape != () or self.dtype.kind not in "iu":
            raise TypeError("only integer scalar arrays can be converted to a scalar index")
        return int(self.item())

    def __len__(self) -> int:
        if self.shape == ():
            raise TypeError("len() of unsized object")
        return self.shape[0]

    def __iter__(self) -> Iterator[Any]:
        if self.shape == ():
            raise TypeError("iteration over a 0-d array")
        return (self[place] for place in range(self.shape[0]))

    def __contains__(self, value: Any) -> bool:
        return bool((self == value).any())

    def __str__(self) -> str:
        if self.shape == ():
            return shown(self.item(), self.dtype)
        return "[" + " ".join(map(str, self)) + "]"

    def __repr__(self) -> str:
        return f"{'array' if isinstance(self, ndarray) else self.dtype}({self})"

    def __format__(self, form: str) -> str:
        return format(self.item(), form) if form else str(self)

    # The same elements in another form

    def viewed(self, shape: Shape, memory: Memory) -> ndarray:
        """An array that is a view of this one in NumPy."""
        if self.owner is None:
            self.owner = object()
        return made(shape, self.dtype, memory, self.owner, self.fixed)

    def copy(self) -> ndarray:
        return made(self.shape, self.dtype, self.memory)

    def astype(self, kind: Any, copy: bool = True) -> Any:
        wanted = dtype(kind)
        if wanted is self.dtype and not copy:
            return self
        return result(
            self.shape, wanted, converted(self.memory, self.dtype, wanted), isinstance(self, generic)
        )

    def reshape(self, *shape: Any) -> ndarray:
        sides = list(shape[0] if len(shape) == 1 and not isinstance(shape[0], int) else shape)
        if -1 in sides:
            rest = prod(side for side in sides if side != -1)
            sides[sides.index(-1)] = self.size // rest if rest else -1
        if prod(sides) != self.size or min(sides, default=0) < 0:
            raise ValueError(f"cannot reshape array of size {self.size} into shape {tuple(sides)}")
        return self.viewed(tuple(map(operator.index, sides)), self.memory)

    def ravel(self) -> ndarray:
        return self.reshape(-1)

    def transpose(self, *axes: Any) -> ndarray:
        given = axes[0] if len(axes) == 1 and not isinstance(axes[0], int) else axes
        order = [one % self.ndim for one in given] or [*reversed(range(self.ndim))]
        shape = tuple(self.shape[axis] for axis in order)
        if self.memory.single:
            return self.viewed(shape, self.memory)
        raw, held = self.memory.raw, self.memory.type
        return self.viewed(shape, Memory(permuted(raw, held.itemsize, self.shape, order), held))

    # Reductions

    def _reduced(self, name: str, axis: Any, keepdims: bool = False) -> Any:
        memory, kind = reduced(name, self.memory, self.dtype, self.shape, axis)
        axes = axes_of(axis, self.ndim) if self.shape else ()
        sides = [
            1 if at in axes else side for at, side in enumerate(self.shape) if keepdims or at not in axes
        ]
        return result(tuple(sides), kind, memory)

    def any(self, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("any", axis, keepdims)

    def all(self, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("all", axis, keepdims)

    def sum(self, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("sum", axis, keepdims)

    def prod(self, axis: Any = None) -> Any:
        return self._reduced("prod", axis)

    def mean(self, axis: Any = None) -> Any:
        return self._reduced("mean", axis)

    def min(self, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("min", axis, keepdims)

    def max(self, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("max", axis, keepdims)

    def argmin(self, axis: int | None = None) -> Any:
        return self._reduced("argmin", axis)

    def argmax(self, axis: int | None = None) -> Any:
        return self._reduced("argmax", axis)

    def nonzero(self) -> tuple[ndarray, ...]:
        flags = self.astype(bool_).full.raw
        places, found = [place for place, flag in enumerate(flags) if flag], []
        for side in reversed(self.shape):
            found.append([place % side for place in places])
            places = [place // side for place in places]
        return tuple(array_of(one, int64) for one in reversed(found))

    # Indexing

    def _key(self, key: Any) -> tuple[Any, ...]:
        return tuple(_index(one) for one in (key if isinstance(key, tuple) else (key,)))

    def __getitem__(self, key: Any) -> Any:
        parts = self._key(key)
        raw, held = self.memory.raw, self.memory.type
        if len(parts) == 1 and isinstance(parts[0], Picks) and self.shape and not self.memory.single:
            row = prod(self.shape[1:]) * held.itemsize
            rows = _rows_at(raw, row, self.shape[0], parts[0].values)
            if rows is not None:
                return made((*parts[0].shape, *self.shape[1:]), self.dtype, Memory(rows, held))
        found = selected(parts, self.shape)
        if isinstance(found, Ranges):
            if not self.memory.single:
                raw = sliced(raw, held.itemsize, self.shape, found.parts)
            if found.shape == () and ... not in parts:
                return result((), self.dtype, Memory(raw, held))
            return self.viewed(found.shape, Memory(raw, held))
        if not self.memory.single:
            raw = shuffled(raw, held.itemsize, found.block, found.places)
        return made(found.shape, self.dtype, Memory(raw, held))

    # Operations

    def __neg__(self) -> Any:
        if self.dtype is bool_:
            raise TypeError("The numpy boolean negative, the `-` operator, is not supported")
        return result(self.shape, self.dtype, negated(self.memory, self.dtype, self.size))

    def __pos__(self) -> Any:
        return self.copy()

    def __invert__(self) -> Any:
        if self.dtype.kind == "f":
            raise TypeError("floats have no bits to invert")
        return result(self.shape, self.dtype, inverted(self.memory, self.dtype, self.size))

    def __abs__(self) -> Any:
        return result(self.shape, self.dtype, absolute(self.memory, self.dtype, self.size))


class ndarray(Numbers):
    """An array, which can be written to."""

    __slots__ = ()

    def __setitem__(self, key: Any, value: Any) -> None:
        parts = self._key(key)
        found = selected(parts, self.shape)
        given = value if isinstance(value, Numbers) else _given(value, self.dtype)
        memory = converted(given.memory, given.dtype, self.dtype)
        self.check_writable()
        whole = isinstance(key, ndarray) and key.dtype is bool_ and key.shape == self.shape
        if whole and memory.single:
            flags = key.full.raw
            old = self.full if len(flags) == 1 else self.memory
            self.memory = chosen(flags, memory, old, self.dtype, self.size) if flags else self.memory
            return
        sides = given.shape
        if isinstance(found, Ranges) and found.shape == () != sides and ... not in parts:
            raise ValueError("setting one element with an array is not there without NumPy")
        if len(sides) > 1 and len(parts) == 1 and isinstance(parts[0], Mask):
            raise ValueError("boolean array indexing assignment requires a 0 or 1-dimensional input")
        while len(sides) > len(found.shape) and sides[0] == 1:
            sides = sides[1:]
        if broadcast([sides, found.shape]) != found.shape:
            raise ValueError(
                f"could not broadcast input array from shape {given.shape} into shape {found.shape}"
            )
        memory = _spread(memory, sides, found.shape)
        held = self.memory.type if memory.type is self.memory.type else self.dtype
        size = held.itemsize
        before, given_raw = own(self.full, held), own(filled(memory, prod(found.shape)), held)
        if isinstance(found, Ranges):
            raw = put_sliced(before, size, self.shape, found.parts, given_raw)
        elif found.block < self.size:
            raw = put_shuffled(before, size, found.block, found.places, given_raw)
        else:
            raw = put(before, size, found.places, given_raw)
        self.memory = Memory(raw, held)

    def check_writable(self) -> None:
        if self.fixed:
            raise ValueError("assignment destination is read-only")
        if self.owner is not None and _sharers(self) > _ALONE:
            raise ValueError("writing to an array that has views is not there without NumPy: copy it first")


class generic(Numbers):
    """A scalar: what an operation on single numbers gives."""

    __slots__ = ()

    def __hash__(self) -> int:  # type: ignore[override]  # scalars do have one
        return hash(self.item())


def made(shape: Shape, kind: dtype, memory: Memory, owner: Any = None, fixed: bool = False) -> ndarray:
    """An array on some memory; with an owner of its own unless one is given."""
    found = object.__new__(ndarray)
    found.shape, found.dtype, found.memory, found.fixed = shape, kind, memory, fixed
    found.owner = owner
    return found


def result(shape: Shape, kind: dtype, memory: Memory, scalar: bool = True) -> Any:
    """The result of an operation: a scalar if it has no axes."""
    if shape or not scalar:
        return made(shape, kind, memory)
    found = object.__new__(generic)
    found.shape, found.dtype, found.memory, found.fixed, found.owner = (), kind, memory, True, None
    return found


def array_of(values: Sequence[Any], kind: dtype) -> ndarray:
    """One axis of numbers that fit."""
    return made((len(values),), kind, checked(list(values), kind))


def _index(one: Any) -> Any:
    """A part of a key, as `selected` takes it."""
    if one is None or one is ... or isinstance(one, slice) or type(one) is int:
        return one
    if isinstance(one, bool):
        raise IndexError("flags as an index are not there without NumPy")
    if isinstance(one, Numbers) and one.shape == () and one.dtype is not bool_:
        return operator.index(one)
    found = one if isinstance(one, Numbers) else _listed(one)
    if found.dtype is bool_:
        return Mask(found.shape, found.full.raw)
    if found.size == 0 and not isinstance(one, Numbers):
        return Picks(found.shape, [])
    if found.dtype.kind not in "iu":
        raise IndexError("arrays used as indices must be of integer (or boolean) type")
    return Picks(found.shape, numbers(found.full))


def _sharers(array: Numbers) -> int:
    return sys.getrefcount(array.owner)


# How many references there are to the owner of one array: versions of Python count those in passing differently.
_ALONE = _sharers(made((), bool_, Memory(b"\0", bool_), object()))


LONGEST = 64
"""Bytes of a row of a table whose columns are looked up one by one."""


def _rows_at(raw: bytes, row: int, count: int, values: Sequence[int]) -> bytes | None:
    """The rows of a table at some places, in a fast way; None if there is none."""
    if isinstance(values, bytes):
        if count < 256 and values.translate(None, bytes(range(count))):
            return None
        if row <= LONGEST:
            return looked_up(raw, row, values)
    elif not values or min(values) < 0 or max(values) >= count:
        return None
    if row <= LONGEST:
        return None
    return b"".join([raw[value * row : (value + 1) * row] for value in values])


def _listed(values: Any) -> ndarray:
    from powderdsl.arrays.making import asarray

    if isinstance(values, str):
        raise IndexError("only integers, slices, ellipsis, None and arrays are valid indices")
    return asarray(values)


def _given(value: Any, kind: dtype) -> Numbers:
    from powderdsl.arrays.making import asarray

    return asarray(value, kind)


def _spread(memory: Memory, shape: Shape, target: Shape) -> Memory:
    if memory.single or shape == target:
        return memory
    return Memory(expanded(memory.raw, memory.type.itemsize, shape, target), memory.type)
