"""Types of numbers, and the types of results: those of NumPy 2 (NEP 50)."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

_CODES = {
    "bool": "?",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
_STORED = {code: array("B" if code == "?" else code).itemsize for code in _CODES.values()}


class dtype:
    """A type of numbers. Calling it makes a scalar: `float32(0.1)`."""

    name: str
    kind: str
    itemsize: int
    code: str
    """The code of `array.array` and of memory; flags are bytes."""
    low: int
    high: int

    def __new__(cls, given: Any = "float64") -> dtype:
        if isinstance(given, dtype):
            return given
        name = _PYTHON.get(given, given) if isinstance(given, (str, type)) else None
        found = _KNOWN.get(name) if isinstance(name, str) else None
        if found is None:
            raise TypeError(f"{given!r} is not a type of numbers that is known without NumPy")
        return found

    @property
    def type(self) -> dtype:
        """What makes scalars of this type."""
        return self

    @property
    def subdtype(self) -> None:
        return None

    @property
    def bits(self) -> int:
        return 8 * self.itemsize

    def __call__(self, value: Any = 0) -> Any:
        from powderdsl.arrays.making import scalar

        return scalar(value, self)

    def __eq__(self, other: object) -> bool:
        try:
            return other is self or dtype(other) is self
        except TypeError:
            return False

    __hash__ = object.__hash__

    def __str__(self) -> str:
        return self.name

    def __repr__(self) -> str:
        return f"dtype('{self.name}')"

    @property
    def str(self) -> Any:
        """The name in headers of files, such as ``<i4``."""
        letter = {"?": "b"}.get(self.code, self.kind)
        return f"{'|' if self.itemsize == 1 else '<'}{letter}{self.itemsize}"


def _made(name: str, code: str) -> dtype:
    found = object.__new__(dtype)
    found.name, found.code = name, "B" if code == "?" else code
    found.itemsize = _STORED[code]
    found.kind = "b" if code == "?" else "f" if code in "fd" else "u" if code.isupper() else "i"
    bits = 1 if code == "?" else found.bits
    found.low = -(1 << bits - 1) if found.kind == "i" else 0
    found.high = (1 << bits - (found.kind == "i")) - 1
    return found


_TYPES = {name: _made(name, code) for name, code in _CODES.items()}
_PYTHON: dict[Any, str] = {bool: "bool", int: "int64", float: "float64"}
_KNOWN: dict[str, dtype] = {
    **_TYPES,
    **{one.str: one for one in _TYPES.values()},
    **{one.str[1:]: one for one in _TYPES.values()},
    "?": _TYPES["bool"],
    "float": _TYPES["float64"],
    "int": _TYPES["int64"],
}

bool_ = _TYPES["bool"]
int8, int16, int32, int64 = (_TYPES[f"int{bits}"] for bits in (8, 16, 32, 64))
uint8, uint16, uint32, uint64 = (_TYPES[f"uint{bits}"] for bits in (8, 16, 32, 64))
float32, float64 = _TYPES["float32"], _TYPES["float64"]


@lru_cache(maxsize=256)
def promoted(a: dtype, b: dtype) -> dtype:
    """The smallest type that holds the values of both, as NumPy has it."""
    if a is b or b is bool_:
        return a
    if a is bool_:
        return b
    if "f" in (a.kind, b.kind):
        floats = [one for one in (a, b) if one.kind == "f"]
        narrow = all(one.kind == "f" or one.itemsize <= 2 for one in (a, b))
        return float32 if narrow and all(one is float32 for one in floats) else float64
    if a.kind == b.kind:
        return a if a.itemsize >= b.itemsize else b
    signed, unsigned = (a, b) if a.kind == "i" else (b, a)
    if signed.itemsize > unsigned.itemsize:
        return signed
    return _TYPES[f"int{2 * unsigned.bits}"] if unsigned.itemsize < 8 else float64


def result_type(types: Sequence[dtype], numbers: Sequence[bool | int | float] = ()) -> dtype:
    """The type of a result from arrays and scalars of `types` and from Python's numbers, which adapt to them."""
    found: dtype | None = None
    for one in types:
        found = one if found is None else promoted(found, one)
    for number in numbers:
        weak = bool_ if isinstance(number, bool) else int64 if isinstance(number, int) else float64
        order = "bif"
        if found is None or order.index(found.kind.replace("u", "i")) < order.index(weak.kind):
            found = weak
    assert found is not None
    return found
