"""The cells of whole batches as bits: row r of a column is bit r % 64 of word r // 64, so 64 are painted at a time."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from powderdsl.worlds.raster import Size, covered_rows


def shape_words(kind: str, numbers: Sequence[Tensor | None], size: Size) -> Tensor:
    """The cells of shapes, not frames, as bits: int64 [..., W, ⌈H/64⌉].

    `numbers` are int64 [...], in the order of `scene.statements.NUMBERS`; None is an open end.
    """
    given = [None if one is None else one[..., None] for one in numbers]
    device = next((one.device for one in given if one is not None), None)
    rows = covered_rows(torch, kind, given, torch.arange(size[1], device=device), size)
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
