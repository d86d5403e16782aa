"""The libraries whose arrays worlds and programs use: `powderdsl.arrays` here, and torch in `tensor_kind`.

What both call by the same name is called by it, as `kind.xp.where`; the rest are methods of `ArrayKind`.
"""

from __future__ import annotations

from math import prod
from typing import Any, Protocol

from powderdsl.arrays import np

Array = Any
Bytes = Any
"""An object that has the buffer protocol."""


class ArrayKind(Protocol):
    """Arrays of one library on one device."""

    @property
    def xp(self) -> Any:
        """The library's functions."""
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

    def copied(self, array: Array) -> Array:
        """The same values in memory of their own, in C order."""
        ...

    def contiguous(self, array: Array) -> Array:
        """The same values in C order."""
        ...

    def as_index(self, ids: Array) -> Array:
        """Ids in a dtype that can index a table."""
        ...

    def sort(self, array: Array) -> str:
        """``bool``, ``int``, ``float`` or ``complex``."""
        ...

    def to_numpy(self, array: Array) -> Array:
        """An array of `powderdsl.arrays`, which may share its memory."""
        ...

    def from_numpy(self, array: Array) -> Array:
        """An array of this library; it may share the memory of a given one that can be written to."""
        ...

    # Programs in the memory of this process

    def writable(self, dtype: Any, shape: tuple[int, ...]) -> tuple[Array, Bytes]:
        """A new array with any values, and its memory, to be written to."""
        ...

    def bytes_of(self, array: Array) -> Bytes:
        """The cells of a contiguous array in C order."""
        ...


_SORTS = {"b": "bool", "i": "int", "u": "int", "f": "float", "c": "complex"}


class PlainArrays:
    """Arrays of `powderdsl.arrays`: NumPy's, or our own where NumPy is missing."""

    xp: Any = np

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
        return np.empty(shape, dtype)

    def copied(self, array: Array) -> Array:
        return array.copy()

    def contiguous(self, array: Array) -> Array:
        return np.ascontiguousarray(array)

    def as_index(self, ids: Array) -> Array:
        return ids

    def sort(self, array: Array) -> str:
        return _SORTS[array.dtype.kind]

    def to_numpy(self, array: Array) -> Array:
        return array

    def from_numpy(self, array: Array) -> Array:
        return array

    def writable(self, dtype: Any, shape: tuple[int, ...]) -> tuple[Array, Bytes]:
        memory = bytearray(prod(shape) * np.dtype(dtype).itemsize)
        return np.frombuffer(memory, dtype).reshape(shape), memory

    def bytes_of(self, array: Array) -> Bytes:
        return array.tobytes()
