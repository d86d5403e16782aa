"""Bit planes in torch: 64 columns a word, int64 [..., H, ⌈W/64⌉]. Bits beyond the width are always zero."""

from __future__ import annotations

import torch
from torch import Tensor

WORD = 64


def word_count(width: int) -> int:
    return -(-width // WORD)


def as_signed(bits: int) -> int:
    """A 64-bit pattern as the int64 that has it."""
    return bits - (1 << 64) if bits >> 63 else bits


def valid_words(width: int, device: torch.device) -> Tensor:
    """int64 [⌈W/64⌉]: ones where there are columns."""
    count = word_count(width)
    full = [-1] * (count - 1) + [as_signed((1 << (width - WORD * (count - 1))) - 1)]
    return torch.tensor(full, dtype=torch.int64, device=device)


def shift_right(x: Tensor, by: int) -> Tensor:
    """Logical shift: zeros come in from above."""
    return x if by == 0 else (x >> by) & ((1 << (WORD - by)) - 1)


def columns(x: Tensor, dx: int, width: int, valid: Tensor, wraps: bool) -> Tensor:
    """Each column's value at the column `dx` to the right."""
    count = x.shape[-1]
    if count == 1 and wraps:
        by = dx % width
        return x if by == 0 else (shift_right(x, by) | (x << (width - by))) & valid
    if count == 1:
        return (
            shift_right(x, dx)
            if 0 <= dx < WORD
            else (x << -dx) & valid
            if -WORD < dx < 0
            else torch.zeros_like(x)
        )
    rest = width - WORD * (count - 1)
    if dx > 0:
        after = _following(x, rest, wraps)
        filled = (
            torch.cat([x[..., :-1], x[..., -1:] | (x[..., :1] << rest)], -1) if wraps and rest < WORD else x
        )
        return (shift_right(filled, dx) | (after << (WORD - dx))) & valid
    before = _preceding(x, rest, wraps)
    return ((x << -dx) | shift_right(before, WORD + dx)) & valid


def _following(x: Tensor, rest: int, wraps: bool) -> Tensor:
    """The word right of each: the last is followed by the first, which starts in the middle of a word."""
    if not wraps:
        return torch.cat([x[..., 1:], torch.zeros_like(x[..., :1])], -1)
    if rest == WORD:
        return torch.roll(x, -1, -1)
    last = x[..., -1:] | (x[..., :1] << rest)
    beyond = shift_right(x[..., :1], WORD - rest) | (x[..., 1:2] << rest)
    return torch.cat([x[..., 1:-1], last, beyond], -1)


def _preceding(x: Tensor, rest: int, wraps: bool) -> Tensor:
    """The word left of each: before the first come the last 64 columns."""
    if not wraps:
        return torch.cat([torch.zeros_like(x[..., :1]), x[..., :-1]], -1)
    if rest == WORD:
        return torch.roll(x, 1, -1)
    first = (x[..., -1:] << (WORD - rest)) | shift_right(x[..., -2:-1], rest)
    return torch.cat([first, x[..., :-1]], -1)


def rows(x: Tensor, dy: int, wraps: bool, dim: int) -> Tensor:
    """Each row's value at the row `dy` below."""
    height = x.shape[dim]
    if wraps:
        return x if dy % height == 0 else torch.roll(x, -dy, dim)
    if abs(dy) >= height:
        return torch.zeros_like(x)
    kept = x.narrow(dim, dy, height - dy) if dy > 0 else x.narrow(dim, 0, height + dy)
    gap = torch.zeros_like(x.narrow(dim, 0, abs(dy)))
    return torch.cat([kept, gap] if dy > 0 else [gap, kept], dim)


_LITTLE = torch.tensor([1 << i for i in range(8)], dtype=torch.uint8)


def pack(flags: Tensor) -> Tensor:
    """bool [..., W] → int64 [..., ⌈W/64⌉]."""
    width = flags.shape[-1]
    missing = word_count(width) * WORD - width
    if missing:
        flags = torch.nn.functional.pad(flags.to(torch.uint8), (0, missing))
    octets = flags.to(torch.uint8).reshape(*flags.shape[:-1], -1, 8)
    packed = (octets * _LITTLE.to(flags.device)).sum(-1, dtype=torch.uint8)
    return packed.view(torch.int64)


def unpack(words: Tensor, width: int) -> Tensor:
    """int64 [..., ⌈W/64⌉] → bool [..., W]."""
    octets = words.contiguous().view(torch.uint8)
    bits = (octets[..., None] & _LITTLE.to(words.device)) != 0
    return bits.flatten(-2)[..., :width]
