"""The libraries whose arrays worlds and programs use: `powderdsl.arrays` here, and torch in `tensor_kind`.

Functions with the same name in both libraries are called through `kind.xp`; the rest are methods of a kind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from powderdsl.arrays import np

Array = Any

_SORTS = {"b": "bool", "i": "int", "u": "int", "f": "float", "c": "complex"}


@dataclass(frozen=True)
class ArrayKind:
    """Arrays of `powderdsl.arrays`: NumPy's, or our own where NumPy is missing. Equal kinds share their arrays.

    `xp` has the library's functions. `tensor_kind.Tensors` is the other kind.
    """

    device: Any = "cpu"
    xp: ClassVar[Any] = np

    @property
    def on_cpu(self) -> bool:
        """True if arrays are in this process's memory."""
        return True

    def convert(self, value: Any, name: str) -> Array:
        """A caller's values as an array, which may share their memory. Raises TypeError."""
        try:
            array = np.asarray(value)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise TypeError(f"{name}: {' '.join(str(error).split())}") from None
        if array.dtype.kind not in _SORTS:
            raise TypeError(f"{name}: not numbers, found {type(value).__name__}")
        # Python's own floats have the precision that they have in torch.
        return array if hasattr(value, "dtype") or array.dtype != np.float64 else array.astype(np.float32)

    def put(self, values: Any, dtype: str | None = None) -> Array:
        """An array of Python's numbers or flags."""
        return np.array(values, dtype)

    def zeros(self, dtype: str, shape: tuple[int, ...]) -> Array:
        return np.zeros(shape, dtype)

    def arange(self, count: int) -> Array:
        """The first integers from 0, int64."""
        return np.arange(count, dtype=np.int64)

    def copied(self, array: Array) -> Array:
        """The same values in new memory, in C order."""
        return array.copy()

    def contiguous(self, array: Array) -> Array:
        """The same values in C order."""
        return np.ascontiguousarray(array)

    def entries(self, table: Array, index: Array) -> Array:
        """The rows of a table for each of some bytes, in any shape."""
        return table[index]

    def sort(self, array: Array) -> str:
        """``bool``, ``int``, ``float`` or ``complex``."""
        return _SORTS[array.dtype.kind]

    def to_numpy(self, array: Array) -> Array:
        """An array of `powderdsl.arrays`, which may share its memory."""
        return array

    def from_numpy(self, array: Array) -> Array:
        """An array of this library, which may share the memory of a writable argument."""
        return array

    # Programs in the memory of this process

    def from_bytes(self, memory: bytearray, dtype: Any, shape: tuple[int, ...]) -> Array:
        """The array of cells in C order; it may share their memory."""
        return np.frombuffer(memory, dtype).reshape(shape)

    def holds_any(self, array: Array) -> bool:
        """True if a cell of a contiguous array is not zero."""
        return bool(array.any())

    def bytes_of(self, array: Array) -> Any:
        """The cells of a contiguous array in C order, as an object that has the buffer protocol."""
        return array.tobytes()
