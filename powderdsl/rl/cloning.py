"""Behavior cloning: a policy's network learns the actions of a recorded dataset before PPO begins."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy

from powderdsl.datasets.dataset import Dataset, Transitions, drawn
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.rl.config import TrainConfig

RATE, BATCH = 3e-3, 256
"""Of Adam; transitions of a gradient."""


def open_demonstrations(folder: str | Path, env: TensorEnv) -> Dataset:
    """The dataset of a folder. Raises CompileError: PD630 if it cannot be read, PD631 if it does not fit `env`."""
    found = Dataset.open(folder)
    found.require(env)
    return found


def clone(policy: ActorCriticPolicy, dataset: Dataset, config: TrainConfig) -> dict[str, float]:
    """Fit a policy to a dataset: its likelihood of the actions, and its values to the discounted returns.

    `config.init_epochs` times as many transitions are drawn as there are; which ones depends on `config.seed` alone. The
    learning rate falls to zero.

    Returns:
        means over the last hundred updates at most: the loss, the accuracy (the share of transitions whose recorded
        action is the policy's likeliest) and the error of values.
    """
    rows, returns = Transitions(dataset), _returns(dataset, config.gamma)
    updates = max(1, config.init_epochs * len(rows) // BATCH)
    spread = max(float(returns.var()), 1e-6)  # so that values do not outweigh actions
    optimizer = torch.optim.Adam(policy.parameters(), lr=RATE)
    policy.set_training_mode(True)
    figures = []
    for number in range(updates):
        for group in optimizer.param_groups:
            group["lr"] = RATE * (1 - number / updates)
        numbers = drawn(config.seed, number, BATCH, len(rows))
        batch = rows[numbers]
        observed = batch.observation.to(policy.device)
        actions = batch.action.long().to(policy.device)
        wanted = torch.from_numpy(returns[numbers]).to(policy.device)
        values, likelihood, _ = policy.evaluate_actions(observed, actions)
        error = (values.flatten() - wanted).square().mean()
        loss = -likelihood.mean() + config.vf_coef * error / spread
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), config.max_grad_norm)
        optimizer.step()
        if number >= (updates - 1) // 100 * 100:
            with torch.no_grad():
                likeliest: Any = policy.get_distribution(observed).mode()
            agree = (likeliest == actions).all(1).float().mean()
            figures.append([-float(likelihood.detach().mean()), float(agree), float(error.detach())])
    policy.set_training_mode(False)
    return dict(zip(("loss", "accuracy", "value_error"), np.mean(figures, 0).tolist(), strict=True))


def _returns(dataset: Dataset, gamma: float) -> NDArray[np.float32]:
    """The discounted return from each transition on, float32 [transitions], in the order of the dataset."""
    parts = []
    for number in range(len(dataset)):
        reward = dataset.episode(number).reward.double().numpy()
        total, found = 0.0, np.empty(len(reward), np.float32)
        for step in reversed(range(len(reward))):
            total = reward[step] + gamma * total
            found[step] = total
        parts.append(found)
    return np.concatenate(parts)
