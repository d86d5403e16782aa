"""`TensorEnv` as a vectorized environment of Stable-Baselines3."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from powderdsl.envs.gym import Face, array
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.task import Task

Array = NDArray[Any]


class PowderVecEnv(Face, VecEnv):
    """Many worlds of a task, stepped together: ``PPO("CnnPolicy", PowderVecEnv("some-task", 32))``.

    Infos are empty except for worlds whose episode ended: ``terminal_observation``, ``TimeLimit.truncated``,
    ``is_success`` if the task defines success, and ``episode`` as `Monitor` adds it, so that `Monitor` is not needed.

    Args:
        task, num_envs, and all others: those of `TensorEnv`, without `autoreset_mode`.
        actions: as in `TensorEnv`, but by default without unused numbers.
        render_mode: ``rgb_array`` or ``ansi``. render_scale: pixels per side of a cell.
    """

    def __init__(self, task: str | Path | Task | TaskProgram, num_envs: int = 1, **how: Any):
        self._show(task, how, num_envs=num_envs, autoreset_mode="same_step")
        self._actions: Any = None
        self._began = time.time()
        super().__init__(num_envs, self.tensors.observation.space, self.tensors.single_action_space)

    def reset(self) -> Array:
        """Begin all episodes, using the seeds and options set by `seed` and `set_options` once."""
        options = self._options[0]
        if any(other is not options and other != options for other in self._options):
            raise ValueError("all worlds share one environment, so they take the same options")
        observed, info = self.tensors.reset(seed=self._seeds, options=options)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{"world": world} for world in info["world"].tolist()]
        return array(observed)

    def step_async(self, actions: Any) -> None:
        """Store the actions, [B] or [B, k], for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:
        """Observations, rewards float32 [B], whether episodes ended bool [B], and infos."""
        observed, reward, terminated, truncated, info = self.tensors.step_arrays(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            final, passed = info["final_info"], round(time.time() - self._began, 6)
            for place, last in zip(np.flatnonzero(done), info["final_obs"], strict=True):
                returned, length = float(final["episode_return"][place]), int(final["episode_length"][place])
                infos[place] = {
                    "terminal_observation": last,
                    "TimeLimit.truncated": bool(truncated[place]),
                    "episode": {"r": returned, "l": length, "t": passed},
                }
                if self.tensors.task.goal.success is not None:
                    infos[place]["is_success"] = bool(final["success"][place])
        return observed, reward, done, infos

    def state(self) -> dict[str, Any]:
        """The result of `TensorEnv.state`."""
        return self.tensors.state()

    def restore(self, state: Mapping[str, Any]) -> Array:
        """Continue from a state, as `TensorEnv.restore` does; discards seeds and options for the next reset."""
        observed = self.tensors.restore(state)
        self._reset_seeds()
        self._reset_options()
        return array(observed)

    def close(self) -> None:
        """Do nothing: there is nothing to close."""

    def get_images(self) -> Sequence[Array | None]:
        """A picture of each world, uint8 [H, W, 3]."""
        return self.frames("rgb_array")

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of this environment or its `TensorEnv`, once per world."""
        owner = self if hasattr(self, attr_name) else self.tensors
        return [getattr(owner, attr_name)] * len(self._chosen(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute for all worlds. Raises ValueError for a subset, since they share one environment."""
        if len(self._chosen(indices)) != self.num_envs:
            raise ValueError("all worlds share one environment, so an attribute is set for all of them")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method once and return the result for each world; for `action_masks`, each world's own row."""
        if method_name == "action_masks":
            masks = self.action_masks()
            return [masks[place] for place in self._chosen(indices)]
        owner = self if hasattr(self, method_name) else self.tensors
        result = getattr(owner, method_name)(*method_args, **method_kwargs)
        return [result] * len(self._chosen(indices))

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """True if infos come from a wrapper such as `Monitor`."""
        return [wrapper_class is Monitor] * len(self._chosen(indices))

    def _chosen(self, indices: Any) -> list[int]:
        return list(self._get_indices(indices))
