"""A fully convolutional policy for Stable-Baselines3: one score for each bin of the agent and each thing it may do there."""

from __future__ import annotations

import math
from typing import Any, Self

import numpy as np
import torch
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn
from torch.distributions import Categorical

from powderdsl.envs.features import patches_of
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.tasks.task import BLOW

DILATIONS = (1, 2, 4)
"""Of the residual blocks. With the first convolution, an output sees 17 bins in each direction, and the mean of all."""


def deeds_of(env: TensorEnv) -> tuple[tuple[int, int, int], ...]:
    """What an agent may do at a bin: (choice, vx, vy). Only blowing has directions."""
    found = []
    for choice, meaning in enumerate(env.task.agent.choices):
        if meaning == BLOW:
            found += [(choice, vx, vy) for vy in range(3) for vx in range(3)]
        else:
            found.append((choice, 1, 1))
    return tuple(found)


def fcn_policy(env: TensorEnv, channels: int = 32, frames: int = 1) -> dict[str, Any]:
    """`policy_kwargs` of `BinPolicy` for the observations and actions of an environment.

    Args:
        channels: of each convolution. frames: how many observations are stacked.

    Raises:
        ValueError: for observations that are pictures.
    """
    bins = env.task.agent.bins
    sides = tuple(min(count, side) for count, side in zip(bins, env.task.size, strict=True))
    if sides != bins:
        raise ValueError(f"the agent has {bins} bins in worlds of {env.task.size} cells")
    return {"see": patches_of(env, sides, frames), "channels": channels, "deeds": deeds_of(env)}


class Trunk(nn.Module):
    """From patches [B, C, rows, columns], with their places among the channels, to features [B, F, rows, columns]."""

    def __init__(self, channels: int, width: int):
        super().__init__()
        self.first = nn.Conv2d(channels, width, 3, padding=1)
        self.blocks = nn.ModuleList(nn.Conv2d(width, width, 3, padding=d, dilation=d) for d in DILATIONS)
        self.means = nn.ModuleList(nn.Linear(width, width) for _ in DILATIONS)

    def forward(self, patches: Tensor) -> Tensor:
        found = self.first(patches).relu()
        for block, mean in zip(self.blocks, self.means, strict=True):
            found = found + (block(found) + mean(found.mean((2, 3)))[:, :, None, None]).relu()
        return found


class BinDistribution(Distribution):
    """One choice among all deeds at all bins. Actions are (x, y, choice, vx, vy), int64 [B, 5].

    Args:
        actions: int64 [n, 5], the action of each score. numbers: int64 [columns, rows, choices, 3, 3], the score of each
            action.
    """

    distribution: Categorical

    def __init__(self, actions: Tensor, numbers: Tensor):
        super().__init__()
        self.actions, self.numbers = actions, numbers

    def proba_distribution_net(self, *args: Any, **kwargs: Any) -> nn.Module:
        raise NotImplementedError("BinPolicy has its own layers")

    def proba_distribution(self, scores: Tensor) -> Self:
        self.distribution = Categorical(logits=scores)
        return self

    def number(self, actions: Tensor) -> Tensor:
        """The scores' places of actions, int64 [B]."""
        return self.numbers.to(actions.device)[tuple(actions.long().T)]

    def action(self, numbers: Tensor) -> Tensor:
        """The actions of scores' places, int64 [B, 5]."""
        return self.actions.to(numbers.device)[numbers]

    def log_prob(self, actions: Tensor) -> Tensor:
        found: Tensor = self.distribution.log_prob(self.number(actions))
        return found

    def entropy(self) -> Tensor:
        found: Tensor = self.distribution.entropy()
        return found

    def sample(self) -> Tensor:
        return self.action(self.distribution.sample())

    def mode(self) -> Tensor:
        return self.action(self.distribution.probs.argmax(1))

    def actions_from_params(self, scores: Tensor, deterministic: bool = False) -> Tensor:
        return self.proba_distribution(scores).get_actions(deterministic)

    def log_prob_from_params(self, scores: Tensor) -> tuple[Tensor, Tensor]:
        actions = self.actions_from_params(scores)
        return actions, self.log_prob(actions)


class BinPolicy(ActorCriticPolicy):
    """The policy: convolutions that keep the bins, and a score for each bin and deed. The value has convolutions of its
    own: its errors, which are large at first, do not change what the scores see.

    Args:
        see: from observations to patches, one for each bin. channels: of each convolution. deeds: see `deeds_of`.
    """

    def __init__(
        self,
        observation_space: Any,
        action_space: Any,
        lr_schedule: Schedule,
        *,
        see: Any,
        channels: int,
        deeds: tuple[tuple[int, int, int], ...],
        use_sde: bool = False,
    ):
        self._parts = see, channels, deeds
        self._nvec = action_space.nvec
        super().__init__(observation_space, action_space, lr_schedule, use_sde=use_sde)

    def _build(self, lr_schedule: Schedule) -> None:
        see, width, deeds = self._parts
        columns, rows = (int(count) for count in self._nvec[:2])
        places = torch.meshgrid(*(torch.linspace(-1, 1, side) for side in (rows, columns)), indexing="ij")
        self.register_buffer("places", torch.stack(places))
        self.see, self.trunk = see, Trunk(see.channels + 2, width)
        self.scores = nn.Conv2d(width, len(deeds), 1)
        self.judge = nn.Sequential(
            nn.Conv2d(see.channels + 2, width, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, 2, 1),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d(4),
            nn.Flatten(),
            nn.Linear(16 * width, 4 * width),
            nn.ReLU(),
            nn.Linear(4 * width, 1),
        )
        for layer in (*self.trunk.modules(), *self.judge):
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.orthogonal_(layer.weight, math.sqrt(2))
        nn.init.orthogonal_(self.scores.weight, 0.01)  # all actions about equally likely
        self.bins = BinDistribution(*action_tables((rows, columns), deeds, self._nvec))
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr_schedule(1), eps=1e-5)

    def _seen(self, observed: Tensor) -> Tensor:
        """Patches and their places, [B, C + 2, rows, columns]."""
        with torch.no_grad():
            patches = self.see(observed)
            return torch.cat([patches, self.get_buffer("places").expand(len(patches), -1, -1, -1)], 1)

    def _distribution(self, seen: Tensor) -> BinDistribution:
        return self.bins.proba_distribution(self.scores(self.trunk(seen)).flatten(1))

    def _value(self, seen: Tensor) -> Tensor:
        value: Tensor = self.judge(seen)
        return value

    def forward(self, observed: Any, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        seen = self._seen(observed)
        distribution = self._distribution(seen)
        actions = distribution.get_actions(deterministic)
        return actions, self._value(seen), distribution.log_prob(actions)

    def evaluate_actions(self, observed: Any, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        seen = self._seen(observed)
        distribution = self._distribution(seen)
        return self._value(seen), distribution.log_prob(actions), distribution.entropy()

    def get_distribution(self, observed: Any) -> BinDistribution:
        return self._distribution(self._seen(observed))

    def predict_values(self, observed: Any) -> Tensor:
        return self._value(self._seen(observed))


def action_tables(
    bins: tuple[int, int], deeds: tuple[tuple[int, int, int], ...], nvec: np.ndarray[Any, Any]
) -> tuple[Tensor, Tensor]:
    """The tables of `BinDistribution`. Scores stand deed by deed, row by row."""
    rows, columns = bins
    deed, row, column = torch.meshgrid(*map(torch.arange, (len(deeds), rows, columns)), indexing="ij")
    actions = torch.cat(
        [torch.stack([column.flatten(), row.flatten()], 1), torch.tensor(deeds)[deed.flatten()]], 1
    )
    numbers = torch.zeros(tuple(int(count) for count in nvec), dtype=torch.int64)
    for choice in range(numbers.shape[2]):  # directions of what does not blow: all mean the same
        first = next(number for number, one in enumerate(deeds) if one[0] == choice)
        numbers[:, :, choice] = (first * rows * columns + torch.arange(rows) * columns)[None, :, None, None]
        numbers[:, :, choice] += torch.arange(columns)[:, None, None, None]
    numbers[tuple(actions.T)] = torch.arange(len(actions))
    return actions, numbers
