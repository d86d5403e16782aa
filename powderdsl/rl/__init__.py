"""Training agents on tasks with Stable-Baselines3's PPO, in runs that resume after a kill; evaluation and videos.

`train` creates a run; `evaluate` compares its policy with others; `load_policy` returns the policy for use on tensors.
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
