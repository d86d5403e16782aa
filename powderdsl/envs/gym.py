"""Gymnasium environments that wrap `TensorEnv` with NumPy arrays: many worlds in one batched simulation, or one.

`GoalEnv` is for goal-conditioned use, as Gymnasium-Robotics and hindsight replay (HER) expect it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils import EzPickle, RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from powderdsl.envs import env_id
from powderdsl.envs.compiled import CompiledEnv, arrays_of
from powderdsl.envs.mixed import environment
from powderdsl.envs.tensor_env import TensorEnv
from powderdsl.simulation.draw import scale
from powderdsl.system.settings import check_choice
from powderdsl.tasks.episodes import TaskProgram
from powderdsl.tasks.task import Task

Array = NDArray[Any]

RENDER_MODES = ("rgb_array", "ansi")


def array(tensor: Tensor) -> Array:
    """A tensor as an array, copied from a device."""
    return tensor.cpu().numpy()


def objects(rows: Array, mask: Array) -> Array:
    """Rows [n, …] as an array of objects [B]: None where `mask` is not set."""
    column = np.full(len(mask), None, dtype=object)
    for place, row in zip(np.flatnonzero(mask), rows, strict=True):
        column[place] = row
    return column


class Face:
    """The base of environments that wrap a `TensorEnv` for a library: pictures and spec."""

    tensors: CompiledEnv
    """The same environment for tensors."""
    render_mode: str | None
    render_scale: int
    _spec: EnvSpec | None = None

    def _show(self, task: Any, how: Mapping[str, Any], **fixed: Any) -> None:
        """Create the environment for tensors; `how` and `fixed` are its arguments, of which the spec records `how`."""
        how = {"render_mode": None, "render_scale": 8, "actions": "multidiscrete", **how}
        rest = {**how, **fixed}
        self.render_mode, self.render_scale = rest.pop("render_mode"), rest.pop("render_scale")
        if self.render_mode is not None:
            check_choice("render_mode", self.render_mode, RENDER_MODES)
        self.tensors = environment(task, **rest)
        self.spec = EnvSpec(
            env_id(self.tensors.task.name),
            entry_point="powderdsl.envs.gym:PowderEnv",
            vector_entry_point="powderdsl.envs.gym:PowderVectorEnv",
            kwargs={"task": task, **how},
        )

    @property
    def spec(self) -> EnvSpec | None:
        """The spec of `gymnasium.make`. `max_episode_steps` is the number of actions; no wrapper enforces it."""
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        limit = self.tensors.max_episode_steps
        self._spec = None if value is None else replace(value, max_episode_steps=limit)

    def action_masks(self) -> Array:
        """Return the mask of allowed actions: bool [B, n], the values of an action's first number, then of its second, …"""
        return array(self.tensors.action_masks())

    def frames(self, mode: str) -> tuple[Any, ...]:
        """A picture of each world, uint8 [H·factor, W·factor, 3], or its rows as text."""
        if self.tensors.episodes is None:
            raise ResetNeeded("reset the environment before rendering it")
        world = self.tensors.episodes.world
        if mode == "rgb_array":
            return tuple(scale(world.rgb().cpu().numpy(), self.render_scale))
        glyphs = {element.id: element.glyph for element in self.tensors.simulator.ruleset.elements}
        return tuple(
            "".join("".join(glyphs.get(number, "?") for number in row) + "\n" for row in rows)
            for rows in world.ids.tolist()
        )


class PowderVectorEnv(Face, VectorEnv[Any, Any, Any]):
    """Many worlds of a task, stepped together. Returned arrays are never overwritten.

    Args:
        task: as in `TensorEnv`.
        num_envs: the number of worlds, B.
        autoreset_mode: as in `TensorEnv`; the default is Gymnasium's, which its wrappers expect.
        how: all other arguments of `TensorEnv`. The default of ``actions`` is ``multidiscrete``, which omits numbers
            that the task does not use. ``render_mode``: ``rgb_array`` (uint8 pictures) or ``ansi`` (text), of each
            world. ``render_scale``: pixels per side of a cell.

    Raises:
        CompileError: as in `TensorEnv`.
        ValueError: as in `TensorEnv`, or an unknown render mode.
    """

    def __init__(
        self,
        task: str | Path | Task | TaskProgram,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **how: Any,
    ):
        self._show(task, {"num_envs": num_envs, "autoreset_mode": autoreset_mode, **how})
        self.num_envs = num_envs
        self.autoreset_mode = self.tensors.autoreset_mode
        self.metadata = {
            "autoreset_mode": self.autoreset_mode,
            "render_modes": list(RENDER_MODES),
            "render_fps": 15,
        }
        self.single_observation_space = self.tensors.observation.space
        self.single_action_space = self.tensors.single_action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin new episodes: `TensorEnv.reset` with arrays."""
        observed, info = self.tensors.reset(seed=seed, options=options)  # first: it checks the seed
        if isinstance(seed, int):
            super().reset(seed=seed)
        return array(observed), arrays_of(info)

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Take one action in every world: `TensorEnv.step` with arrays.

        Returns:
            Observations [B, …], reward float32 [B], terminated and truncated bool [B], and infos; ``final_obs`` is an
            array of objects [B]: None unless the episode ended.
        """
        *parts, infos = self.tensors.step_arrays(actions)
        if "final_obs" in infos:
            infos["final_obs"] = objects(infos["final_obs"], infos["_final_obs"])
        observed, reward, terminated, truncated = parts
        return observed, reward, terminated, truncated, infos

    def render(self) -> tuple[Any, ...] | None:
        """Draw each world: uint8 [H·scale, W·scale, 3], or text; None without `render_mode`."""
        return None if self.render_mode is None else self.frames(self.render_mode)


class PowderEnv(Face, gymnasium.Env[Array, Any], EzPickle):
    """One world, with the same episodes as environment 0 of a `PowderVectorEnv` with the same seed.

    Pickling preserves the arguments of the environment, not its world.

    Args:
        task: as in `TensorEnv`.
        how: the other arguments of `PowderVectorEnv`, without ``num_envs`` and ``autoreset_mode``.

    Raises:
        CompileError: as in `TensorEnv`.
        ValueError: as in `PowderVectorEnv`.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 15}  # noqa: RUF012 as Gymnasium declares it

    def __init__(self, task: str | Path | Task | TaskProgram, **how: Any):
        EzPickle.__init__(self, task, **how)
        self._show(task, how, autoreset_mode="disabled")
        self.observation_space = self.tensors.observation.space
        self.action_space = self.tensors.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin a new episode. Seeds and options are those of `TensorEnv.reset`, infos those of `step`."""
        observed, info = self.tensors.reset(seed=seed, options=options)
        super().reset(seed=seed)
        return array(observed[0]), self._info(info)

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Take one action.

        Returns:
            The observation, the reward, terminated, truncated, and infos: ``success``, ``world``, and the
            ``episode_return`` and ``episode_length`` so far.
        """
        observed, reward, terminated, truncated, info = self.tensors.step_arrays(np.asarray(action)[None])
        return observed[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info(info)

    def _info(self, info: Mapping[str, Any]) -> dict[str, Any]:
        returned, length = self.tensors.progress()
        infos: dict[str, Any] = {
            "success": bool(info["success"][0]),
            "world": int(info["world"][0]),
            "episode_return": returned,
            "episode_length": length,
        }
        if "action_mask" in info:
            infos["action_mask"] = np.asarray(info["action_mask"][0])
        return infos

    def action_masks(self) -> Array:
        """Return the mask of allowed actions: bool [n], the values of an action's first number, then of its second, …"""
        return array(self.tensors.action_masks()[0])

    def render(self) -> Any:
        """Draw the world: uint8 [H·scale, W·scale, 3], or text; None without `render_mode`."""
        return None if self.render_mode is None else self.frames(self.render_mode)[0]


class GoalEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """A goal-conditioned wrapper. Goals are values of the task's measures, such as a count in a region.

    Observations are a dict: ``observation``; ``achieved_goal``, float32 [n], the n measures in the task's reward and
    `end`, in the order of their first use; ``desired_goal``, float32 [n]. The reward is 0 if ``|achieved − desired| ≤
    tolerance`` for every measure, else −1. Episodes are as long as the task's.

    Args:
        env: a `PowderEnv`, possibly wrapped, as returned by `gymnasium.make`.
        low: [n], the smallest goals. A goal is drawn once per episode, from the environment's seed.
        high: [n], the largest goals.
        tolerance: [n], or one number.

    Raises:
        ValueError: a task without measures, or bounds of another length.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        low: Sequence[float],
        high: Sequence[float],
        tolerance: float | Sequence[float],
    ):
        RecordConstructorArgs.__init__(self, low=low, high=high, tolerance=tolerance)
        gymnasium.Wrapper.__init__(self, env)
        tensors = self._tensors
        count = len(tensors.program.measures)
        self.low, self.high = np.asarray(low, np.float32), np.asarray(high, np.float32)
        if count == 0:
            raise ValueError(f"the task {tensors.task.name} measures nothing")
        if self.low.shape != (count,) or self.high.shape != (count,) or not (self.low <= self.high).all():
            raise ValueError(f"low and high take {count} numbers each, low ones first: one for each measure")
        self.tolerance = np.broadcast_to(np.asarray(tolerance, np.float32), (count,)).copy()
        self.goal = self.low.copy()
        limit = float(np.finfo(np.float32).max)
        box = spaces.Box(-limit, limit, (count,), np.float32)
        parts = {"observation": env.observation_space, "achieved_goal": box, "desired_goal": box}
        self.observation_space = spaces.Dict(parts)

    @property
    def _tensors(self) -> TensorEnv:
        return cast(PowderEnv, self.env.unwrapped).tensors

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Begin an episode. ``options["goal"]``, [n], replaces the drawn goal."""
        rest = dict(options or {})
        goal = rest.pop("goal", None)
        if goal is not None and np.shape(goal) != self.low.shape:
            raise ValueError(f"a goal has the shape {list(self.low.shape)}, found {list(np.shape(goal))}")
        observed, info = self.env.reset(seed=seed, options=rest)
        drawn = self.env.unwrapped.np_random.uniform(self.low, self.high)
        self.goal = np.asarray(drawn if goal is None else goal, np.float32)
        return self._with_goals(observed), info

    def step(self, action: Any) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Take one action. Infos add ``is_success`` (the goal is met) and ``task_reward``, the reward of the task."""
        observed, task_reward, terminated, truncated, info = self.env.step(action)
        observation = self._with_goals(observed)
        reward = float(self.compute_reward(observation["achieved_goal"], observation["desired_goal"], info))
        info |= {"is_success": reward == 0, "task_reward": task_reward}
        return observation, reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Any:
        """Return the rewards, 0 or −1, float32 [...], for goals [..., n]."""
        near = np.abs(np.asarray(achieved_goal) - np.asarray(desired_goal)) <= self.tolerance
        return near.all(-1).astype(np.float32) - 1

    def _with_goals(self, observed: Any) -> dict[str, Array]:
        tensors = self._tensors
        assert tensors.episodes is not None  # begun by reset and step
        measured = tensors.program.measured(tensors.episodes, tensors.params)
        achieved = measured[0].cpu().numpy().astype(np.float32)
        return {"observation": observed, "achieved_goal": achieved, "desired_goal": self.goal.copy()}
