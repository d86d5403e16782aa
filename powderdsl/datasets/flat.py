"""The flat layouts of D4RL and OGBench, which offline learners take. They hold everything in memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from powderdsl.datasets.dataset import Dataset
from powderdsl.system.settings import check_choice

LAYOUTS = ("d4rl", "ogbench")


def flat(dataset: Dataset, layout: str = "d4rl") -> dict[str, NDArray[Any]]:
    """All episodes, concatenated.

    Args:
        layout: ``d4rl``: N rows of `observations`, `actions`, `rewards`, `next_observations`, `terminals` and
            `timeouts`. ``ogbench``: what its dataset files hold and its `load_dataset` reads: each episode has one row
            more, its last observation with an action of zeros; `terminals` is 1 there and nowhere else. `masks`, which
            it does not read, is 0 where an episode terminated, and `rewards` 0 in the last row.

    Raises:
        ValueError: another layout.
    """
    check_choice("layout", layout, LAYOUTS)
    parts = [_episode(dataset, number, layout) for number in range(len(dataset))]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _episode(dataset: Dataset, number: int, layout: str) -> dict[str, NDArray[Any]]:
    episode = dataset.episode(number)
    shown, action, reward = (
        episode.observation.numpy(),
        episode.action.numpy().astype(np.int32),
        episode.reward.numpy(),
    )
    terminated, truncated = episode.terminated.numpy(), episode.truncated.numpy()
    if layout == "d4rl":
        return {
            "observations": shown[:-1],
            "actions": action,
            "rewards": reward,
            "next_observations": shown[1:],
            "terminals": terminated,
            "timeouts": truncated,
        }
    return {
        "observations": shown,
        "actions": np.concatenate([action, np.zeros((1, 5), np.int32)]),
        "rewards": np.append(reward, np.float32(0)),
        "terminals": np.append(np.zeros(len(action), np.float32), np.float32(1)),
        "masks": np.append(~terminated, not terminated[-1]).astype(np.float32),
    }
