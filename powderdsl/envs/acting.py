"""Policies: functions from observations to actions, on tensors. Random numbers are hashes, so no batch changes them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from powderdsl.system.random import MASK, mix

Policy = Callable[[Tensor, Tensor], Tensor]
"""From observations [B, …] and keys, int64 [B], to actions int64 [B, 5]. Keys are what random numbers depend on."""


def uniforms(keys: Tensor, count: int) -> Tensor:
    """Numbers in [0, 1) by key: float64 [B, count]."""
    numbers = torch.arange(count, device=keys.device) * 0x9E3779B1 & MASK
    low, high = mix(keys & MASK), (keys >> 32) & MASK
    drawn = mix((mix(low ^ high)[:, None] + numbers) & MASK)
    return drawn.double() / float(1 << 32)


def action_keys(seed: int, episodes: Tensor, step: int | Tensor) -> Tensor:
    """The keys of one action in each of some episodes, by their numbers: int64 [B]. `step` may be one for each."""
    low = mix((mix(torch.full_like(episodes, seed) & MASK) + episodes) & MASK)
    return mix((low + step) & MASK) << 31 | mix(low ^ mix(torch.zeros_like(low) + step)) >> 1


def random_policy(nvec: tuple[int, ...]) -> Policy:
    """All actions equally likely."""

    def act(observed: Tensor, keys: Tensor) -> Tensor:
        counts = torch.tensor(nvec, device=keys.device)
        return (uniforms(keys, len(nvec)) * counts).long()

    return act
