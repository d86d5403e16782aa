"""Running tasks: batches of episodes on tensors. Actions in, rewards out, on the simulator's device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from powderdsl.simulator import Simulator, World
from powderdsl.tasks.task import Task


@dataclass(frozen=True)
class Episodes:
    """A batch of episodes. `seed` says which worlds they started as; `failed` whether an `end:` condition failed them.

    `acted` is how many actions each has had. `regions` are bool [B, H, W] or [1, H, W] by name, `targets` uint8
    [B, H, W] by name (255 where there is none), `start` and `before` float64 [B, n]: what rewards remember.
    """

    world: World
    seed: Tensor
    acted: Tensor
    failed: Tensor
    regions: Mapping[str, Tensor]
    targets: Mapping[str, Tensor]
    start: Tensor
    before: Tensor


def load_task(
    name_or_path: str | Path,
    *,
    knobs: Mapping[str, int] | None = None,
    params: Mapping[str, Any] | None = None,
) -> Task:
    """A shipped task by name, or a file. Raises CompileError with everything that is wrong."""
    raise NotImplementedError


class TaskProgram:
    """A task made executable for one split. Made by `compile_task`."""

    task: Task
    split: str
    simulator: Simulator
    action_nvec: tuple[int, int, int, int, int]
    """How many values x, y, choice, vx and vy have."""

    def start(self, seeds: Tensor) -> Episodes:
        """New episodes of the worlds `seeds`, int64 [B]."""
        raise NotImplementedError

    def restart(self, episodes: Episodes, mask: Tensor, seeds: Tensor, *, reuse: bool = False) -> Episodes:
        """The episodes where `mask`, bool [B], is set, made anew as worlds `seeds`, int64 [B]; others unchanged."""
        raise NotImplementedError

    def act(
        self,
        episodes: Episodes,
        actions: Tensor,
        *,
        reuse: bool = False,
        params: Mapping[str, Any] | None = None,
    ) -> tuple[Episodes, Tensor, Tensor, Tensor]:
        """One action of each episode, int64 [B, 5], and the steps after it.

        Returns the episodes, reward float32 [B], success bool [B] (an `end:` condition holds now), over bool [B]
        (success, failure, or all actions used up; free steps have run then).
        """
        raise NotImplementedError


def compile_task(
    task: Task | str,
    *,
    split: str = "train",
    backend: str = "auto",
    device: str | torch.device = "cpu",
    threads: int = 1,
) -> TaskProgram:
    """A program for one split of a task. Raises CompileError: PD701 for backends, an unknown split."""
    raise NotImplementedError


def check_actions(program: TaskProgram, actions: Any) -> Tensor:
    """Actions from outside as int64 [B, 5] on the program's device.

    Raises:
        ValueError: a wrong shape, or a number out of range, with its index and the bounds. TypeError: no integers.
    """
    raise NotImplementedError
