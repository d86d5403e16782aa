"""Shapes, and which cells of a grid they cover. Rows come first and count downwards; everything is exact.

Shapes are data and name no element: `Paint` puts one on a world, a task can use the same shapes as regions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from powderdsl.diagnostics import Span

MAX_CELLS = 1 << 24
"""The largest world that is read or drawn: 4096×4096 cells, or as many in another shape."""

MAX_COORDINATE = 1 << 24
"""Coordinates, widths and radii lie within ±MAX_COORDINATE, so that int64 holds every product below."""

Size = tuple[int, int]
"""(rows, columns)."""

Point = tuple[int, int]
"""(row, column); it may lie outside the grid."""

Slice = tuple[int, int | None]
"""First row or column, and the one after the last; None reaches to the end of the grid."""


@dataclass(frozen=True)
class Line:
    """A thick line from `start` to `end`, both included.

    It covers, at every whole step along its longer axis (the columns, where both are equally long), the cells
    whose distance from the exact line, along the shorter one, is below ``1 + width·√(1 + slope²)/4``.
    A line along an axis is thus three cells thick at widths 1 to 4, five at widths 5 to 8.
    """

    start: Point
    end: Point
    width: int


@dataclass(frozen=True)
class Disk:
    """The cells nearer to `center` than `radius`: a disk of radius 1 is one cell."""

    center: Point
    radius: int


@dataclass(frozen=True)
class Box:
    """Rows a ≤ r < b of columns c ≤ k < d, clipped to the grid."""

    rows: Slice = (0, None)
    columns: Slice = (0, None)


@dataclass(frozen=True)
class Frame:
    """The outermost cells of the grid, whatever its size."""


@dataclass(frozen=True)
class Square:
    """Rows and columns from `half` before the center up to, and without, `half` behind it: a side of 2·half."""

    center: Point
    half: int


@dataclass(frozen=True)
class Ramp:
    """Between the columns of two points, both included: what lies on or below the straight line from one to the
    other, down to the lower one's row. Points in one column make a bar."""

    start: Point
    end: Point


@dataclass(frozen=True)
class Arch:
    """The cells of a box that are fewer than `width` from its upper edge or its sides: open below."""

    rows: Slice
    columns: Slice
    width: int


@dataclass(frozen=True)
class Container:
    """The cells of a box that are fewer than `width` from its lower edge or its sides: open above."""

    rows: Slice
    columns: Slice
    width: int


@dataclass(frozen=True)
class Wave:
    """What lies on or below a zigzag: at column c it is in row ``row + height·u // length``, where t is c + phase
    modulo `length` and u is the smaller of 2·t and 2·(length − t)."""

    row: int
    height: int
    length: int
    phase: int


Shape = Line | Disk | Square | Box | Ramp | Arch | Container | Wave | Frame


@dataclass(frozen=True)
class Paint:
    """One drawing statement: `element`, a plain or qualified name, fills the cells of `shape`."""

    element: str
    shape: Shape
    span: Span | None = field(default=None, compare=False, repr=False)
    element_span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class Setting:
    """A statement that gives the field `name` a value in the cells of `shape`: a word as `model.fields.words` reads it."""

    name: str
    value: str
    shape: Shape
    span: Span = field(compare=False, repr=False)
    name_span: Span = field(compare=False, repr=False)
    value_span: Span = field(compare=False, repr=False)


def mask(shape: Shape, size: Size) -> NDArray[np.bool_]:
    """The cells of a shape in a grid of `size`, bool [H, W]. What lies outside the grid is cut off."""
    cells = np.zeros(size, dtype=np.bool_)
    rows, columns = window(shape, size)
    cells[rows, columns] = _covered(shape, rows, columns, size)
    return cells


def paint(size: Size, fill: int, paints: Iterable[Paint], ids: Mapping[str, int]) -> NDArray[np.uint8]:
    """A world uint8 [H, W]: `fill` everywhere, then each statement over what stands already.

    `ids` gives the id of every element name that the statements use.
    """
    world = np.full(size, fill, dtype=np.uint8)
    for statement in paints:
        rows, columns = window(statement.shape, size)
        world[rows, columns][_covered(statement.shape, rows, columns, size)] = ids[statement.element]
    return world


def window(shape: Shape, size: Size) -> tuple[slice, slice]:
    """Rows and columns of the grid outside of which the shape covers nothing. May be empty."""
    height, width = size
    match shape:
        case Line(start, end, thickness):
            # 2 + width bounds 1 + width·√(1 + slope²)/4, as no slope is steeper than 1.
            reach = thickness + 2
            return (
                _clip(min(start[0], end[0]) - reach, max(start[0], end[0]) + reach + 1, height),
                _clip(min(start[1], end[1]) - reach, max(start[1], end[1]) + reach + 1, width),
            )
        case Disk((row, column), radius):
            return _clip(row - radius, row + radius + 1, height), _clip(
                column - radius, column + radius + 1, width
            )
        case Box(rows, columns):
            return _clip(rows[0], rows[1], height), _clip(columns[0], columns[1], width)
        case Square((row, column), half):
            return _clip(row - half, row + half, height), _clip(column - half, column + half, width)
        case Ramp(start, end):
            return (
                _clip(min(start[0], end[0]), max(start[0], end[0]) + 1, height),
                _clip(min(start[1], end[1]), max(start[1], end[1]) + 1, width),
            )
        case Arch(rows, columns) | Container(rows, columns):
            return _clip(rows[0], rows[1], height), _clip(columns[0], columns[1], width)
        case Wave(row):
            return _clip(row, None, height), slice(0, width)
        case Frame():
            return slice(0, height), slice(0, width)


def _clip(start: int, stop: int | None, length: int) -> slice:
    first = min(max(start, 0), length)
    return slice(first, length if stop is None else min(max(stop, first), length))


def _covered(shape: Shape, rows: slice, columns: slice, size: Size) -> NDArray[np.bool_]:
    """Which cells of a window the shape covers."""
    row = np.arange(rows.start, rows.stop, dtype=np.int64)[:, None]
    column = np.arange(columns.start, columns.stop, dtype=np.int64)[None, :]
    match shape:
        case Line():
            return _line(shape, row, column)
        case Disk(center, radius):
            return (row - center[0]) ** 2 + (column - center[1]) ** 2 < radius * radius
        case Box() | Square():
            return np.ones((row.size, column.size), dtype=np.bool_)
        case Ramp((top, left), (bottom, right)):
            if left == right:
                return np.ones((row.size, column.size), dtype=np.bool_)
            over = 1 if right > left else -1
            return (row - top) * abs(right - left) >= (column - left) * over * (bottom - top)
        case Arch(_, (left, right), thickness):
            end = size[1] if right is None else right
            roof = row < shape.rows[0] + thickness
            return roof | (column < left + thickness) | (column >= end - thickness)
        case Container((_, bottom_row), (left, right), thickness):
            end = size[1] if right is None else right
            floor = row >= (size[0] if bottom_row is None else bottom_row) - thickness
            return floor | (column < left + thickness) | (column >= end - thickness)
        case Wave(first, height, length, phase):
            turn = (column + phase) % length
            return row >= first + height * np.minimum(2 * turn, 2 * (length - turn)) // length
        case Frame():
            last_row, last_column = size[0] - 1, size[1] - 1
            return (row == 0) | (row == last_row) | (column == 0) | (column == last_column)


def _line(line: Line, row: NDArray[np.int64], column: NDArray[np.int64]) -> NDArray[np.bool_]:
    """The cells of a line. The cross product with its direction is the distance times the longer length.

    |cross|/length < 1 + width·√(1 + slope²)/4 is 4·(|cross| − length) < √(width²·(down² + right²)): whole
    numbers on the left, so the root may be rounded, and no cell depends on floating point.
    """
    (top, left), (bottom, end_column) = line.start, line.end
    down, right = bottom - top, end_column - left
    along_rows = abs(down) > abs(right)
    place, first, last = (row, top, bottom) if along_rows else (column, left, end_column)
    if down == right == 0:
        right = 1  # a single point: a level line one step long
    length = max(abs(down), abs(right))
    cross = (column - left) * down - (row - top) * right
    bound = 4 * length + isqrt(line.width**2 * (down**2 + right**2) - 1)
    return (place >= min(first, last)) & (place <= max(first, last)) & (4 * np.abs(cross) <= bound)
