"""Counter-based random numbers: hashes of a draw's inputs, without state. Needs torch only for tensors.

The reference (`model.reference`) has its own, which these are compared with.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

MASK = 0xFFFFFFFF
START_0, START_1 = 0x243F6A88, 0x85A308D3


def name_number(name: str) -> int:
    """The hash of a name, FNV-1a with 32 bits."""
    number = 0x811C9DC5
    for byte in name.encode():
        number = (number ^ byte) * 0x01000193 & MASK
    return number


def mix(x: Any) -> Any:
    """A 32-bit finalizer. int64 below 2³² in and out."""
    x = x ^ (x >> 16)
    x = (x * 0x7FEB352D) & MASK
    x = x ^ (x >> 15)
    x = (x * 0x846CA68B) & MASK
    return x ^ (x >> 16)


def base_keys(seed: Any, index: Any, xp: Any = None) -> Any:
    """The part of the keys that stays the same for a whole run: int64 [2, B]. `xp`: the arrays' library, if not torch."""
    if xp is None:
        import torch as xp

    keys = xp.stack([seed * 0 + START_0, seed * 0 + START_1])
    for part in (seed & MASK, (seed >> 32) & MASK, index & MASK):
        keys = mix((keys + part) & MASK)
    return keys


def uniforms(keys: Tensor, count: int) -> Tensor:
    """Numbers in [0, 1) by key: float64 [B, count]."""
    import torch

    numbers = torch.arange(count, device=keys.device) * 0x9E3779B1 & MASK
    low, high = mix(keys & MASK), (keys >> 32) & MASK
    drawn = mix((mix(low ^ high)[:, None] + numbers) & MASK)
    return drawn.double() / float(1 << 32)


def action_keys(seed: int, episodes: Tensor, step: int | Tensor) -> Tensor:
    """The keys of one action in each of some episodes, by their numbers: int64 [B]. `step` may be one for each."""
    import torch

    low = mix((mix(torch.full_like(episodes, seed) & MASK) + episodes) & MASK)
    return mix((low + step) & MASK) << 31 | mix(low ^ mix(torch.zeros_like(low) + step)) >> 1
