"""Flags of cells packed into words: 64 columns per word, int64 [..., H, ⌈W/64⌉]. Bits beyond the width are zero."""

from __future__ import annotations

import torch
from torch import Tensor

WORD = 64


def word_count(width: int) -> int:
    return -(-width // WORD)


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
