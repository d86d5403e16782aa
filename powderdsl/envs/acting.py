"""Policies: functions from observations to actions, on tensors. Random numbers are hashes, so no batch changes them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from powderdsl.system.random import action_keys, uniforms

__all__ = ["Policy", "action_keys", "random_policy", "uniforms"]

Policy = Callable[[Tensor, Tensor], Tensor]
"""From observations [B, …] and keys, int64 [B], to actions int64 [B, 5]. Keys are what random numbers depend on."""


def random_policy(nvec: tuple[int, ...]) -> Policy:
    """All actions equally likely."""

    def act(observed: Tensor, keys: Tensor) -> Tensor:
        counts = torch.tensor(nvec, device=keys.device)
        return (uniforms(keys, len(nvec)) * counts).long()

    return act
