"""One world of a level as OGBench's environment: same spaces, options, infos and success."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from gymnasium.utils import EzPickle
from numpy.typing import NDArray
from torch import Tensor

from powderdsl.ogbench.draws import FIRST_ELEMENT, FIRST_X, FIRST_Y, Draws, keyed
from powderdsl.ogbench.episodes import Episodes, task_of
from powderdsl.ogbench.levels import Level, find_level
from powderdsl.ogbench.program import LevelProgram

Array = NDArray[Any]

OPTIONS = ("task_id", "task_info", "render_goal")

MAX_SEED = (1 << 62) - 1


def made_program(
    level: str | Path | Level | LevelProgram, randomness: str | Draws, backend: str, device: str, threads: int
) -> LevelProgram:
    """The program of a level; environments of one process share it."""
    if isinstance(level, LevelProgram):
        return level
    return _program(find_level(level), randomness != "counter", backend, str(device), threads)


@lru_cache(maxsize=16)
def _program(level: Level, as_ogbench: bool, backend: str, device: str, threads: int) -> LevelProgram:
    return LevelProgram(level, backend=backend, device=device, threads=threads, as_ogbench=as_ogbench)


def spaces_of(level: Level) -> tuple[Box, Discrete[Any]]:
    """The spaces of one world's observations and actions."""
    return Box(0, 255, (level.side, level.side, 6), np.uint8), Discrete(level.actions)


def seed_number(seed: Any) -> int:
    """A seed. Raises TypeError, ValueError."""
    if not hasattr(seed, "__index__") or isinstance(seed, bool):
        raise TypeError(f"a seed is an integer, found {seed!r}")
    if not 0 <= int(seed) <= MAX_SEED:
        raise ValueError(f"a seed lies in 0..2⁶²−1, found {seed}")
    return int(seed)


def enlarged(picture: Array, height: int, width: int) -> Array:
    """A picture uint8 [H, W, 3] in another size, by its nearest pixels."""
    rows = np.arange(height) * picture.shape[0] // height
    columns = np.arange(width) * picture.shape[1] // width
    return np.ascontiguousarray(picture[rows][:, columns])


class PowderworldEnv(gymnasium.Env[Array, Any], EzPickle):
    """OGBench's Powderworld: an action chooses an element, the next x, the next y; then a step runs and a block is painted.

    Observations are uint8 [H, W, 6]: the world's picture and the action frame. ``info["goal"]`` of `reset` is the goal as
    an observation, ``info["success"]`` of `step` is 1.0 while the world matches it.

    Args:
        level: a shipped level by name, a level's file, a `Level`, or its program to share.
        mode: ``task``, or ``data_collection``: no goals and no rewards.
        seed: decides goals and episodes, until `reset` is given another one.
        randomness: ``counter``: a goal depends on the seed and its task alone, and episode n of a seed is the same
            anywhere. ``ogbench``: draws from a `numpy.random.RandomState` of the environment's own, in OGBench's order:
            `reset` with a seed plays what OGBench plays after `numpy.random.seed` with it.
        render_mode: None or ``rgb_array``. width, height: of what `render` returns.
        backend, device, threads: those of `powderdsl.compile`; ``ogbench`` runs on ``torch``.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}  # noqa: RUF012 as Gymnasium declares it

    def __init__(
        self,
        level: str | Path | Level | LevelProgram,
        *,
        mode: str = "task",
        seed: int = 0,
        randomness: str | Draws = "counter",
        render_mode: str | None = None,
        width: int = 192,
        height: int = 192,
        backend: str = "auto",
        device: str = "cpu",
        threads: int = 1,
    ):
        how = {"mode": mode, "seed": seed, "randomness": randomness, "render_mode": render_mode}
        where = {"backend": backend, "device": device, "threads": threads}
        EzPickle.__init__(self, level, width=width, height=height, **how, **where)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode is None or rgb_array; found {render_mode!r}")
        program = made_program(level, randomness, backend, device, threads)
        self.episodes = Episodes(program, [seed_number(seed)], randomness=randomness, mode=mode)
        """The same episode in a batch of one."""
        self.level = program.level
        self.render_mode, self._size = render_mode, (height, width)
        self.observation_space, self.action_space = spaces_of(self.level)
        self.task_infos = [
            {"task_name": task.name, "action_seq": list(task.actions), "tol": task.tolerance}
            for task in self.level.tasks
        ]
        self.cur_task_id: int | None = None
        """The task of the episode, from 1; None before the first, and for a task that was given as `task_info`."""
        self.cur_task_info: dict[str, Any] | None = None

    @property
    def num_tasks(self) -> int:
        """How many tasks the level has."""
        return len(self.task_infos)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: a new seed, of which this is the first episode. Without one, the next episode of the old seed begins.
            options: ``task_id``, from 1; or ``task_info``, with ``action_seq``, a list of (element, x, y), and ``tol``;
                without them a task is drawn. ``render_goal``: adds ``goal_rendered``, uint8 [height, width, 3].

        Returns:
            the observation, and infos: ``goal``, uint8 [H, W, 6]. None in data collection.

        Raises:
            KeyError, TypeError, ValueError: an unknown option, or one that the level does not have.
        """
        given = dict(options or {})
        for name in given:
            if name not in OPTIONS:
                raise KeyError(f"no option `{name}`: there are {', '.join(OPTIONS)}")
        task = task_of(self.level, given) if self.episodes.mode == "task" else None
        here = np.zeros(1, dtype=np.int64)
        if seed is not None:
            number = seed_number(seed)
            super().reset(seed=number)
            self.episodes.seed(here, np.array([number]))
        self.episodes.begin(here, [task])
        if self.episodes.mode != "task":
            return self._observation(), {}
        number = int(self.episodes.task_number[0])
        self.cur_task_id = number or None
        self.cur_task_info = self.task_infos[number - 1] if number else dict(given["task_info"])
        info = {"goal": _array(self.episodes.goals()[0])}
        if given.get("render_goal"):
            info["goal_rendered"] = enlarged(info["goal"][..., :3], *self._size)
        return self._observation(), info

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One of the three choices of an action. One that is not valid is replaced by a random valid one."""
        if self.episodes.world is None:
            raise ResetNeeded("reset the environment before its first step")
        success = bool(self.episodes.step(np.array([action], dtype=np.int64).reshape(1))[0])
        info = {"success": float(success)} if self.episodes.mode == "task" else {}
        return self._observation(), float(success), success, False, info

    def _observation(self) -> Array:
        return _array(self.episodes.observations()[0])

    def render(self) -> Any:
        """The world's picture, uint8 [height, width, 3]."""
        if self.episodes.world is None:
            raise ResetNeeded("reset the environment before rendering it")
        return enlarged(self._observation()[..., :3], *self._size)

    # For scripts that choose whole actions

    def sample_semantic_action(self) -> tuple[str, int, int]:
        """A whole action, all equally likely: the element's name, x and y. From the seed, the episode and its step."""
        at = self.episodes
        key = (at.seeds, at.episode.clip(0), at.elapsed)
        drawn = [float(keyed(key, f"{what} sample", 1)[0, 0]) for what in (FIRST_ELEMENT, FIRST_X, FIRST_Y)]
        element, x, y = (int(one * self.level.choices(stage)) for stage, one in enumerate(drawn))
        return self.level.elements[element], x, y

    def semantic_action_to_action(self, elem_name: str, x: int, y: int) -> int:
        """What of a whole action is to be given to `step` at the present stage."""
        return (self.level.elements.index(str(elem_name)), x, y)[self.episodes.stage[0]]

    def sample_action(self) -> int:
        """A valid action for the present stage, all equally likely."""
        return self.semantic_action_to_action(*self.sample_semantic_action())


def _array(tensor: Tensor) -> Array:
    found: Array = tensor.cpu().numpy()
    return found
