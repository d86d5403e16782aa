"""Many worlds of a level in one batch, for Gymnasium's vector interface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from powderdsl.envs.gym import objects
from powderdsl.envs.tensor_env import check_cells, mode_of
from powderdsl.ogbench.draws import Draws
from powderdsl.ogbench.env import enlarged, made_program, seed_number, spaces_of
from powderdsl.ogbench.episodes import Episodes, task_of
from powderdsl.ogbench.levels import GoalTask, Level
from powderdsl.ogbench.program import LevelProgram

Array = NDArray[Any]

OPTIONS = ("task_id", "task_info", "reset_mask")


class PowderworldVectorEnv(VectorEnv[Any, Any, Any]):
    """Environment i plays the same episodes as a `PowderworldEnv` with the seed `seed` + i, whatever the others do.

    Args:
        level, mode, randomness, render_mode, width, height, backend, device, threads: as in `PowderworldEnv`.
        num_envs: worlds at once.
        seed: s gives environment i the seed s + i.
        max_episode_steps: truncates episodes; the level's number by default.
        autoreset_mode: one of Gymnasium's, or its name.
    """

    def __init__(
        self,
        level: str | Path | Level | LevelProgram,
        num_envs: int = 1,
        *,
        mode: str = "task",
        seed: int = 0,
        randomness: str | Draws = "counter",
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        width: int = 192,
        height: int = 192,
        backend: str = "auto",
        device: str = "cpu",
        threads: int = 1,
    ):
        if not hasattr(num_envs, "__index__") or num_envs < 1:
            raise ValueError(f"num_envs must be an integer from 1, found {num_envs!r}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is None or rgb_array; found {render_mode!r}")
        program = made_program(level, randomness, backend, device, threads)
        self.level = program.level
        check_cells(num_envs, (self.level.side, self.level.side))
        first = seed_number(seed)
        seeds = [first + number for number in range(num_envs)]
        self.episodes = Episodes(program, seeds, randomness=randomness, mode=mode)
        """The same episodes on tensors."""
        self.num_envs, self.autoreset_mode = num_envs, mode_of(autoreset_mode)
        self.max_episode_steps = max_episode_steps or self.level.steps
        self.render_mode, self._size = render_mode, (height, width)
        self.metadata = {
            "autoreset_mode": self.autoreset_mode,
            "render_modes": ["rgb_array"],
            "render_fps": 15,
        }
        self.single_observation_space, self.single_action_space = spaces_of(self.level)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._over = np.zeros(num_envs, dtype=bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Begin all episodes, or those of a mask.

        Args:
            seed: s gives environment i the seed s + i; a list gives each its own, or None.
            options: ``task_id``: a number from 1, or one for each environment; ``task_info``: as in `PowderworldEnv`.
                They hold for these episodes; later ones draw a task. ``reset_mask``: bool [B].

        Returns:
            observations uint8 [B, H, W, 6]; infos: ``goal``, of the same shape, and ``task_id``, int64 [B].

        Raises:
            KeyError, TypeError, ValueError: something is wrong with a seed or an option. Nothing has changed then.
        """
        given = dict(options or {})
        for name in given:
            if name not in OPTIONS:
                raise KeyError(f"no option `{name}`: there are {', '.join(OPTIONS)}")
        mask = np.asarray(given.get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset_mask must be bool [{self.num_envs}], True somewhere")
        if self.episodes.world is None and not mask.all():
            raise ResetNeeded("the first reset begins all episodes: reset_mask must be True everywhere")
        tasks = self._tasks(given)
        which = np.flatnonzero(mask)
        self._seed(seed, mask)
        self.episodes.begin(which, [tasks[at] for at in which])
        self._over[mask] = False
        return self._observations(), self._begun(mask)

    def _tasks(self, given: Mapping[str, Any]) -> list[int | GoalTask | None]:
        ids = np.asarray(given.get("task_id"))
        if self.episodes.mode != "task" or ids.ndim != 1:
            return [task_of(self.level, given) if self.episodes.mode == "task" else None] * self.num_envs
        if len(ids) != self.num_envs:
            raise ValueError(f"task_id has {len(ids)} numbers for {self.num_envs} environments")
        return [task_of(self.level, {**given, "task_id": one}) for one in ids.tolist()]

    def _seed(self, seed: int | Sequence[int | None] | None, mask: NDArray[np.bool_]) -> None:
        if seed is None:
            return
        if hasattr(seed, "__index__"):
            first = seed_number(seed)
            seeds: list[int | None] = [first + number for number in range(self.num_envs)]
            super().reset(seed=first)
        else:
            seeds = [None if one is None else seed_number(one) for one in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed has {len(seeds)} numbers for {self.num_envs} environments")
        which = np.array([at for at, one in enumerate(seeds) if one is not None and mask[at]], dtype=np.int64)
        self.episodes.seed(which, np.array([seeds[at] for at in which], dtype=np.int64))

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One choice in every episode: integers [B]. Those that are not valid are replaced by random valid ones.

        Returns:
            observations uint8 [B, H, W, 6]; reward float64 [B]; terminated and truncated, bool [B]; infos: ``success``,
            float64 [B]; where an episode began, its ``goal`` and ``task_id``, as `reset` gives them; under SAME_STEP
            ``final_obs`` and ``final_info`` too.

        Raises:
            ResetNeeded: before the first reset, or under DISABLED in an episode that has ended. TypeError, ValueError:
            actions of another type or shape.
        """
        given = np.asarray(actions)
        if given.shape != (self.num_envs,) or given.dtype.kind not in "iu":
            raise ValueError(
                f"actions must be integers [{self.num_envs}], found {given.dtype} {list(given.shape)}"
            )
        if self.episodes.world is None:
            raise ResetNeeded("reset the environment before its first step")
        waiting = self._over.copy()
        if self.autoreset_mode is AutoresetMode.DISABLED and waiting.any():
            over = np.flatnonzero(waiting).tolist()
            raise ResetNeeded(
                f"the episodes of environments {over[:8]} are over: reset them with a reset_mask"
            )
        success = self.episodes.step(given.astype(np.int64), ~waiting) & ~waiting
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
        """What is known of episodes that begin where `mask` is set."""
        if self.episodes.mode != "task":
            return {}
        goals: Array = self.episodes.goals().cpu().numpy()
        return {
            "goal": goals,
            "_goal": mask.copy(),
            "task_id": self.episodes.task_number.copy(),
            "_task_id": mask.copy(),
        }

    def _observations(self) -> Array:
        found: Array = self.episodes.observations().cpu().numpy()
        return found

    def render(self) -> tuple[Any, ...] | None:
        """Each world's picture, uint8 [height, width, 3]."""
        if self.render_mode is None:
            return None
        return tuple(enlarged(one[..., :3], *self._size) for one in self._observations())
