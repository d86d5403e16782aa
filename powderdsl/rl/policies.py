"""The policies of runs: networks as functions from observations to actions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, MultiDiscrete
from stable_baselines3.common.policies import ActorCriticCnnPolicy, ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn
from torch.distributions import Categorical

from powderdsl.envs.actions import ActionForm, action_form
from powderdsl.envs.features import paper_policy, patches_of, small_policy
from powderdsl.envs.mixed import environment
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
from powderdsl.system.random import uniforms
from powderdsl.tasks.episodes import compile_task
from powderdsl.tasks.shipped import load_task
from powderdsl.tasks.task import Task

DILATIONS = (1, 2, 4)
"""Dilations of the residual blocks. With the first convolution, an output sees 17 bins in each direction."""

OPTIMIZER = {"eps": 1e-5, "fused": True}
"""Arguments of Adam; `eps` is that of Stable-Baselines3."""


def fcn_policy(env: TensorEnv, channels: int = 32, frames: int = 1) -> dict[str, Any]:
    """`policy_kwargs` of `BinPolicy` for the observations and actions of an environment.

    `channels`: channels of each convolution. `frames`: number of stacked observations. Raises ValueError for
    observations that are pictures.
    """
    bins = env.task.agent.bins
    form = action_form("discrete", env.task.agent, torch.device("cpu"))
    return {"see": patches_of(env, bins, frames), "channels": channels, "bins": bins, "form": form}


class Trunk(nn.Module):
    """From patches [B, C, rows, columns], whose channels include positions, to features [B, F, rows, columns]."""

    def __init__(self, channels: int, width: int):
        super().__init__()
        self.first = nn.Conv2d(channels, width, 3, padding=1)
        self.blocks = nn.ModuleList(nn.Conv2d(width, width, 3, padding=d, dilation=d) for d in DILATIONS)
        self.means = nn.ModuleList(nn.Linear(width, width) for _ in DILATIONS)

    def forward(self, patches: Tensor) -> Tensor:
        features = self.first(patches).relu_()
        for block, mean in zip(self.blocks, self.means, strict=True):
            weights = [weight.to(features.dtype) for weight in (*block.parameters(), *mean.parameters())]
            features = Residual.apply(features, *weights, block.dilation)
        return features


class Residual(torch.autograd.Function):
    """``x + (convolution(x) + linear(mean(x))).relu()``, which writes fewer tensors than separate operations."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, *given: Any) -> Tensor:
        kernel, bias, matrix, shift, d = given
        mean = x.mean((2, 3))
        added = torch.conv2d(x, kernel, bias, padding=d, dilation=d)
        added.add_(torch.addmm(shift, mean, matrix.T)[:, :, None, None]).relu_()
        ctx.save_for_backward(x, kernel, matrix, mean, added)
        ctx.d = d
        return x + added

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        (x, kernel, matrix, mean, added), d, call = ctx.saved_tensors, ctx.d, torch.ops.aten
        inner = call.threshold_backward(grads[0], added, 0)
        sums = inner.sum((2, 3))
        how = None, (1, 1), d, d, False, (0, 0), 1, (True, True, False)
        back, kernels, _ = call.convolution_backward(inner, x, kernel, *how)
        back.add_(grads[0]).add_((sums @ matrix / x[0, 0].numel())[:, :, None, None])
        return back, kernels, sums.sum(0), sums.T @ mean, sums.sum(0), None


@dataclass(frozen=True)
class BinDistribution:
    """A distribution over values of a ``discrete`` form of actions. Actions are (x, y, choice, vx, vy), int64 [B,
    5]."""

    form: ActionForm
    distribution: Categorical

    def action(self, values: Tensor) -> Tensor:
        """The five numbers of values, int64 [B, 5]."""
        return self.form.decode(values).to(values.device)

    def log_prob(self, actions: Tensor) -> Tensor:
        return self.distribution.log_prob(self.form.encode(actions.long()).to(actions.device))

    def get_actions(self, deterministic: bool = False) -> Tensor:
        chances = self.distribution
        return self.action(chances.probs.argmax(1) if deterministic else chances.sample())


class BinPolicy(ActorCriticPolicy):
    """A policy with convolutions that preserve the bins, and a score for each bin and operation. The value has separate
    convolutions, so that its errors, which are large at first, do not affect the scores.

    Args:
        see: maps observations to patches, one per bin. channels: channels of each convolution. bins: rows and columns.
        form: the ``discrete`` form of actions, whose order is that of the scores: by operation, then by row.
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
        choices, idle = divmod(form.nvec[0], bins[0] * bins[1])
        self.scores = nn.Conv2d(width, choices, 1)
        self.idle = nn.Linear(width, 1) if idle else None  # doing nothing has no location
        self.judge = nn.Sequential(
            nn.Conv2d(see.channels + 2, width, 3, 2, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, 2, 1),
            nn.ReLU(inplace=True),
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
                nn.init.orthogonal_(last.weight, 0.01)  # initially, all actions are about equally likely
        self.form = form
        make: Any = self.optimizer_class
        self.optimizer = make(self.parameters(), lr=lr_schedule(1), **OPTIMIZER)

    def _seen(self, observed: Tensor) -> Tensor:
        """Patches and their positions, [B, C + 2, rows, columns]."""
        with torch.no_grad():
            patches = self.see(observed).permute(0, 2, 3, 1)
            places = self.get_buffer("places").permute(1, 2, 0).expand(len(patches), -1, -1, -1)
            return torch.cat([patches, places], 3).permute(0, 3, 1, 2)  # channels last in memory

    def _distribution(self, seen: Tensor) -> BinDistribution:
        features = self.trunk(seen)
        scores = self.scores(features).flatten(1)
        if self.idle is not None:
            scores = torch.cat([scores, self.idle(features.mean((2, 3)))], 1)
        return BinDistribution(self.form, Categorical(logits=scores))

    def forward(self, observed: Any, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        seen = self._seen(observed)
        distribution = self._distribution(seen)
        actions = distribution.get_actions(deterministic)
        return actions, self.judge(seen), distribution.log_prob(actions)

    def evaluate_actions(self, observed: Any, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        seen = self._seen(observed)
        distribution = self._distribution(seen)
        return self.judge(seen), distribution.log_prob(actions), distribution.distribution.entropy()

    def get_distribution(self, observed: Any) -> Any:
        return self._distribution(self._seen(observed))

    def predict_values(self, observed: Any) -> Tensor:
        return self.judge(self._seen(observed))


BESIDES = ("task_fingerprint", "palette", "channels", "shaped_fingerprint")
"""Entries of a run's configuration that are not settings."""


def policy_of(config: TrainConfig, env: TensorEnv) -> tuple[type[ActorCriticPolicy], dict[str, Any]]:
    """The policy class of a run, and its `policy_kwargs`."""
    if config.network == "fcn":
        return BinPolicy, fcn_policy(env, config.features, config.frames)
    build = paper_policy if config.network == "paper" else small_policy
    how = build(env, features_dim=config.features, frames=config.frames)
    return ActorCriticCnnPolicy, {**how, "optimizer_kwargs": OPTIMIZER}


def compute_in(precision: str, policy: ActorCriticPolicy) -> None:
    """Make all but the last layers of a policy compute in ``bfloat16``; ``float32`` changes nothing."""
    net: Any = policy
    layers = [net.trunk, *net.judge[:-1]] if isinstance(policy, BinPolicy) else [net.features_extractor]
    for layer in layers if precision == "bfloat16" else ():
        call = torch.autocast(policy.device.type, torch.bfloat16)(layer.forward)
        layer.forward = lambda seen, call=call: call(seen).float()


@dataclass(frozen=True)
class TrainedPolicy:
    """The policy of a run, an `envs.actions.Policy`.

    `deterministic`: take the most likely action instead of sampling one. With `frames` above 1, it takes observations
    stacked by a `FrameStack`.
    """

    network: ActorCriticPolicy
    observation: str
    """Its form of observation."""
    channels: int
    """The number of channels used, from the first."""
    step: int
    """The number of interactions it was trained on."""
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
                (drawn[:, i, None] * bounds[:, -1:] >= bounds).sum(1) for i, bounds in enumerate(below)
            ]
        return distribution.action(indices[0]) if joint else torch.stack(indices, 1)


def load_policy(run: RunFolder | str | Path, env: TensorEnv, *, deterministic: bool = False) -> TrainedPolicy:
    """Load the policy of a run's newest checkpoint, for the observations and actions of `env`, on its device.

    Args:
        run: a run, its path or its name.
        env: the environment to play. Its rules may have packs that training did not have: see `task_of`.
        deterministic: take the most likely action instead of sampling one.

    Returns:
        A function from observations [B, …] and keys, int64 [B], to actions, int64 [B, 5]: see `envs.actions.Policy`.

    Raises:
        CompileError: PD620 if there is no such run or checkpoint; PD623 if the environment does not fit the run.
    """
    folder = find_run(run, "ppo")
    config = config_of(folder)
    if env.observation.kind != config.observation:
        why = f"it needs `{config.observation}`; the environment has `{env.observation.kind}`"
        raise misfit(folder.path, why)
    own = _own_env(folder, config, env)
    checkpoint = folder.checkpoint()
    kind, how = policy_of(config, own)
    space = own.observation.space
    if config.frames > 1:
        low, high = (bound.repeat(config.frames, 0) for bound in (space.low, space.high))
        space = Box(low, high, dtype=space.dtype.type)
    actions, rate = MultiDiscrete(np.array(own.action_nvec)), config.learning_rate
    # Networks that only act need no optimizer: the first one of a process imports torch's compiler for a second.
    how["optimizer_class"] = lambda *_, **__: None
    network = kind(space, actions, lambda _: rate, **how)
    with reporting_misfits(folder.path, "its network has another shape"):
        network.load_state_dict(checkpoint.state["policy"])
    network.to(env.device).set_training_mode(False)
    compute_in(config.precision, network)
    channels = len(own.observation.channels)
    return TrainedPolicy(network, config.observation, channels, checkpoint.step, deterministic, config.frames)


def _own_env(run: RunFolder, config: TrainConfig, env: TensorEnv) -> TensorEnv:
    """The environment for which the run's network was created: `env`, or one without packs added later.

    Raises CompileError (PD623) if `env` has elements for which the network has no slots.
    """
    elements = {element.id: element.qualified for element in env.task.ruleset.elements}
    check_palette(run.path, recorded_palette(run), elements)
    if tuple(run.config.get("channels", ())) == tuple(env.observation.channels):
        return env
    program = compile_task(task_of(run), split=config.split, backend="torch", device=str(env.device))
    return environment(program, 1, observation=config.observation)


def task_of(run: RunFolder, packs: Sequence[str] = ()) -> Task:
    """The task of a run, with the ids of its network. `packs` are added to its rules.

    Raises CompileError: PD640 if its settings are damaged; what `load_task` raises.
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
    """The initial settings of a run. Raises CompileError (PD640) if they are damaged."""
    return from_json({name: value for name, value in run.config.items() if name not in BESIDES})
