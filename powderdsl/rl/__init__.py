"""Training agents on tasks: PPO of Stable-Baselines3's, with runs that outlive a kill, and what comes after.

`train` makes a run; `evaluate` compares its policy with others; `load_policy` gives the policy for use with tensors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from powderdsl.rl.config import TrainConfig, preset
from powderdsl.system.packages import importing

if TYPE_CHECKING:
    from powderdsl.rl.evaluation import evaluate
    from powderdsl.rl.policies import load_policy
    from powderdsl.rl.training import train

__all__ = ["TrainConfig", "evaluate", "load_policy", "preset", "train"]

__getattr__, __dir__ = importing(
    "powderdsl.rl", {"evaluation": "evaluate", "policies": "load_policy", "training": "train"}
)
