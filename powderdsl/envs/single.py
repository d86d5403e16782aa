"""One world of a task as an environment of Gymnasium's: a batch of one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import MultiDiscrete
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from powderdsl.envs.frames import RENDER_MODES, check_render_mode, frames
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.envs.vector import array
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.task import Task


class PowderEnv(gymnasium.Env[NDArray[Any], NDArray[np.int64]], EzPickle):
    """One world. It plays what slot 0 of a `PowderVectorEnv` of the same seed plays.

    Pickling keeps what it was made with, not the world in it.

    Args:
        task, and all others: those of `TensorEnv`, without `num_envs` and `autoreset_mode`.
        render_mode: ``rgb_array`` (a uint8 picture) or ``ansi`` (text). render_scale: pixels along a cell's side.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 15}  # noqa: RUF012 as Gymnasium declares it

    def __init__(
        self,
        task: str | Path | Task | TaskProgram,
        *,
        render_mode: str | None = None,
        render_scale: int = 8,
        **how: Any,
    ):
        EzPickle.__init__(self, task, render_mode=render_mode, render_scale=render_scale, **how)
        self.render_mode, self.render_scale = check_render_mode(render_mode), render_scale
        self.tensors = TensorEnv(task, 1, autoreset_mode="disabled", **how)
        """The same environment for tensors."""
        self.observation_space = self.tensors.observation.space
        self.action_space = MultiDiscrete(np.array(self.tensors.action_nvec))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin an episode. Seeds and options are those of `TensorEnv.reset`; infos: ``world``."""
        observed, info = self.tensors.reset(seed=seed, options=options)
        super().reset(seed=seed)
        return array(observed[0]), {"world": int(info["world"][0])}

    def step(self, action: Any) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """One action: x, y, choice, vx, vy. Infos: ``success``, ``world``; with the last step ``episode_return`` and
        ``episode_length``."""
        batch = np.asarray(action)
        if batch.shape != (5,):
            raise ValueError(f"an action has the shape [5], found {list(batch.shape)}")
        observed, reward, terminated, truncated, info = self.tensors.step(batch[None])
        found = {name: one[0].item() for name, one in info.items() if not name.startswith("_")}
        return array(observed[0]), float(reward[0]), bool(terminated[0]), bool(truncated[0]), found

    def render(self) -> Any:
        """A picture uint8 [H, W, 3], or text, in the mode that was chosen."""
        return (
            None if self.render_mode is None else frames(self.tensors, self.render_mode, self.render_scale)[0]
        )
