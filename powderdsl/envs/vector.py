"""`TensorEnv` as a vector environment of Gymnasium's: NumPy in, NumPy out, one batched simulation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import MultiDiscrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from powderdsl.envs.frames import RENDER_MODES, check_render_mode, frames
from powderdsl.envs.tensor_env import Info, TensorEnv
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.task import Task

Array = NDArray[Any]


class PowderVectorEnv(VectorEnv[Any, Any, Any]):
    """Many worlds of a task, stepped together. Rewards are float32; arrays are never written to after they are returned.

    Args:
        task, num_envs, and all others: those of `TensorEnv`.
        render_mode: ``rgb_array`` (uint8 pictures) or ``ansi`` (text), of each world.
        render_scale: pixels along a cell's side.
    """

    def __init__(
        self,
        task: str | Path | Task | TaskProgram,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        render_scale: int = 8,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        **how: Any,
    ):
        self.render_mode, self.render_scale = check_render_mode(render_mode), render_scale
        self.tensors = TensorEnv(task, num_envs, autoreset_mode=autoreset_mode, **how)
        """The same environment for tensors."""
        self.num_envs = num_envs
        self.autoreset_mode = self.tensors.autoreset_mode
        self.metadata = {
            "autoreset_mode": self.autoreset_mode,
            "render_modes": list(RENDER_MODES),
            "render_fps": 15,
        }
        self.single_observation_space = self.tensors.observation.space
        self.single_action_space = MultiDiscrete(np.array(self.tensors.action_nvec))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """What `TensorEnv.reset` does, in arrays."""
        observed, info = self.tensors.reset(seed=seed, options=options)  # first: a bad seed changes nothing
        if isinstance(seed, int):
            super().reset(seed=seed)
        return array(observed), arrays(info)

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """What `TensorEnv.step` does, in arrays. ``final_obs`` is an array of objects: None but where episodes ended."""
        observed, reward, terminated, truncated, info = self.tensors.step(actions)
        found = arrays(info)
        if "final_obs" in info:
            found["final_obs"] = objects(found["final_obs"], found["_final_obs"])
        return array(observed), array(reward), array(terminated), array(truncated), found

    def render(self) -> tuple[Any, ...] | None:
        """A picture or text of each world, in the mode that was chosen."""
        if self.render_mode is None:
            return None
        return frames(self.tensors, self.render_mode, self.render_scale)


def array(tensor: Tensor) -> Array:
    """A tensor as an array; from a device it is copied."""
    found: Array = tensor.cpu().numpy()
    return found


def arrays(info: Info) -> dict[str, Any]:
    """Infos in arrays."""
    return {name: arrays(one) if isinstance(one, dict) else array(one) for name, one in info.items()}


def objects(rows: Array, mask: Array) -> Array:
    """Rows [n, …] as an array of objects [B]: None where `mask` is not set."""
    found = np.full(len(mask), None, dtype=object)
    for place, row in zip(np.flatnonzero(mask), rows, strict=True):
        found[place] = row
    return found
