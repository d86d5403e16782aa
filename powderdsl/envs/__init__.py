"""Tasks as environments for reinforcement learning. Importing this registers the shipped ones with Gymnasium.

`TensorEnv` takes and gives tensors; `PowderVectorEnv` and `PowderEnv` are its faces for Gymnasium, and
`powderdsl.envs.sb3.PowderVecEnv` for Stable-Baselines3.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from powderdsl.envs.register import register_tasks

if TYPE_CHECKING:
    from powderdsl.envs.goal_env import GoalEnv
    from powderdsl.envs.single import PowderEnv
    from powderdsl.envs.tensor_env import TensorEnv
    from powderdsl.envs.vector import PowderVectorEnv

__all__ = ["GoalEnv", "PowderEnv", "PowderVectorEnv", "TensorEnv"]

_HOMES = {
    "GoalEnv": "goal_env",
    "PowderEnv": "single",
    "PowderVectorEnv": "vector",
    "TensorEnv": "tensor_env",
}

register_tasks()


def __getattr__(name: str) -> Any:
    """Public names are imported when first used: registering needs no torch."""
    if name not in _HOMES:
        raise AttributeError(f"module 'powderdsl.envs' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"powderdsl.envs.{_HOMES[name]}"), name)
