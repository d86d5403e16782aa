"""The libraries whose arrays worlds and programs use: `powderdsl.arrays` here, and torch in `tensor_kind`.

What both call by the same name is called by it, as `kind.xp.where`; the rest are methods of `ArrayKind`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from powderdsl.arrays import np

Array = Any
Bytes = Any
"""An object that has the buffer protocol."""


class ArrayKind(Protocol):
    """Arrays of one library on one device. Values that are equal mean the same ones."""

    def __hash__(self) -> int: ...

    @property
    def xp(self) -> Any:
        """The library's functions."""
        ...

    @property
    def flags(self) -> Any:
        """The dtype of flags, which libraries call by different names."""
        ...

    @property
    def on_cpu(self) -> bool:
        """Whether arrays are in this process's memory."""
        ...

    def given(self, value: Any, name: str) -> Array:
        """Values from outside as an array, which may share their memory. Raises TypeError."""
        ...

    def put(self, values: Any, dtype: str | None = None) -> Array:
        """An array of Python's numbers or flags."""
        ...

    def empty(self, dtype: Any, shape: tuple[int, ...]) -> Array:
        """A new array with any values."""
        ...

    def zeros(self, dtype: str, shape: tuple[int, ...]) -> Array:
        """A new array of zeros."""
        ...

    def arange(self, count: int) -> Array:
        """The first integers from 0, int64."""
        ...

    def copied(self, array: Array) -> Array:
        """The same values in memory of their own, in C order."""
        ...

    def contiguous(self, array: Array) -> Array:
        """The same values in C order."""
        ...

    def as_index(self, ids: Array) -> Array:
        """Ids in a dtype that can index a table."""
        ...

    def entries(self, table: Array, index: Array) -> Array:
        """The entries of a table [n], by an index of bytes [m]."""
        ...

    def sort(self, array: Array) -> str:
        """``bool``, ``int``, ``float`` or ``complex``."""
        ...

    def unbound(self, array: Array, axis: int) -> Sequence[Array]:
        """The parts of an array along an axis, which they lack."""
        ...

    def as_bytes(self, array: Array) -> Array:
        """The bytes of all values in C order, uint8 [n]; it may share their memory."""
        ...

    def to_numpy(self, array: Array) -> Array:
        """An array of `powderdsl.arrays`, which may share its memory."""
        ...

    def from_numpy(self, array: Array) -> Array:
        """An array of this library; it may share the memory of a given one that can be written to."""
        ...

    # Programs in the memory of this process

    def from_bytes(self, memory: bytearray, dtype: Any, shape: tuple[int, ...]) -> Array:
        """The array of cells in C order; it may share their memory."""
        ...

    def bytes_of(self, array: Array) -> Bytes:
        """The cells of a contiguous array in C order."""
        ...


_SORTS = {"b": "bool", "i": "int", "u": "int", "f": "float", "c": "complex"}


@dataclass(frozen=True)
class PlainArrays:
    """Arrays of `powderdsl.arrays`: NumPy's, or our own where NumPy is missing."""

    xp: ClassVar[Any] = np
    flags: ClassVar[Any] = np.bool_
    on_cpu: ClassVar[bool] = True

    def given(self, value: Any, name: str) -> Array:
        try:
            array = np.asarray(value)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise TypeError(f"{name}: {' '.join(str(error).split())}") from None
        if array.dtype.kind not in _SORTS:
            raise TypeError(f"{name}: not numbers, found {type(value).__name__}")
        # Python's own floats have the precision that they have in torch.
        return array if hasattr(value, "dtype") or array.dtype != np.float64 else array.astype(np.float32)

    def put(self, values: Any, dtype: str | None = None) -> Array:
        return np.array(values, dtype)

    def empty(self, dtype: Any, shape: tuple[int, ...]) -> Array:
        return np.zeros(shape, dtype)

    def zeros(self, dtype: str, shape: tuple[int, ...]) -> Array:
        return np.zeros(shape, dtype)

    def arange(self, count: int) -> Array:
        return np.arange(count, dtype=np.int64)

    def copied(self, array: Array) -> Array:
        return array.copy()

    def contiguous(self, array: Array) -> Array:
        return np.ascontiguousarray(array)

    def as_index(self, ids: Array) -> Array:
        return ids

    def entries(self, table: Array, index: Array) -> Array:
        return table[index]

    def sort(self, array: Array) -> str:
        return _SORTS[array.dtype.kind]

    def unbound(self, array: Array, axis: int) -> Sequence[Array]:
        return list(np.moveaxis(array, axis, 0))

    def as_bytes(self, array: Array) -> Array:
        return np.frombuffer(array.tobytes(), np.uint8)

    def to_numpy(self, array: Array) -> Array:
        return array

    def from_numpy(self, array: Array) -> Array:
        return array

    def from_bytes(self, memory: bytearray, dtype: Any, shape: tuple[int, ...]) -> Array:
        return np.frombuffer(memory, dtype).reshape(shape)

    def bytes_of(self, array: Array) -> Bytes:
        return array.tobytes()
