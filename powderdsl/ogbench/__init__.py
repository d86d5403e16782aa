"""OGBench's Powderworld on powderdsl: the same environments and datasets, with many worlds at once.

`make_env_and_datasets` replaces `ogbench.make_env_and_datasets`. Importing this registers
``powderworld-easy-v0``, ``powderworld-medium-v0`` and ``powderworld-hard-v0`` with Gymnasium, unless OGBench itself has;
``powderdsl/powderworld-easy-v0`` and so on are always ours.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import gymnasium

from powderdsl.ogbench.levels import find_level, load_dataset, make_env_and_datasets, shipped_levels
from powderdsl.system.packages import importing

if TYPE_CHECKING:
    from powderdsl.ogbench.env import PowderworldEnv, PowderworldVectorEnv

__all__ = ["PowderworldEnv", "PowderworldVectorEnv", "load_dataset", "make_env_and_datasets"]


def _register() -> None:
    for name in shipped_levels():
        for env_id in (f"powderdsl/powderworld-{name}-v0", f"powderworld-{name}-v0"):
            if env_id not in gymnasium.registry:
                gymnasium.register(
                    env_id,
                    entry_point="powderdsl.ogbench.env:PowderworldEnv",
                    vector_entry_point="powderdsl.ogbench.env:PowderworldVectorEnv",
                    max_episode_steps=find_level(name).steps,
                    kwargs={"level": name},
                )


_register()

__getattr__, __dir__ = importing("powderdsl.ogbench", {"env": "PowderworldEnv PowderworldVectorEnv"})
