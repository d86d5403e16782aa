"""Tasks as environments for reinforcement learning. Importing this registers the shipped ones with Gymnasium.

`TensorEnv` takes and returns tensors; `PowderVectorEnv` and `PowderEnv` wrap it for Gymnasium, and
`powderdsl.envs.sb3.PowderVecEnv` for Stable-Baselines3. Registering needs no torch: names are imported lazily.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import gymnasium

from powderdsl.system.packages import importing
from powderdsl.tasks.shipped import shipped_tasks

if TYPE_CHECKING:
    from powderdsl.envs.compiled import CompiledEnv
    from powderdsl.envs.gym import GoalEnv, PowderEnv, PowderVectorEnv
    from powderdsl.envs.tensor_env import TensorEnv

__all__ = ["CompiledEnv", "GoalEnv", "PowderEnv", "PowderVectorEnv", "TensorEnv"]


def env_id(task: str) -> str:
    """The id of a shipped task: ``some-task`` becomes ``powderdsl/SomeTask-v0``."""
    return f"powderdsl/{''.join(part.capitalize() for part in task.split('-'))}-v0"


for _task in shipped_tasks():
    if env_id(_task) not in gymnasium.registry:
        # Environments end episodes themselves and fill in `spec.max_episode_steps`. Without a limit here, `make` adds
        # no `TimeLimit`, and the last action of a task may terminate an episode without truncating it.
        gymnasium.register(
            env_id(_task),
            entry_point="powderdsl.envs.gym:PowderEnv",
            vector_entry_point="powderdsl.envs.gym:PowderVectorEnv",
            kwargs={"task": _task},
        )


__getattr__, __dir__ = importing(
    "powderdsl.envs",
    {"gym": "GoalEnv PowderEnv PowderVectorEnv", "compiled": "CompiledEnv", "tensor_env": "TensorEnv"},
)
