"""A fully convolutional policy for Stable-Baselines3: one score for each bin of the agent and each thing it may do there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn
from torch.distributions import Categorical

from powderdsl.envs.actions import ActionForm, action_form
from powderdsl.envs.features import patches_of
from powderdsl.envs.tensor_env import TensorEnv

DILATIONS = (1, 2, 4)
"""Of the residual blocks. With the first convolution, an output sees 17 bins in each direction, and the mean of all."""


def fcn_policy(env: TensorEnv, channels: int = 32, frames: int = 1) -> dict[str, Any]:
    """`policy_kwargs` of `BinPolicy` for the observations and actions of an environment.

    Args:
        channels: of each convolution. frames: how many observations are stacked.

    Raises:
        ValueError: for observations that are pictures.
    """
    bins = env.task.agent.bins
    form = action_form("discrete", env.task.agent, torch.device("cpu"))
    return {"see": patches_of(env, bins, frames), "channels": channels, "bins": bins, "form": form}


class Trunk(nn.Module):
    """From patches [B, C, rows, columns], with their places among the channels, to features [B, F, rows, columns]."""

    def __init__(self, channels: int, width: int):
        super().__init__()
        self.first = nn.Conv2d(channels, width, 3, padding=1)
        self.blocks = nn.ModuleList(nn.Conv2d(width, width, 3, padding=d, dilation=d) for d in DILATIONS)
        self.means = nn.ModuleList(nn.Linear(width, width) for _ in DILATIONS)

    def forward(self, patches: Tensor) -> Tensor:
        features = self.first(patches).relu()
        for block, mean in zip(self.blocks, self.means, strict=True):
            features = features + (block(features) + mean(features.mean((2, 3)))[:, :, None, None]).relu()
        return features


@dataclass(frozen=True)
class BinDistribution:
    """One choice among the values of a ``discrete`` form of actions. Actions are (x, y, choice, vx, vy), int64 [B, 5]."""

    form: ActionForm
    distribution: Categorical

    def action(self, values: Tensor) -> Tensor:
        """The five numbers of values, int64 [B, 5]."""
        return self.form.decode(values).to(values.device)

    def log_prob(self, actions: Tensor) -> Tensor:
        log_prob: Tensor = self.distribution.log_prob(self.form.encode(actions.long()).to(actions.device))
        return log_prob

    def mode(self) -> Tensor:
        return self.action(self.distribution.probs.argmax(1))

    def get_actions(self, deterministic: bool = False) -> Tensor:
        return self.mode() if deterministic else self.action(self.distribution.sample())


class BinPolicy(ActorCriticPolicy):
    """The policy: convolutions that keep the bins, and a score for each bin and deed. The value has convolutions of its
    own: its errors, which are large at first, do not change what the scores see.

    Args:
        see: from observations to patches, one for each bin. channels: of each convolution. bins: rows and columns.
        form: the ``discrete`` form of actions, whose order is that of the scores: deed by deed, row by row.
    """

    def __init__(
        self,
        observation_space: Any,
        action_space: Any,
        lr_schedule: Schedule,
        *,
        see: Any,
        channels: int,
        bins: tuple[int, int],
        form: ActionForm,
        use_sde: bool = False,
        optimizer_class: Any = torch.optim.Adam,
    ):
        self._parts = see, channels, bins, form
        super().__init__(
            observation_space, action_space, lr_schedule, use_sde=use_sde, optimizer_class=optimizer_class
        )

    def _build(self, lr_schedule: Schedule) -> None:
        see, width, bins, form = self._parts
        places = torch.meshgrid(*(torch.linspace(-1, 1, side) for side in bins), indexing="ij")
        self.register_buffer("places", torch.stack(places))
        self.see, self.trunk = see, Trunk(see.channels + 2, width)
        deeds, idle = divmod(form.nvec[0], bins[0] * bins[1])
        self.scores = nn.Conv2d(width, deeds, 1)
        self.idle = nn.Linear(width, 1) if idle else None  # doing nothing has no place
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
        for last in (self.scores, self.idle):
            if last is not None:
                nn.init.orthogonal_(last.weight, 0.01)  # all actions about equally likely
        self.form = form
        make: Any = self.optimizer_class
        self.optimizer = make(self.parameters(), lr=lr_schedule(1), eps=1e-5)

    def _seen(self, observed: Tensor) -> Tensor:
        """Patches and their places, [B, C + 2, rows, columns]."""
        with torch.no_grad():
            patches = self.see(observed)
            return torch.cat([patches, self.get_buffer("places").expand(len(patches), -1, -1, -1)], 1)

    def _distribution(self, seen: Tensor) -> BinDistribution:
        features = self.trunk(seen)
        scores = self.scores(features).flatten(1)
        if self.idle is not None:
            scores = torch.cat([scores, self.idle(features.mean((2, 3)))], 1)
        return BinDistribution(self.form, Categorical(logits=scores))

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
        return self._value(seen), distribution.log_prob(actions), distribution.distribution.entropy()

    def get_distribution(self, observed: Any) -> Any:
        return self._distribution(self._seen(observed))

    def predict_values(self, observed: Any) -> Tensor:
        return self._value(self._seen(observed))
