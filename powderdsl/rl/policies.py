"""Policies: functions from observations to actions, on tensors. Random numbers are hashes, so no batch changes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import MultiDiscrete
from stable_baselines3.common.policies import ActorCriticCnnPolicy
from torch import Tensor

from powderdsl.backends.torch_random import MASK, mix
from powderdsl.envs.features import paper_policy
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.rl.patch_network import small_policy
from powderdsl.rl.ppo_config import TrainConfig, from_json
from powderdsl.runs import RunFolder, find_run

Policy = Callable[[Tensor, Tensor], Tensor]
"""From observations [B, …] and keys, int64 [B], to actions int64 [B, 5]. Keys are what random numbers hang on."""


def policy_kwargs(config: TrainConfig, env: TensorEnv) -> dict[str, Any]:
    """The network of a run, as `policy_kwargs` of ``CnnPolicy``."""
    build = paper_policy if config.network == "paper" else small_policy
    return build(env, features_dim=config.features)


def uniforms(keys: Tensor, count: int) -> Tensor:
    """Numbers in [0, 1) by key: float64 [B, count]."""
    numbers = torch.arange(count, device=keys.device) * 0x9E3779B1 & MASK
    low, high = mix(keys & MASK), (keys >> 32) & MASK
    drawn = mix((mix(low ^ high)[:, None] + numbers) & MASK)
    return drawn.double() / float(1 << 32)


def action_keys(seed: int, episodes: Tensor, step: int) -> Tensor:
    """The keys of one action in each of some episodes, by their numbers: int64 [B]."""
    low = mix((mix(torch.full_like(episodes, seed) & MASK) + episodes) & MASK)
    return mix((low + step) & MASK) << 31 | mix(low ^ mix(torch.full_like(low, step))) >> 1


def random_policy(nvec: tuple[int, ...]) -> Policy:
    """All actions equally likely."""

    def act(observed: Tensor, keys: Tensor) -> Tensor:
        counts = torch.tensor(nvec, device=keys.device)
        return (uniforms(keys, len(nvec)) * counts).long()

    return act


@dataclass(frozen=True)
class TrainedPolicy:
    """The policy of a run: a function as `Policy` says.

    `deterministic`: the likeliest action, instead of one drawn.
    """

    network: ActorCriticCnnPolicy
    observation: str
    """The kind of observation it takes."""
    step: int
    """The interactions that it has learned from."""
    deterministic: bool = False

    def __call__(self, observed: Tensor, keys: Tensor) -> Tensor:
        with torch.no_grad():
            choices: Any = self.network.get_distribution(
                observed
            ).distribution  # one of each number of an action
        if self.deterministic:
            return torch.stack([one.probs.argmax(1) for one in choices], 1)
        drawn = uniforms(keys, len(choices))
        picked = []
        for column, one in enumerate(choices):
            below = one.probs.double().cumsum(1)
            picked.append((drawn[:, column, None] * below[:, -1:] >= below).sum(1))
        return torch.stack(picked, 1)


def load_policy(run: RunFolder | str | Path, env: TensorEnv, *, deterministic: bool = False) -> TrainedPolicy:
    """The policy of a run's newest checkpoint, for the observations and actions of `env`, on its device.

    Raises:
        CompileError: PD620 if there is no such run or checkpoint. ValueError: the environment does not fit the run.
    """
    found = run if isinstance(run, RunFolder) else find_run(run, "ppo")
    config = config_of(found)
    if env.observation.kind != config.observation:
        raise ValueError(f"the run sees `{config.observation}`, not `{env.observation.kind}`")
    network = ActorCriticCnnPolicy(
        env.observation.space,
        MultiDiscrete(np.array(env.action_nvec)),
        lambda _: config.learning_rate,
        **policy_kwargs(config, env),
    )
    checkpoint = found.checkpoint()
    try:
        network.load_state_dict(checkpoint.state["policy"])
    except RuntimeError as error:
        raise ValueError(f"the run {found.path} is of another task: {error}") from None
    network.to(env.device).set_training_mode(False)
    return TrainedPolicy(network, config.observation, checkpoint.step, deterministic)


def config_of(run: RunFolder) -> TrainConfig:
    """The settings that a run was begun with. Raises CompileError (PD640) if they are damaged."""
    return from_json({name: value for name, value in run.config.items() if name != "task_fingerprint"})
