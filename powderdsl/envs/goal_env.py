"""Goal-conditioned use, as Gymnasium-Robotics and hindsight replay (HER) expect it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from powderdsl.envs.gym import PowderEnv
from powderdsl.envs.tensor_env import TensorEnv

Array = NDArray[Any]


class GoalEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Asks for values of what a task measures, such as a count in a region or the match with a target.

    Observations are a dict: ``observation``; ``achieved_goal``, float32 [n], the n measures that the task's reward and
    `end` are made of, in the order they first stand there; ``desired_goal``, float32 [n], what they shall be. The
    reward is 0 where each is as near as its tolerance, else −1. Episodes last as long as the task's.

    Args:
        env: the environment of one world, a `PowderEnv`; perhaps in wrappers, as `gymnasium.make` returns it.
        low, high: [n], between which goals are drawn, once an episode, by the environment's seed.
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
        self.observation_space = spaces.Dict(
            {"observation": env.observation_space, "achieved_goal": box, "desired_goal": box}
        )

    @property
    def _tensors(self) -> TensorEnv:
        return cast(PowderEnv, self.env.unwrapped).tensors

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Begin an episode. ``options["goal"]``, [n], takes the place of a drawn goal."""
        rest = dict(options or {})
        given = rest.pop("goal", None)
        if given is not None and np.shape(given) != self.low.shape:
            raise ValueError(f"a goal has the shape {list(self.low.shape)}, found {list(np.shape(given))}")
        observed, info = self.env.reset(seed=seed, options=rest)
        drawn = self.env.unwrapped.np_random.uniform(self.low, self.high)
        self.goal = np.asarray(drawn if given is None else given, np.float32)
        return self._with_goals(observed), info

    def step(self, action: Any) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """One action; ``is_success`` in the infos says whether the goal is met, ``task_reward`` what the task gives."""
        observed, task_reward, terminated, truncated, info = self.env.step(action)
        found = self._with_goals(observed)
        reward = float(self.compute_reward(found["achieved_goal"], found["desired_goal"], info))
        info |= {"is_success": reward == 0, "task_reward": task_reward}
        return found, reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Any:
        """0 or −1, float32 [...], of goals [..., n]."""
        near = np.abs(np.asarray(achieved_goal) - np.asarray(desired_goal)) <= self.tolerance
        return near.all(-1).astype(np.float32) - 1

    def _with_goals(self, observed: Any) -> dict[str, Array]:
        tensors = self._tensors
        assert tensors.episodes is not None  # reset and step have begun them
        measured = tensors.program.measured(tensors.episodes, tensors.params)
        achieved = measured[0].cpu().numpy().astype(np.float32)
        return {"observation": observed, "achieved_goal": achieved, "desired_goal": self.goal.copy()}
