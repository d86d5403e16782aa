"""The policies of runs: networks as functions from observations to actions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, MultiDiscrete
from stable_baselines3.common.policies import ActorCriticCnnPolicy, ActorCriticPolicy
from torch import Tensor

from powderdsl.envs.acting import uniforms
from powderdsl.envs.features import paper_policy, small_policy
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.experiments.runs import (
    RunFolder,
    check_palette,
    find_run,
    misfit,
    recorded_palette,
    reporting_misfits,
)
from powderdsl.rl.config import TrainConfig, from_json
from powderdsl.rl.fcn import BinDistribution, BinPolicy, fcn_policy
from powderdsl.tasks.episodes import compile_task
from powderdsl.tasks.shipped import load_task
from powderdsl.tasks.task import Task

BESIDES = ("task_fingerprint", "palette", "channels", "shaped_fingerprint")
"""Entries of a run's configuration that are not settings."""


def policy_of(config: TrainConfig, env: TensorEnv) -> tuple[type[ActorCriticPolicy], dict[str, Any]]:
    """The policy class of a run, and its `policy_kwargs`."""
    if config.network == "fcn":
        return BinPolicy, fcn_policy(env, config.features, config.frames)
    build = paper_policy if config.network == "paper" else small_policy
    return ActorCriticCnnPolicy, build(env, features_dim=config.features, frames=config.frames)


@dataclass(frozen=True)
class TrainedPolicy:
    """The policy of a run: a function as `envs.acting.Policy` says.

    `deterministic`: the likeliest action, instead of one drawn. If `frames` is not 1, it takes that many observations,
    stacked by a `FrameStack`.
    """

    network: ActorCriticPolicy
    observation: str
    """The kind of observation it takes."""
    channels: int
    """How many of its channels, from the first."""
    step: int
    """The interactions that it has learned from."""
    deterministic: bool = False
    frames: int = 1

    def __call__(self, observed: Tensor, keys: Tensor) -> Tensor:
        frames = observed.unflatten(1, (self.frames, -1))[:, :, : self.channels].flatten(1, 2)
        with torch.no_grad():
            distribution: Any = self.network.get_distribution(frames)
        # One for each number of an action, or one for all of them.
        joint = isinstance(distribution, BinDistribution)
        choices = [distribution.distribution] if joint else distribution.distribution
        if self.deterministic:
            indices = [choice.probs.argmax(1) for choice in choices]
        else:
            drawn = uniforms(keys, len(choices))
            below = [choice.probs.double().cumsum(1) for choice in choices]
            indices = [
                (drawn[:, column, None] * bounds[:, -1:] >= bounds).sum(1)
                for column, bounds in enumerate(below)
            ]
        actions: Tensor = distribution.action(indices[0]) if joint else torch.stack(indices, 1)
        return actions


class _NoOptimizer:
    """No optimizer, for networks that only act: a process's first one imports torch's compiler, which takes a second."""

    def __init__(self, *_: object, **__: object):
        pass


def load_policy(run: RunFolder | str | Path, env: TensorEnv, *, deterministic: bool = False) -> TrainedPolicy:
    """Load the policy of a run's newest checkpoint, for the observations and actions of `env`, on its device.

    Args:
        run: a run, its path or its name.
        env: the environment to play. Its rules may have packs that the run did not know: see `task_of`.
        deterministic: take the likeliest action, instead of drawing one.

    Returns:
        A function from observations [B, …] and keys, int64 [B], to actions, int64 [B, 5]: see `envs.acting.Policy`.

    Raises:
        CompileError: PD620 if there is no such run or checkpoint; PD623 if the environment does not fit the run.
    """
    folder = find_run(run, "ppo")
    config = config_of(folder)
    if env.observation.kind != config.observation:
        why = f"it sees `{config.observation}`; the environment shows `{env.observation.kind}`"
        raise misfit(folder.path, why)
    own = _own_env(folder, config, env)
    checkpoint = folder.checkpoint()
    kind, how = policy_of(config, own)
    space = own.observation.space
    if config.frames > 1:
        space = Box(
            space.low.repeat(config.frames, 0), space.high.repeat(config.frames, 0), dtype=space.dtype.type
        )
    actions, rate = MultiDiscrete(np.array(own.action_nvec)), config.learning_rate
    network = kind(space, actions, lambda _: rate, **how | {"optimizer_class": _NoOptimizer})
    with reporting_misfits(folder.path, "its network is another"):
        network.load_state_dict(checkpoint.state["policy"])
    network.to(env.device).set_training_mode(False)
    channels = len(own.observation.channels)
    return TrainedPolicy(network, config.observation, channels, checkpoint.step, deterministic, config.frames)


def _own_env(run: RunFolder, config: TrainConfig, env: TensorEnv) -> TensorEnv:
    """The environment that the run's network was made for: `env`, or one without the packs that came later.

    Raises CompileError (PD623) if `env` has elements for which the network has no slots.
    """
    elements = {element.id: element.qualified for element in env.task.ruleset.elements}
    check_palette(run.path, recorded_palette(run), elements)
    if tuple(run.config.get("channels", ())) == tuple(env.observation.channels):
        return env
    program = compile_task(task_of(run), split=config.split, backend="torch", device=str(env.device))
    return TensorEnv(program, 1, observation=config.observation)


def task_of(run: RunFolder, packs: Sequence[str] = ()) -> Task:
    """The task of a run, with the ids that its network knows. `packs` are added to its rules.

    Raises:
        CompileError: PD640 if its settings are damaged; what `load_task` raises.
    """
    config = config_of(run)
    return load_task(
        config.task,
        knobs=dict(config.knobs),
        params=dict(config.params),
        packs=(*config.packs, *packs),
        palette=recorded_palette(run),
    )


def config_of(run: RunFolder) -> TrainConfig:
    """The settings that a run was begun with. Raises CompileError (PD640) if they are damaged."""
    return from_json({name: value for name, value in run.config.items() if name not in BESIDES})
