"""Counter-based random numbers in torch: the bit planes of each draw are hashes of (seed, world, step, stream, word).

The same numbers as `model.reference.draw`, in int64 arithmetic kept below 2³². No generator, no state, no host sync.
"""

from __future__ import annotations

import torch
from torch import Tensor

from powderdsl.system.random import MASK, mix


def step_keys(base: Tensor, step: Tensor, idents: Tensor) -> Tensor:
    """Keys of one step for each stream: int64 [S, 2, B]. `step` is [B], `idents` [S]."""
    keys = mix((base + (step & MASK)) & MASK)
    return mix((keys[None] + idents[:, None, None]) & MASK)


def words(keys: Tensor, bits: int, height: int, width: int) -> Tensor:
    """Hashes of the first `bits` bit planes: int64 [bits, B, H, ⌈W/32⌉]; bit x % 32 of word x // 32 is column x.

    `keys` is [2, B]: one stream's part of `step_keys`.
    """
    across = -(-width // 32)
    number = torch.arange(height * across, dtype=torch.int64, device=keys.device).view(height, across) * 32
    plane = torch.arange(bits, dtype=torch.int64, device=keys.device)
    n = ((number + plane[:, None, None]) * 0x9E3779B1) & MASK
    h = (n[:, None] + keys[0][:, None, None]) & MASK
    h = h ^ (h >> 16)
    h = (h * 0x7FEB352D) & MASK
    h = h ^ (h >> 15)
    h = (((h + keys[1][:, None, None]) & MASK) * 0x846CA68B) & MASK
    return h ^ (h >> 16)


def draws(keys: Tensor, bits: int, height: int, width: int) -> Tensor:
    """The first `bits` bits of each cell's draw as an integer: int64 [B, H, W]."""
    planes = words(keys, bits, height, width)
    column = torch.arange(32, dtype=torch.int64, device=keys.device)
    result = torch.zeros((), dtype=torch.int64, device=keys.device)
    for plane in planes:
        result = (result << 1) | ((plane[..., None] >> column) & 1)
    batch, rows, across, _ = result.shape
    return result.view(batch, rows, across * 32)[..., :width]
