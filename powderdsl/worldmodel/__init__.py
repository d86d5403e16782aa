"""World models: networks that learn to predict a world some steps on (Frans & Isola 2023, section 4).

`pairs` makes the data, `replay` keeps it, `recordings` are transitions with actions. `unet` is the paper's network;
`training`, `evaluation` and `scores` take that one or any other: a callable from ids uint8 [B, H, W] to logits
[B, slots, H, W].
"""

from powderdsl.worldmodel.config import PRESETS, Machine, TrainConfig
from powderdsl.worldmodel.evaluation import Tested, evaluate, evaluate_recording
from powderdsl.worldmodel.networks import CustomNetwork, custom_network
from powderdsl.worldmodel.pairs import DataConfig, TaskWorlds, Worlds, pairs_of, task_worlds, unseen_seeds
from powderdsl.worldmodel.recordings import Recording, open_recording
from powderdsl.worldmodel.replay import Replay
from powderdsl.worldmodel.scores import Score, frequent, outcomes, score, still
from powderdsl.worldmodel.trained import Trained, finetuned, load_trained
from powderdsl.worldmodel.training import train
from powderdsl.worldmodel.unet import UNet, fresh_unet

__all__ = [
    "PRESETS",
    "CustomNetwork",
    "DataConfig",
    "Machine",
    "Recording",
    "Replay",
    "Score",
    "TaskWorlds",
    "Tested",
    "TrainConfig",
    "Trained",
    "UNet",
    "Worlds",
    "custom_network",
    "evaluate",
    "evaluate_recording",
    "finetuned",
    "frequent",
    "fresh_unet",
    "load_trained",
    "open_recording",
    "outcomes",
    "pairs_of",
    "score",
    "still",
    "task_worlds",
    "train",
    "unseen_seeds",
]
