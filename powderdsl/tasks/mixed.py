"""Episodes under different rulesets, as one read-only batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from powderdsl.simulation.simulator import World
from powderdsl.tasks.episodes import Episodes, TaskProgram

Array = np.ndarray[Any, Any]


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
        groups: environments, and the numbers of their episodes, int64 [n]; −1: not one of them.
    """

    def __init__(self, groups: Sequence[tuple[Playing, Array]]):
        self._envs = [env for env, _ in groups]
        numbers = np.concatenate([rows for _, rows in groups])
        self.order = torch.from_numpy(np.argsort(numbers, kind="stable")[np.count_nonzero(numbers < 0) :])
        """The place of each episode in the groups, one after another: int64 [B]."""
        self.seed = self.joined(lambda program, episodes: episodes.seed)
        """The numbers of their start worlds, int64 [B]."""

    def __len__(self) -> int:
        return len(self.order)

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
