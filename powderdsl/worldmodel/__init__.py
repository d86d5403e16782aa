"""World models: networks that learn to predict a world some steps ahead (Frans & Isola 2023, section 4).

`worlds` generates the data, or reads transitions with actions. `networks` has the paper's network; `training`,
`evaluation` and `scores` take that network or any callable from ids uint8 [B, H, W] to logits [B, slots, H, W].
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from powderdsl.system.packages import importing

if TYPE_CHECKING:
    from powderdsl.worldmodel.config import DataConfig, Machine, TrainConfig
    from powderdsl.worldmodel.evaluation import evaluate, evaluate_recording
    from powderdsl.worldmodel.networks import UNet, custom_network
    from powderdsl.worldmodel.scores import score
    from powderdsl.worldmodel.training import Replay, finetuned, load_trained, train
    from powderdsl.worldmodel.worlds import TaskWorlds, open_recording, pairs_of, unseen_seeds

__all__ = [
    "DataConfig",
    "Machine",
    "Replay",
    "TaskWorlds",
    "TrainConfig",
    "UNet",
    "custom_network",
    "evaluate",
    "evaluate_recording",
    "finetuned",
    "load_trained",
    "open_recording",
    "pairs_of",
    "score",
    "train",
    "unseen_seeds",
]

__getattr__, __dir__ = importing(
    "powderdsl.worldmodel",
    {
        "config": "DataConfig Machine TrainConfig",
        "evaluation": "evaluate evaluate_recording",
        "networks": "UNet custom_network",
        "scores": "score",
        "training": "Replay finetuned load_trained train",
        "worlds": "TaskWorlds open_recording pairs_of unseen_seeds",
    },
)
