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

    def __init__(self, parts: Sequence[World], rows: Sequence[Array]):
        self._parts, self._rows = parts, rows

    @property
    def ids(self) -> Tensor:
        """The elements, uint8 [B, H, W]."""
        return joined([part.ids for part in self._parts], self._rows)

    def rgb(self) -> Tensor:
        """Pictures, uint8 [B, H, W, 3], each in the colors of its rules."""
        return joined([part.rgb() for part in self._parts], self._rows)


class MixedEpisodes:
    """The current episodes of environments in one order, read-only.

    Args:
        groups: environments, and the numbers of their episodes, int64 [n].
    """

    def __init__(self, groups: Sequence[tuple[Playing, Array]]):
        self._envs = [env for env, _ in groups]
        self._rows = [rows for _, rows in groups]

    def __len__(self) -> int:
        return sum(map(len, self._rows))

    def __getattr__(self, name: str) -> Tensor:
        if name not in ("seed", "acted", "failed"):
            raise AttributeError(name)
        return self.joined(lambda program, episodes: getattr(episodes, name))

    @property
    def world(self) -> MixedWorld:
        """The worlds."""
        return MixedWorld([env.episodes.world for env in self._envs if env.episodes], self._rows)

    def joined(self, read: Callable[[TaskProgram, Episodes], Tensor]) -> Tensor:
        """Apply a function to the episodes of each program, and join the results: [B, …]."""
        return joined([read(env.program, env.episodes) for env in self._envs if env.episodes], self._rows)


def joined(parts: Sequence[Tensor], rows: Sequence[Array]) -> Tensor:
    """The rows of tensors, each at its number in `rows`: [B, …]."""
    return torch.cat([*parts])[torch.from_numpy(np.argsort(np.concatenate([*rows])))]
