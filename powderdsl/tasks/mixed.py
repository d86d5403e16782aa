"""Episodes under different rulesets, as one read-only batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from powderdsl.simulation.simulator import World
from powderdsl.tasks.episodes import Episodes, TaskProgram


class Playing(Protocol):
    """An environment."""

    program: TaskProgram
    episodes: Episodes | None


class MixedWorld:
    """Worlds of several simulators, in the order of their environments, for drawing."""

    def __init__(self, parts: Sequence[World], order: Tensor):
        self._parts, self._order = parts, order

    @property
    def ids(self) -> Tensor:
        """The elements, uint8 [B, H, W]."""
        return torch.cat([part.ids for part in self._parts])[self._order]

    def rgb(self) -> Tensor:
        """Pictures, uint8 [B, H, W, 3], each in the colors of its rules."""
        return torch.cat([part.rgb() for part in self._parts])[self._order]


class MixedEpisodes:
    """The current episodes of environments in one order, read-only.

    Args:
        envs: environments.
        order: the place of each episode among those of all environments, int64 [B].
    """

    def __init__(self, envs: Sequence[Playing], order: Tensor):
        self._envs, self.order = envs, order

    def __len__(self) -> int:
        return len(self.order)

    @property
    def seed(self) -> Tensor:
        """The numbers of their start worlds, int64 [B]."""
        return self.joined(lambda program, episodes: episodes.seed)

    @property
    def acted(self) -> Tensor:
        """The numbers of actions so far, int64 [B]."""
        return self.joined(lambda program, episodes: episodes.acted)

    @property
    def world(self) -> MixedWorld:
        """The worlds."""
        return MixedWorld([env.episodes.world for env in self._envs if env.episodes], self.order)

    def joined(self, read: Callable[[TaskProgram, Episodes], Tensor]) -> Tensor:
        """Apply a function to the episodes of each program, and join the results: [B, …]."""
        parts = [read(env.program, env.episodes) for env in self._envs if env.episodes]
        return torch.cat(parts)[self.order]
