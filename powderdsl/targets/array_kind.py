"""The libraries whose arrays programs take and return: `powderdsl.arrays` here, and torch in `tensor_kind`."""

from __future__ import annotations

from math import prod
from typing import Any, Protocol

from powderdsl.arrays import np

Array = Any
Bytes = Any
"""An object that has the buffer protocol."""


class ArrayKind(Protocol):
    """How programs make, read and compute with arrays in the memory of this process."""

    @property
    def xp(self) -> Any:
        """The library's functions."""
        ...

    def empty(self, dtype: Any, shape: tuple[int, ...]) -> tuple[Array, Bytes]:
        """A new array with any values, and its memory, to be written to."""
        ...

    def bytes_of(self, array: Array) -> Bytes:
        """The cells of a contiguous array in C order."""
        ...

    def contiguous(self, array: Array) -> Array:
        """The same values in C order."""
        ...


class PlainArrays:
    """Arrays of `powderdsl.arrays`: NumPy's, or our own where NumPy is missing."""

    xp: Any = np

    def empty(self, dtype: Any, shape: tuple[int, ...]) -> tuple[Array, Bytes]:
        memory = bytearray(prod(shape) * np.dtype(dtype).itemsize)
        return np.frombuffer(memory, dtype).reshape(shape), memory

    def bytes_of(self, array: Array) -> Bytes:
        return array.tobytes()

    def contiguous(self, array: Array) -> Array:
        return np.ascontiguousarray(array)
