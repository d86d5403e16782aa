"""Shapes of a whole batch at once: in each column a shape covers one run of rows, which integers give.

`worlds.raster` says what shapes cover; these are the same cells.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from powderdsl.worlds.raster import Size

Rows = tuple[Tensor, Tensor]
"""In each column the first row, and the one after the last: int64 [..., W]. Without rows the first is not smaller."""

FAR = 1 << 40
"""Beyond every row."""


def covered_rows(kind: str, numbers: Sequence[Tensor | None], size: Size) -> Rows:
    """The rows that a shape covers in each column.

    `numbers` are int64 [...], in the order of `statements.NUMBERS`; None is an open end. Frames have no such rows.
    """
    given = next((one for one in numbers if one is not None), None)
    device = given.device if given is not None else None
    column = torch.arange(size[1], device=device)
    n = [one[..., None] if one is not None else None for one in numbers]
    return _SHAPES[kind](column, n, size)  # type: ignore[operator]


def _line(column: Tensor, n: list[Tensor], size: Size) -> Rows:
    """|cross product| ≤ bound/4 is a run of rows in every column; see `raster._line`."""
    top, left, bottom, end, width = n
    down, right = bottom - top, end - left
    steep = down.abs() > right.abs()
    lowest, highest = torch.minimum(left, end), torch.maximum(left, end)
    right = torch.where((down == 0) & (right == 0), torch.ones_like(right), right)
    length = torch.maximum(down.abs(), right.abs())
    bound = length + root(width * width * (down * down + right * right) - 1) // 4
    # Turning the line round changes nothing, so the slope may be taken to the right.
    across = (column - left) * down * torch.where(right < 0, -1, 1)
    right = right.abs()
    level = right == 0
    divisor = right.clamp(min=1)
    first = top - _floor(bound - across, divisor)
    last = top + _floor(across + bound, divisor)
    hit = across.abs() <= bound
    first = torch.where(level, torch.where(hit, -FAR, FAR), first)
    last = torch.where(level, torch.where(hit, FAR, -FAR), last)
    first = torch.where(steep, torch.maximum(first, torch.minimum(top, bottom)), first)
    last = torch.where(steep, torch.minimum(last, torch.maximum(top, bottom)), last)
    beside = ~steep & ((column < lowest) | (column > highest))
    return torch.where(beside, FAR, first), last + 1


def _disk(column: Tensor, n: list[Tensor], size: Size) -> Rows:
    row, center, radius = n
    left = radius * radius - 1 - (column - center) ** 2
    reach = root(left.clamp(min=0))
    return torch.where(left < 0, FAR, row - reach), row + reach + 1


def _square(column: Tensor, n: list[Tensor], size: Size) -> Rows:
    row, center, half = n
    beside = (column < center - half) | (column >= center + half)
    return torch.where(beside, FAR, row - half), row + half


def _box(column: Tensor, n: list[Tensor | None], size: Size) -> Rows:
    top, bottom, left, end = _edges(n, size)
    beside = (column < left) | (column >= end)
    return torch.where(beside, FAR, top), bottom + torch.zeros_like(column)


def _arch(column: Tensor, n: list[Tensor | None], size: Size) -> Rows:
    top, bottom, left, end = _edges(n, size)
    assert n[4] is not None
    leg = (column < left + n[4]) | (column >= end - n[4])
    first, last = _box(column, n, size)
    return first, torch.where(leg, last, torch.minimum(top + n[4], bottom))


def _container(column: Tensor, n: list[Tensor | None], size: Size) -> Rows:
    _, bottom, left, end = _edges(n, size)
    assert n[4] is not None
    leg = (column < left + n[4]) | (column >= end - n[4])
    first, last = _box(column, n, size)
    return torch.where(leg, first, torch.maximum(first, bottom - n[4])), last


def _edges(n: list[Tensor | None], size: Size) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The four edges of a box; open ends reach to the end of the grid."""
    top, bottom, left, end = n[:4]
    assert top is not None
    assert left is not None
    rows = torch.full_like(top, size[0]) if bottom is None else bottom
    return top, rows, left, torch.full_like(left, size[1]) if end is None else end


def _ramp(column: Tensor, n: list[Tensor], size: Size) -> Rows:
    top, left, bottom, right = n
    wide = (right - left).abs()
    climb = (column - left) * torch.where(right > left, 1, -1) * (bottom - top)
    first = top - _floor(-climb, wide.clamp(min=1))
    first = torch.where(wide == 0, torch.minimum(top, bottom), first)
    beside = (column < torch.minimum(left, right)) | (column > torch.maximum(left, right))
    return torch.where(beside, FAR, first), torch.maximum(top, bottom) + 1 + torch.zeros_like(column)


def _wave(column: Tensor, n: list[Tensor], size: Size) -> Rows:
    row, height, length, phase = n
    turn = torch.remainder(column + phase, length)
    first = row + _floor(height * torch.minimum(2 * turn, 2 * (length - turn)), length)
    return first, torch.full_like(first, size[0])


def root(x: Tensor) -> Tensor:
    """The whole part of the square root of integers from 0 to 2⁵²."""
    found = x.double().sqrt().long()
    found = found - (found * found > x).long()
    return found + ((found + 1) ** 2 <= x).long()


def _floor(a: Tensor, b: Tensor) -> Tensor:
    return torch.div(a, b, rounding_mode="floor")


_SHAPES = {
    "line": _line,
    "disk": _disk,
    "square": _square,
    "box": _box,
    "ramp": _ramp,
    "arch": _arch,
    "container": _container,
    "wave": _wave,
}


# A column's cells as bits: row r is bit r % 64 of word r // 64. What is painted is then 64 cells at a time.


def words_of_rows(rows: Rows, size: Size) -> Tensor:
    """Runs of rows [..., W] as bits: int64 [..., W, ⌈H/64⌉]."""
    first, last = (one.clamp(0, size[0]) for one in rows)
    below = [_bits_below(last - base) & ~_bits_below(first - base) for base in range(0, size[0], 64)]
    return torch.stack(below, -1)


def _bits_below(n: Tensor) -> Tensor:
    """Words whose bits below bit n are set; all of them from 64 on."""
    return torch.where(n >= 64, -1, (1 << n.clamp(0, 63)) - 1)


def pack(cells: Tensor) -> Tensor:
    """Cells, bool [..., H, W], as bits: int64 [..., W, ⌈H/64⌉]."""
    *batch, height, width = cells.shape
    number = -(-height // 64)
    padded = torch.nn.functional.pad(cells.to(torch.uint8), (0, 0, 0, 64 * number - height))
    bits = padded.view(*batch, number, 64, width).long()
    shift = torch.arange(64, device=cells.device)[:, None]
    return (bits << shift).sum(-2).transpose(-1, -2).contiguous()


def unpack(planes: Sequence[Tensor] | Tensor, height: int) -> Tensor:
    """Numbers whose bits are planes, int64 [..., W, ⌈H/64⌉] each, lowest first: uint8 [..., H, W]."""
    found: Tensor | None = None
    table = _EIGHT_ROWS.to(planes[0].device)
    for place, words in enumerate(planes):
        # A byte of a word is eight rows. In the table it is eight bytes, so that eight numbers are put together at once.
        eight = table.index_select(0, words.reshape(-1).view(torch.uint8).int()) << place
        found = eight if found is None else found | eight
    assert found is not None
    *batch, width, number = planes[0].shape
    columns = found.view(torch.uint8).view(*batch, width, 64 * number)
    return columns[..., :height].transpose(-1, -2).contiguous()


_EIGHT_ROWS = (torch.arange(256)[:, None] >> torch.arange(8) & 1).to(torch.uint8).view(torch.int64)[:, 0]
"""The bits of each byte as eight bytes, which are one word: int64 [256]."""
