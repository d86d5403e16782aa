"""OGBench's environment, with its spaces, options and infos: one world of a level, or many in one batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from powderdsl.envs.gym import array, objects
from powderdsl.envs.tensor_env import check_cells, check_going, check_options, mode_of, reset_mask, seeds_of
from powderdsl.ogbench.episodes import FIRST, MODES, RANDOMNESS, LevelEpisodes, LevelProgram, keyed, task_of
from powderdsl.ogbench.levels import GoalTask, Level, find_level
from powderdsl.system.settings import check_settings, setting

Array = NDArray[Any]

OPTIONS = ("task_id", "task_info", "render_goal")
BATCH_OPTIONS = ("task_id", "task_info", "reset_mask")
"""Options of `reset`."""


@dataclass(frozen=True)
class EnvOptions:
    """Options of single and batched environments of a level.

    Args:
        mode: ``task``, or ``data_collection``: no goals and no rewards.
        seed: determines goals and episodes, until `reset` gets another one.
        randomness: ``counter``: a goal depends only on the seed and its task, and episode n of a seed is the same
            anywhere. ``ogbench``: draws from the environment's own `numpy.random.RandomState` in OGBench's order, so
            that `reset` with a seed plays the same as OGBench after `numpy.random.seed`.
        render_mode: None or ``rgb_array``. width, height: of what `render` returns.
        backend, device, threads: those of `powderdsl.compile`; ``ogbench`` runs on ``torch``.

    Raises:
        TypeError, ValueError: a value is wrong.
    """

    mode: str = setting("task", choices=MODES)
    seed: int = 0
    randomness: str = setting("counter", choices=RANDOMNESS)
    render_mode: str | None = None
    width: int = 192
    height: int = 192
    backend: str = "auto"
    device: str = "cpu"
    threads: int = 1

    def __post_init__(self) -> None:
        seeds_of(self.seed, 1)
        check_settings(self)
        if self.render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is None or rgb_array; found {self.render_mode!r}")

    def program(self, level: str | Path | Level | LevelProgram) -> LevelProgram:
        """The program of a level, shared by environments of a process."""
        if isinstance(level, LevelProgram):
            return level
        return _program(
            find_level(level),
            backend=self.backend,
            device=str(self.device),
            threads=self.threads,
            as_ogbench=self.randomness == "ogbench",
        )

    def picture(self, observation: Array) -> Array:
        """The world's part of an observation, scaled to the nearest pixels: uint8 [height, width, 3]."""
        rows = np.arange(self.height) * observation.shape[0] // self.height
        columns = np.arange(self.width) * observation.shape[1] // self.width
        return np.ascontiguousarray(observation[rows][:, columns, :3])


_program = lru_cache(maxsize=16)(LevelProgram)


class _Face:
    """The base of Gymnasium environments that wrap `LevelEpisodes`: spaces and pictures."""

    metadata: dict[str, Any]
    episodes: LevelEpisodes
    """The same episodes on tensors. Environment i has the seed `seed` + i."""

    def _show(self, level: str | Path | Level | LevelProgram, count: int, options: EnvOptions) -> None:
        program = options.program(level)
        self._options, self.level, self.render_mode = options, program.level, options.render_mode
        check_cells(count, (self.level.side, self.level.side))
        seeds = np.arange(count) + options.seed
        self.episodes = LevelEpisodes(program, seeds, randomness=options.randomness, mode=options.mode)
        self._space = Box(0, 255, (self.level.side, self.level.side, 6), np.uint8)
        self._actions = Discrete(self.level.actions)

    def _task(self, options: Mapping[str, Any]) -> int | GoalTask | None:
        """The task named by options of `reset`, if there are tasks."""
        return task_of(self.level, options) if self.episodes.mode == "task" else None

    def _observations(self) -> Array:
        return array(self.episodes.observations())

    def _pictures(self) -> tuple[Array, ...]:
        return tuple(self._options.picture(world) for world in self._observations())


class PowderworldEnv(_Face, gymnasium.Env[Array, Any], EzPickle):
    """OGBench's Powderworld: an action chooses an element, the next x, the next y; then a step runs and a block is painted.

    Observations are uint8 [H, W, 6]: the world's picture and the action frame. Actions are integers below
    ``action_space.n``. The reward is 1 while the world matches the goal, and 0 otherwise.

    Args:
        level: name of a shipped level, path of a level's file, a `Level`, or a `LevelProgram` to share.
        options: those of `EnvOptions`.

    Raises:
        CompileError: an unknown level, or a mistake in its file.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}  # noqa: RUF012 as Gymnasium declares it

    def __init__(self, level: str | Path | Level | LevelProgram, **options: Any):
        EzPickle.__init__(self, level, **options)
        self._show(level, 1, EnvOptions(**options))
        self.observation_space, self.action_space = self._space, self._actions
        self.task_infos = [
            {"task_name": task.name, "action_seq": list(task.actions), "tol": task.tolerance}
            for task in self.level.tasks
        ]
        self.cur_task_id: int | None = None
        """The task of the episode, from 1; None before the first, and for a task passed as `task_info`."""
        self.cur_task_info: dict[str, Any] | None = None

    @property
    def num_tasks(self) -> int:
        """The number of tasks of the level."""
        return len(self.task_infos)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: a new seed, of which this is the first episode. By default, the next episode of the current seed
                begins.
            options: ``task_id``, from 1; or ``task_info``, with ``action_seq``, a list of (element, x, y), and ``tol``;
                by default, a task is drawn. ``render_goal``: adds ``goal_rendered``, uint8 [height, width, 3].

        Returns:
            The observation, and infos: ``goal``, uint8 [H, W, 6], the goal as an observation. No infos in data
            collection.

        Raises:
            KeyError: an unknown option.
            TypeError: an option has the wrong type.
            ValueError: the level has no such task.
        """
        settings = dict(options or {})
        check_options(settings, OPTIONS)
        self.episodes.begin(np.zeros(1, dtype=np.int64), [self._task(settings)], seeds_of(seed, 1))
        super().reset(seed=None if seed is None else int(seed))
        if self.episodes.mode != "task":
            return self._observations()[0], {}
        number = int(self.episodes.task_number[0])
        self.cur_task_id = number or None
        self.cur_task_info = self.task_infos[number - 1] if number else dict(settings["task_info"])
        info = {"goal": array(self.episodes.goals()[0])}
        if settings.get("render_goal"):
            info["goal_rendered"] = self._options.picture(info["goal"])
        return self._observations()[0], info

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Make one of the three choices of an action. An invalid choice is replaced by a random valid one.

        Returns:
            The observation, the reward (1.0 or 0.0), terminated, truncated (always False), and infos: ``success``, 1.0
            while the world matches the goal.
        """
        success = bool(self.episodes.step(np.array([action], dtype=np.int64).reshape(1))[0])
        info = {"success": float(success)} if self.episodes.mode == "task" else {}
        return self._observations()[0], float(success), success, False, info

    def render(self) -> Any:
        """Draw the world: uint8 [height, width, 3]."""
        return self._pictures()[0]

    # For scripts that choose whole actions

    def sample_semantic_action(self) -> tuple[str, int, int]:
        """Draw a uniformly random whole action from the seed, the episode and its step: the element's name, x, y."""
        at = self.episodes
        key = (at.seeds, at.episode.clip(0), at.elapsed)
        drawn = [float(keyed(key, f"{what} sample", 1)[0, 0]) for what in FIRST]
        element, x, y = (int(number * self.level.choices(stage)) for stage, number in enumerate(drawn))
        return self.level.elements[element], x, y

    def semantic_action_to_action(self, elem_name: str, x: int, y: int) -> int:
        """Return the part of a whole action that `step` takes at the current stage."""
        return (self.level.elements.index(str(elem_name)), x, y)[self.episodes.stage[0]]

    def sample_action(self) -> int:
        """Draw a uniformly random valid action for the current stage."""
        return self.semantic_action_to_action(*self.sample_semantic_action())


class PowderworldVectorEnv(_Face, VectorEnv[Any, Any, Any]):
    """Many worlds of a level at once. Environment i plays the episodes of a `PowderworldEnv` with the seed `seed` + i.

    Args:
        level: as in `PowderworldEnv`.
        num_envs: the number of worlds, B.
        max_episode_steps: truncate episodes; by default, at the level's number.
        autoreset_mode: one of Gymnasium's, or its name.
        options: those of `EnvOptions`.

    Raises:
        CompileError: an unknown level, or a mistake in its file.
        ValueError: another argument is wrong.
    """

    def __init__(
        self,
        level: str | Path | Level | LevelProgram,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Any,
    ):
        self._show(level, num_envs, EnvOptions(**options))
        self.num_envs, self.autoreset_mode = num_envs, mode_of(autoreset_mode)
        self.max_episode_steps = max_episode_steps or self.level.steps
        self.metadata = PowderworldEnv.metadata | {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = self._space, self._actions
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._over = np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin all episodes, or those of a mask.

        Args:
            seed: an integer s gives environment i the seed s + i; a list has a seed or None for each.
            options: ``task_id``: a number from 1, or one for each environment; ``task_info``: as in `PowderworldEnv`.
                They apply only to these episodes; later ones draw a task. ``reset_mask``: bool [B].

        Returns:
            Observations uint8 [B, H, W, 6]; infos: ``goal``, of the same shape, and ``task_id``, int64 [B].

        Raises:
            KeyError: an unknown option. After an error, nothing has changed.
            TypeError: a seed or an option has the wrong type.
            ValueError: a seed or an option is out of range, or has the wrong length.
        """
        settings = dict(options or {})
        check_options(settings, BATCH_OPTIONS)
        begun, cpu = self.episodes.world is not None, torch.device("cpu")
        mask = reset_mask(settings.get("reset_mask"), self.num_envs, begun, cpu).numpy()
        tasks, seeds = self._tasks(settings), seeds_of(seed, self.num_envs)
        if isinstance(seed, int):
            super().reset(seed=seed)
        which = np.flatnonzero(mask)
        self.episodes.begin(which, [tasks[at] for at in which], [seeds[at] for at in which])
        self._over[mask] = False
        return self._observations(), self._begun(mask)

    def _tasks(self, options: Mapping[str, Any]) -> list[int | GoalTask | None]:
        ids = np.asarray(options.get("task_id"))
        if ids.ndim != 1:
            return [self._task(options)] * self.num_envs
        if len(ids) != self.num_envs:
            raise ValueError(f"task_id has {len(ids)} numbers for {self.num_envs} environments")
        return [self._task({**options, "task_id": number}) for number in ids.tolist()]

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Make one choice in every episode: integers [B]. Invalid choices are replaced by random valid ones.

        Returns:
            Observations uint8 [B, H, W, 6]; reward float64 [B]; terminated and truncated, bool [B]; infos: ``success``,
            float64 [B]; where an episode began, its ``goal`` and ``task_id``, as in `reset`; under SAME_STEP
            ``final_obs`` and ``final_info`` too.

        Raises:
            ResetNeeded: before the first reset, or under DISABLED in an episode that has ended.
            ValueError: actions of another type or shape.
        """
        choices = np.asarray(actions)
        if choices.shape != (self.num_envs,) or choices.dtype.kind not in "iu":
            raise ValueError(
                f"actions must be integers [{self.num_envs}], found {choices.dtype} {list(choices.shape)}"
            )
        waiting = self._over.copy()
        if self.autoreset_mode is AutoresetMode.DISABLED:
            check_going(torch.from_numpy(waiting))
        success = self.episodes.step(choices.astype(np.int64), ~waiting) & ~waiting
        truncated = (self.episodes.elapsed >= self.max_episode_steps) & ~success & ~waiting
        ended = success | truncated
        info: dict[str, Any] = {}
        if self.episodes.mode == "task":
            info = {"success": success.astype(np.float64), "_success": ~waiting}
        begins = waiting
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            begins = ended
            if ended.any():
                info["final_obs"] = objects(self._observations()[ended], ended)
                info["_final_obs"] = ended.copy()
                info["final_info"] = {
                    name: np.copy(value) for name, value in info.items() if "obs" not in name
                }
                info["_final_info"] = ended.copy()
        else:
            self._over = ended
        if begins.any():
            which = np.flatnonzero(begins)
            self.episodes.begin(which, [None] * len(which))
            info |= self._begun(begins)
        return self._observations(), success.astype(np.float64), success, truncated, info

    def _begun(self, mask: NDArray[np.bool_]) -> dict[str, Any]:
        """Return the infos of the episodes that begin where `mask` is set."""
        if self.episodes.mode != "task":
            return {}
        goals = array(self.episodes.goals())
        return {
            "goal": goals,
            "_goal": mask.copy(),
            "task_id": self.episodes.task_number.copy(),
            "_task_id": mask.copy(),
        }

    def render(self) -> tuple[Any, ...] | None:
        """Draw each world: uint8 [height, width, 3]; None without `render_mode`."""
        return None if self.render_mode is None else self._pictures()
