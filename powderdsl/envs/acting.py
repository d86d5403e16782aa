"""Policies: functions from observations to actions, on tensors. Random numbers are hashes, so no batch changes them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from powderdsl.system.random import action_keys, uniforms

__all__ = ["FrameStack", "Policy", "action_keys", "random_policy", "uniforms"]

Policy = Callable[[Tensor, Tensor], Tensor]
"""From observations [B, …] and keys, int64 [B], to actions int64 [B, 5]. Keys are what random numbers depend on."""


class FrameStack:
    """The last observations of episodes, stacked along their channels, oldest first: zeros before an episode began."""

    def __init__(self, frames: int):
        self.frames = frames
        self._kept: Tensor | None = None

    def push(self, observed: Tensor, fresh: Tensor | None = None) -> Tensor:
        """The stack [B, frames · C, …] after observations [B, C, …]; `fresh`, bool [B]: whose episode begins with them."""
        if self.frames == 1:
            return observed
        channels = observed.shape[1]
        if self._kept is None:
            self._kept = observed.new_zeros(len(observed), self.frames * channels, *observed.shape[2:])
        elif fresh is not None:
            self._kept[fresh] = 0
        self._kept = torch.cat([self._kept[:, channels:], observed], 1)
        return self._kept


def random_policy(nvec: tuple[int, ...]) -> Policy:
    """All actions equally likely."""

    def act(observed: Tensor, keys: Tensor) -> Tensor:
        counts = torch.tensor(nvec, device=keys.device)
        return (uniforms(keys, len(nvec)) * counts).long()

    return act
