"""World models: networks that learn to predict a world some steps later (Frans & Isola 2023, section 4).

`worlds` makes the data, `replay` stores it, `recordings` are transitions with actions. `networks` has the paper's network;
`training`, `evaluation` and `scores` take that network or any other: a callable from ids uint8 [B, H, W] to logits
[B, slots, H, W].
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from powderdsl.system.packages import importing

if TYPE_CHECKING:
    from powderdsl.worldmodel.config import DataConfig as DataConfig
    from powderdsl.worldmodel.config import Machine as Machine
    from powderdsl.worldmodel.config import TrainConfig as TrainConfig
    from powderdsl.worldmodel.evaluation import evaluate as evaluate
    from powderdsl.worldmodel.evaluation import evaluate_recording as evaluate_recording
    from powderdsl.worldmodel.networks import UNet as UNet
    from powderdsl.worldmodel.networks import custom_network as custom_network
    from powderdsl.worldmodel.recordings import open_recording as open_recording
    from powderdsl.worldmodel.replay import Replay as Replay
    from powderdsl.worldmodel.scores import score as score
    from powderdsl.worldmodel.training import finetuned as finetuned
    from powderdsl.worldmodel.training import load_trained as load_trained
    from powderdsl.worldmodel.training import train as train
    from powderdsl.worldmodel.worlds import pairs_of as pairs_of
    from powderdsl.worldmodel.worlds import task_worlds as task_worlds
    from powderdsl.worldmodel.worlds import unseen_seeds as unseen_seeds

__getattr__ = importing(
    "powderdsl.worldmodel",
    config="DataConfig Machine TrainConfig",
    replay="Replay",
    networks="UNet custom_network",
    evaluation="evaluate evaluate_recording",
    recordings="open_recording",
    worlds="pairs_of task_worlds unseen_seeds",
    scores="score",
    training="finetuned load_trained train",
)
