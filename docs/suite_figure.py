"""Draws docs/images/suite.png: the expert of each task under generated rules, in three universes that training never shows."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import torch

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from powderdsl.rl.evaluation import film
from powderdsl.tasks.episodes import compile_task
from powderdsl.tasks.players import ExpertPlayer
from powderdsl.tasks.shipped import load_task

TASKS = (
    ("float-or-sink", 0.6),
    ("find-the-solvent", 0.35),
    ("aim-with-the-wind", 0.5),
    ("raise-a-mound", 1.0),
    ("clear-the-field", 0.6),
    ("ferry-the-cargo", 0.6),
)
"""The tasks, and which share of an episode has passed in the picture."""


def main() -> None:
    """Draw the figure."""
    figure, axes = plt.subplots(3, 2, figsize=(9, 6.6))
    for axis, (name, share) in zip(axes.flat, TASKS, strict=True):
        task = load_task(name)
        program = compile_task(task, split="test", backend="wasm")
        _, pictures = film(program, ExpertPlayer(program), torch.arange(3), factor=4)
        frames = list(pictures)
        axis.imshow(frames[round(share * (len(frames) - 1))], interpolation="nearest")
        axis.set_title(f"{name} ({task.family})", fontsize=11)
        axis.axis("off")
        print(name, len(frames), flush=True)
    figure.tight_layout()
    figure.savefig(Path(__file__).with_name("images") / "suite.png", dpi=80)


if __name__ == "__main__":
    main()
