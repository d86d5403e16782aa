"""Gymnasium's registry: every shipped task under ``powderdsl/NameOfTask-v0``. Needs no torch."""

from __future__ import annotations

import gymnasium

from powderdsl.tasks.shipped import shipped_tasks


def env_id(task: str) -> str:
    """The id of a shipped task: ``some-task`` becomes ``powderdsl/SomeTask-v0``."""
    return f"powderdsl/{''.join(part.capitalize() for part in task.split('-'))}-v0"


def register_tasks() -> None:
    """Registers every shipped task that is not registered yet. Episodes end by themselves: no limit is set on them."""
    for task in shipped_tasks():
        if env_id(task) not in gymnasium.registry:
            gymnasium.register(
                env_id(task),
                entry_point="powderdsl.envs.single:PowderEnv",
                vector_entry_point="powderdsl.envs.vector:PowderVectorEnv",
                kwargs={"task": task},
            )
