"""Shapes, and the cells of a grid that they cover. Rows come first and count downwards; all results are exact.

In each column, a shape covers one run of rows, so its formula returns the first row and the row after the last. The
formulas use only functions with the same names in NumPy and torch: for one shape, or a shape for each world of a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import isqrt
from typing import Any

from powderdsl.arrays import NDArray, np
from powderdsl.diagnostics import Span

MAX_CELLS = 1 << 24
"""Maximum number of cells of a world that is read or drawn: 4096×4096."""

MAX_COORDINATE = 1 << 24
"""Coordinates, widths and radii are within ±MAX_COORDINATE, so that every product below fits in int64."""

FAR = 1 << 40
"""A number beyond every row."""

MOST = 1 << 62
"""An upper bound of all numbers below."""

Size = tuple[int, int]
"""(rows, columns)."""

Rows = tuple[Any, Any]
"""The first row in each column, and the row after the last. A run is empty if the first is not smaller."""


@dataclass(frozen=True)
class Shape:
    """A set of cells. `numbers` are in the order of `scene.statements.NUMBERS`; None is an open end of a range.

    Kinds: ``line``, ``disk``, ``square``, ``box``, ``ramp``, ``arch``, ``container`` and ``wave``, defined by the functions
    of these names below; ``frame``, the outermost cells of the grid; ``fill``, all cells.
    """

    kind: str
    numbers: tuple[int | None, ...] = ()


@dataclass(frozen=True)
class Paint:
    """One drawing statement: `element`, a plain or qualified name, fills the cells of `shape`."""

    element: str
    shape: Shape
    span: Span | None = field(default=None, compare=False, repr=False)
    element_span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class Setting:
    """A statement that sets the field `name` in the cells of `shape` to a value, a word for `model.examples.read_word`."""

    name: str
    value: str
    shape: Shape
    span: Span = field(compare=False, repr=False)
    name_span: Span = field(compare=False, repr=False)
    value_span: Span = field(compare=False, repr=False)


def mask(shape: Shape, size: Size) -> NDArray[np.bool_]:
    """The cells of a shape in a grid of `size`, bool [H, W], without cells outside the grid."""
    if shape.kind == "frame":
        cells = np.ones(size, dtype=np.bool_)
        cells[1:-1, 1:-1] = False
        return cells
    runs = covered_rows(np, shape.kind, shape.numbers, np.arange(size[1]), size)
    first, last = (np.clip(end, 0, size[0]) for end in runs)
    row = np.arange(size[0])[:, None]
    return (row >= first) & (row < last)


def covered_rows(xp: Any, kind: str, numbers: Sequence[Any], column: Any, size: Size) -> Rows:
    """The rows that a shape covers in each column, two values that broadcast to int64 [..., W]. Frames are not supported.

    Args:
        xp: numpy or torch.
        numbers: integers, or int64 tensors [..., 1].
        column: int64 [W], of the same library.
    """
    # An open end of rows or columns is the edge of the grid.
    ends = (0, size[0], 0, size[1])
    n = [numbers[0] * 0 + ends[i] if number is None else number for i, number in enumerate(numbers)]
    return _SHAPES[kind](xp, column, n, size)


def _line(xp: Any, column: Any, n: Sequence[Any], size: Size) -> Rows:
    """A thick line between two points, both included.

    At every integer step along its longer axis (the columns, if both are equally long), it covers the cells whose
    distance from the exact line, along the shorter axis, is below ``1 + width·√(1 + slope²)/4``. A line along an axis
    is thus three cells thick at widths 1 to 4, five at widths 5 to 8.

    The cross product of a cell with the direction is the distance times the longer length, so a cell is covered where
    4·(|cross| − length) < √(width²·(down² + right²)): integers on the left, so the root may be rounded down.
    """
    top, left, bottom, end, width = n
    down, right = bottom - top, end - left
    point = (down == 0) & (right == 0)  # a level line one step long
    longer = right + point
    length = xp.maximum(abs(down), abs(longer))
    bound = length + root(xp, width * width * (down * down + longer * longer) - 1) // 4
    # Swapping the end points changes nothing, so the slope may be computed to the right.
    across = (column - left) * down * xp.where(right < 0, -1, 1)
    divisor = xp.clip(abs(longer), 1, MOST)
    upright, hit = longer == 0, abs(across) <= bound
    first = xp.where(upright, xp.where(hit, -FAR, FAR), top - (bound - across) // divisor)
    last = xp.where(upright, xp.where(hit, FAR, -FAR), top + (across + bound) // divisor)
    steep, level = abs(down) > abs(right), abs(down) <= abs(right)
    first = xp.where(steep, xp.maximum(first, xp.minimum(top, bottom)), first)
    last = xp.where(steep, xp.minimum(last, xp.maximum(top, bottom)), last)
    beside = level & ((column < xp.minimum(left, end)) | (column > xp.maximum(left, end)))
    return xp.where(beside, FAR, first), last + 1


def _disk(xp: Any, column: Any, n: Sequence[Any], size: Size) -> Rows:
    """The cells closer to the center than the radius: a disk of radius 1 is one cell."""
    row, center, radius = n
    aside = column - center
    left = radius * radius - 1 - aside * aside
    reach = root(xp, xp.clip(left, 0, MOST))
    return xp.where(left < 0, FAR, row - reach), row + reach + 1


def _square(xp: Any, column: Any, n: Sequence[Any], size: Size) -> Rows:
    """A square of side 2·half: rows and columns from center − half to center + half − 1."""
    row, center, half = n
    return _box(xp, column, (row - half, row + half, center - half, center + half), size)


def _box(xp: Any, column: Any, n: Sequence[Any], size: Size) -> Rows:
    """Rows a ≤ r < b of columns c ≤ k < d."""
    top, bottom, left, end = n[:4]
    return xp.where((column < left) | (column >= end), FAR, top), bottom


def _arch(xp: Any, column: Any, n: Sequence[Any], size: Size) -> Rows:
    """The cells of a box that are fewer than `width` from its upper edge or its sides: open below."""
    top, bottom, left, end, width = n
    leg = (column < left + width) | (column >= end - width)
    first, _ = _box(xp, column, n, size)
    return first, xp.where(leg, bottom, xp.minimum(top + width, bottom))


def _container(xp: Any, column: Any, n: Sequence[Any], size: Size) -> Rows:
    """The cells of a box that are fewer than `width` from its lower edge or its sides: open above."""
    _, bottom, left, end, width = n
    leg = (column < left + width) | (column >= end - width)
    first, _ = _box(xp, column, n, size)
    return xp.where(leg, first, xp.maximum(first, bottom - width)), bottom


def _ramp(xp: Any, column: Any, n: Sequence[Any], size: Size) -> Rows:
    """The cells on or below the line between two points, down to the lower point's row. Points in one column make a bar."""
    top, left, bottom, end = n
    wide = abs(end - left)
    climb = (column - left) * xp.where(end > left, 1, -1) * (bottom - top)
    first = xp.where(wide == 0, xp.minimum(top, bottom), top - (-climb) // xp.clip(wide, 1, MOST))
    beside = (column < xp.minimum(left, end)) | (column > xp.maximum(left, end))
    return xp.where(beside, FAR, first), xp.maximum(top, bottom) + 1


def _wave(xp: Any, column: Any, n: Sequence[Any], size: Size) -> Rows:
    """The cells on or below a zigzag: at column c, it is in row ``row + height·u // length``, where t is c + phase
    modulo `length` and u is the smaller of 2·t and 2·(length − t)."""
    row, height, length, phase = n
    turn = (column + phase) % length
    return row + height * xp.minimum(2 * turn, 2 * (length - turn)) // length, row * 0 + size[0]


def _fill(xp: Any, column: Any, n: Sequence[Any], size: Size) -> Rows:
    return column * 0, column * 0 + size[0]


_SHAPES: dict[str, Callable[[Any, Any, Sequence[Any], Size], Rows]] = {
    "line": _line,
    "disk": _disk,
    "square": _square,
    "box": _box,
    "ramp": _ramp,
    "arch": _arch,
    "container": _container,
    "wave": _wave,
    "fill": _fill,
}


def root(xp: Any, x: Any) -> Any:
    """The square root of nonnegative integers, rounded down: of an int, or of arrays of numbers up to 2⁵²."""
    if isinstance(x, int):
        return isqrt(x)
    # The rounded float root may be off by one in either direction.
    result = xp.asarray(xp.sqrt(xp.asarray(x, dtype=xp.float64)), dtype=xp.int64)
    result = result - (result * result > x) * 1
    return result + ((result + 1) * (result + 1) <= x) * 1
