"""Tasks that take no time: what training is tested on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from powderdsl.rl import TrainConfig, preset

DIG = """
task: dig
rules: core+sand+wind
size: [16, 16]
fill: empty
knobs: {size: {default: 2, range: 1..3, about: half the side of the square}}
generate:
  - square sand at (4..11, 4..11) half size
  - frame wall
agent: {may: [empty, blow], speed: 5, bins: 4, brush: 4, actions: 4, steps_per_action: 2, free_steps: 3}
reward: {each: change(0 - count(sand)) / 10}
end: {success: count(sand) < 1}
splits:
  test:
    generate:
      - square sand at (8, 8) half size
      - frame wall
"""

PLACE = """
task: place
rules: core+sand
size: [8, 8]
fill: empty
generate:
  - scatter wall chance 10%
agent: {may: [sand, nothing], bins: 2, brush: 4, actions: 2, steps_per_action: 1}
reward: {each: placed}
"""
"""One of the two choices is always right."""


def write_task(folder: Path, text: str = DIG) -> Path:
    """The file of a task, in a folder."""
    path = folder / "task.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def quick(task: Path, **changes: Any) -> TrainConfig:
    """Settings of a run of a second: three rollouts of 32 interactions, each saved."""
    usual: dict[str, Any] = {
        "envs": 4,
        "rollout": 8,
        "batch": 16,
        "epochs": 2,
        "features": 8,
        "steps": 96,
        "backend": "wasm",
        "checkpoint_minutes": 0.0,
    }
    return preset("small", str(task), **{**usual, **changes})
