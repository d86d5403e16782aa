"""The cells of whole batches as bits: row r of a column is bit r % 64 of word r // 64, so 64 are painted at a time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from powderdsl.targets.array_kind import Array, ArrayKind
from powderdsl.worlds.raster import Size, covered_rows


def shape_words(kind: ArrayKind, shape: str, numbers: Sequence[Array | None], size: Size) -> Array:
    """The cells of shapes, not frames, as bits: int64 [..., W, ⌈H/64⌉].

    `numbers` are int64 [...], in the order of `scene.statements.NUMBERS`; None is an open end.
    """
    xp = kind.xp
    given = [None if one is None else one[..., None] for one in numbers]
    rows = covered_rows(xp, shape, given, kind.arange(size[1]), size)
    first, last = (xp.clip(one, 0, size[0]) for one in rows)
    below = [_bits_below(xp, last - base) & ~_bits_below(xp, first - base) for base in range(0, size[0], 64)]
    return xp.stack(below, -1)


def _bits_below(xp: Any, n: Array) -> Array:
    """Words whose bits below bit n are set; all of them from 64 on."""
    return xp.where(n >= 64, -1, (1 << xp.clip(n, 0, 63)) - 1)


def pack(kind: ArrayKind, cells: Array) -> Array:
    """Cells, bool [..., H, W], as bits: int64 [..., W, ⌈H/64⌉]."""
    *batch, height, width = cells.shape
    number, xp = -(-height // 64), kind.xp
    missing = kind.zeros("uint8", (*batch, 64 * number - height, width))
    padded = xp.concatenate([xp.asarray(cells, dtype=xp.uint8), missing], axis=-2)
    bits = xp.asarray(padded.reshape(*batch, number, 64, width), dtype=xp.int64)
    return kind.contiguous(xp.swapaxes((bits << kind.arange(64)[:, None]).sum(-2), -1, -2))


def unpack(kind: ArrayKind, planes: Sequence[Array] | Array, height: int) -> Array:
    """Numbers whose bits are planes, int64 [..., W, ⌈H/64⌉] each, lowest first: uint8 [..., H, W]."""
    table = _eight_rows(kind)
    found: Array | None = None
    for place, words in enumerate(planes):
        # A byte of a word is eight rows. In the table it is eight bytes, so that eight numbers are put together at once.
        eight = kind.entries(table, kind.as_bytes(words)) << place
        found = eight if found is None else found | eight
    assert found is not None
    *batch, width, number = planes[0].shape
    columns = kind.as_bytes(found).reshape(*batch, width, 64 * number)
    return kind.contiguous(kind.xp.swapaxes(columns[..., :height], -1, -2))


@cache
def _eight_rows(kind: ArrayKind) -> Array:
    """The bits of each byte as eight bytes, which are one word: int64 [256]."""
    return kind.put([sum((byte >> row & 1) << 8 * row for row in range(8)) for byte in range(256)], "int64")
