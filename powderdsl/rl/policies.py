"""The policies of runs: networks as functions from observations to actions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import MultiDiscrete
from stable_baselines3.common.policies import ActorCriticCnnPolicy
from torch import Tensor

from powderdsl.envs.acting import uniforms
from powderdsl.envs.features import paper_policy
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.rl.patch_network import small_policy
from powderdsl.rl.ppo_config import TrainConfig, from_json
from powderdsl.runs import RunFolder, does_not_fit, find_run


def policy_kwargs(config: TrainConfig, env: TensorEnv) -> dict[str, Any]:
    """The network of a run, as `policy_kwargs` of ``CnnPolicy``."""
    build = paper_policy if config.network == "paper" else small_policy
    return build(env, features_dim=config.features)


@dataclass(frozen=True)
class TrainedPolicy:
    """The policy of a run: a function as `envs.acting.Policy` says.

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
        CompileError: PD620 if there is no such run or checkpoint; PD623 if the environment does not fit the run.
    """
    found = run if isinstance(run, RunFolder) else find_run(run, "ppo")
    config = config_of(found)
    if env.observation.kind != config.observation:
        why = f"it sees `{config.observation}`; the environment shows `{env.observation.kind}`"
        raise does_not_fit(found.path, why)
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
        why = " ".join(str(error).split())[:300]
        raise does_not_fit(found.path, f"its network is another: {why}") from None
    network.to(env.device).set_training_mode(False)
    return TrainedPolicy(network, config.observation, checkpoint.step, deterministic)


def config_of(run: RunFolder) -> TrainConfig:
    """The settings that a run was begun with. Raises CompileError (PD640) if they are damaged."""
    return from_json({name: value for name, value in run.config.items() if name != "task_fingerprint"})
