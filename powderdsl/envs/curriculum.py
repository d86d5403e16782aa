"""Curricula, which choose the worlds, and thereby the laws, in which an agent trains next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from powderdsl.system.random import action_keys, uniforms

REPLAY = 0x4C657665
"""The seed of the draws of `Prioritized`."""


class Curriculum(Protocol):
    """Chooses the worlds of episodes, and receives a score for each episode."""

    def choose(self, base: Tensor, episode: Tensor, drawn: Tensor) -> Tensor:
        """Return the worlds, int64 [n], of environments' episodes: `drawn` (chosen uniformly), or others.

        `base` and `episode`, int64 [n], are the seeds of the environments and the numbers of the episodes.
        """

    def learn(self, worlds: Tensor, scores: Tensor) -> None:
        """Record scores, float64 [n], of the worlds of episodes, int64 [n]. A higher score means more to learn."""

    def state(self) -> dict[str, Tensor]:
        """Return everything that later choices depend on."""

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a result of `state`. Raises KeyError for anything else."""


class Prioritized:
    """Prioritized level replay (Jiang, Grefenstette and Rocktäschel, ICML 2021).

    An episode replays a world with probability `replay`. The world is drawn by the rank of its score, with
    probabilities that fall as a power of the rank, and with weight `stale` by the time since it was last played.

    Args:
        worlds: number of worlds to remember, those with the highest scores.
        power: exponent of the rank, the inverse of the paper's temperature.
    """

    def __init__(self, worlds: int = 1024, replay: float = 0.5, stale: float = 0.1, power: float = 10.0):
        self.most, self.replay, self.stale, self.power = worlds, replay, stale, power
        self._worlds = torch.zeros(0, dtype=torch.int64)
        self._scores = torch.zeros(0, dtype=torch.float64)
        self._played = torch.zeros(0, dtype=torch.int64)
        self._time = torch.zeros((), dtype=torch.int64)

    def choose(self, base: Tensor, episode: Tensor, drawn: Tensor) -> Tensor:
        """Return the worlds of episodes: see `Curriculum`."""
        if not len(self._worlds):
            return drawn
        rank = self._scores.argsort(descending=True, stable=True).argsort() + 1
        by_rank, age = rank.double() ** -self.power, (self._time - self._played).double()
        chance = by_rank / by_rank.sum() * (1 - self.stale) + age / age.sum().clamp(min=1) * self.stale
        ends, draws = chance.cumsum(0), uniforms(action_keys(REPLAY, base, episode), 2)
        places = torch.searchsorted(ends, draws[:, 1] * ends[-1]).clamp(max=len(ends) - 1)
        return torch.where(draws[:, 0] < self.replay, self._worlds[places], drawn)

    def learn(self, worlds: Tensor, scores: Tensor) -> None:
        """Record scores: see `Curriculum`."""
        self._time = self._time + 1
        known = dict(
            zip(
                self._worlds.tolist(),
                zip(self._scores.tolist(), self._played.tolist(), strict=True),
                strict=True,
            )
        )
        for world, score in zip(worlds.tolist(), scores.tolist(), strict=True):
            known[world] = score, int(self._time)
        rows = sorted(known.items(), key=lambda row: -row[1][0])[: self.most]
        self._worlds = torch.tensor([world for world, _ in rows], dtype=torch.int64)
        self._scores = torch.tensor([score for _, (score, _) in rows], dtype=torch.float64)
        self._played = torch.tensor([played for _, (_, played) in rows], dtype=torch.int64)

    def state(self) -> dict[str, Tensor]:
        """Return the worlds, their scores and when each was last played."""
        return {name: getattr(self, f"_{name}") for name in ("worlds", "scores", "played", "time")}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a result of `state`."""
        self._worlds, self._scores, self._played, self._time = (
            state[name] for name in ("worlds", "scores", "played", "time")
        )
