"""World models with actions: transitions recorded from a task, each a state, an action, and the state after it.

An input is uint8 [B, C + 3, H, W]: the C channels of the observation, and three of what the action does to each cell, as
`tasks.tensors.actions.Hands` does it: the element that it places (`NO_ELEMENT` for none), and the rows and columns of
its speed plus 2 (0 where it does not blow). `ActionChannels` makes of it what networks see.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from powderdsl.datasets.manifest import changed_params, choice_names
from powderdsl.experiments.runs import differences
from powderdsl.system.fingerprint import fingerprint
from powderdsl.system.writing import failure
from powderdsl.tasks.shipped import load_task, shipped_tasks
from powderdsl.tasks.task import BLOW, Task
from powderdsl.tasks.tensors.actions import cells_of
from powderdsl.worldmodel.config import DataConfig, Recorded, TrainConfig
from powderdsl.worldmodel.networks import NO_ELEMENT
from powderdsl.worldmodel.worlds import Pairs

if TYPE_CHECKING:  # datasets need the extra `rl`
    from powderdsl.datasets import Dataset, Transitions
    from powderdsl.datasets.manifest import Recipe

PARTS = (0.8, 0.1, 0.1)
"""Shares of the worlds for training, validation and tests."""


class Recording:
    """A dataset of a task's transitions, ready to learn from. Made by `open_recording`.

    `palette` names the dataset's ids; `rules` are the task's, with these ids. `parts` are the transitions of the
    training, validation and test worlds: the same for every recording of these worlds.
    """

    def __init__(self, dataset: Dataset, name: str, task: Task, palette: tuple[str | None, ...]):
        from powderdsl.datasets import Transitions, split

        self.dataset, self.name, self.task, self.palette = dataset, name, task, palette
        self.rules, self.size = task.ruleset, task.size
        self.all = Transitions(dataset)
        try:
            self.parts: tuple[Transitions, ...] = split(self.all, PARTS)
        except ValueError as error:
            fix, why = "record episodes of more worlds: a hundred are enough", str(error)
            raise failure(
                "PD631", f"{dataset.folder} has too few worlds", notes=(why,), helps=(fix,)
            ) from None

    @cached_property
    def recorded(self) -> Recorded:
        """The facts about this recording that a run's file keeps."""
        agent, recipe = self.task.agent, self.dataset.recipe
        rows = [row.sha256 for row in self.dataset.manifest.shards]
        text = json.dumps([asdict(recipe), rows], sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()
        return Recorded(digest, recipe.channels, agent.steps_per_action, agent.speed)

    def configured(self, config: TrainConfig) -> TrainConfig:
        """A configuration changed to train on this dataset. Whether it uses recorded actions stays."""
        recipe = self.dataset.recipe
        data = DataConfig(
            task=self.name,
            split=recipe.split,
            knobs=dict(recipe.knobs),
            params=changed_params(recipe, load_task(self.name)),
            steps=self.task.agent.steps_per_action,
        )
        slots = (*self.palette, *[None] * (config.slots - len(self.palette)))
        actions = config.recorded is None or config.recorded.actions
        return replace(config, data=data, palette=slots, recorded=replace(self.recorded, actions=actions))

    def eligible(self, rows: Transitions) -> Tensor:
        """The numbers of transitions of `steps_per_action` steps, int64 [n]: a last action may have free steps."""
        length = torch.from_numpy(rows.episodes.length)
        last = torch.zeros(len(rows), dtype=torch.bool)
        if self.task.agent.free_steps:
            last[length.cumsum(0) - 1] = length == self.task.agent.actions
        return (~last).nonzero()[:, 0]

    def pairs(self, rows: Transitions, numbers: Tensor, device: str | torch.device = "cpu") -> Pairs:
        """Inputs and next ids, uint8 [B, C + 3, H, W] and [B, H, W], of transitions by number, int64 [B]."""
        transitions = rows[numbers]
        inputs = torch.cat([transitions.observation, self.painted(transitions.action)], 1)
        return inputs.to(device), transitions.next_observation[:, 0].to(device)

    def painted(self, actions: Tensor) -> Tensor:
        """Return the channels that show actions, integers [B, 5], cell by cell: uint8 [B, 3, H, W]."""
        agent, actions = self.task.agent, actions.long()
        block = cells_of(agent, self.size, actions[:, 1], actions[:, 0])
        choice = torch.tensor(agent.choices)[actions[:, 2]][:, None, None]
        placed = torch.where(block & (choice >= 0), choice, NO_ELEMENT)
        blown = block & (choice == BLOW)
        speed = [torch.where(blown, actions[:, at, None, None] + 1, 0) for at in (4, 3)]
        return torch.stack([placed, *speed], 1).to(torch.uint8)

    def spread(self, rows: Transitions, most: int, device: str | torch.device = "cpu") -> list[Pairs]:
        """Up to `most` transitions, evenly spread, in batches."""
        numbers = self.eligible(rows)
        numbers = numbers[torch.arange(min(most, len(numbers))) * len(numbers) // min(most, len(numbers))]
        return [self.pairs(rows, some, device) for some in numbers.split(64)]

    def batch(self, iteration: int, count: int, *, seed: int, device: str | torch.device) -> Pairs:
        """A batch of the training worlds' transitions, all equally likely, which seed and iteration decide."""
        from powderdsl.datasets.dataset import drawn

        numbers = self.training
        chosen = torch.from_numpy(drawn(seed % (1 << 62), iteration, count, len(numbers)))
        return self.pairs(self.parts[0], numbers[chosen], device)

    @cached_property
    def training(self) -> Tensor:
        """The numbers of the eligible transitions of training worlds."""
        return self.eligible(self.parts[0])


def open_recording(folder: str | Path, task: str | None = None) -> Recording:
    """The recording in a dataset's folder.

    Args:
        task: the file of the task that was played, unless it is a shipped one.

    Raises:
        CompileError: PD630 for a folder that is not a dataset, or is damaged; PD631 if it was recorded from another task,
            or has too few worlds; what `load_task` raises.
    """
    from powderdsl.datasets import Dataset

    dataset = Dataset.open(folder)
    recipe = dataset.recipe
    if task is None and recipe.task not in shipped_tasks():
        # A name out of the manifest must not lead to a file.
        message = f"{folder} was recorded from the task `{recipe.task}`, which is not a shipped one"
        raise failure("PD631", message, helps=("give its file, too",))
    name = task or recipe.task
    ids = {int(number): element for number, element in recipe.palette.items()}
    palette = tuple(ids.get(number) for number in range(max(ids) + 1))
    params = changed_params(recipe, load_task(name))
    played = load_task(name, knobs=recipe.knobs, params=params, palette=palette)
    notes = _differences(recipe, played)
    if notes:
        raise failure("PD631", f"{folder} does not fit the task {played.name}", notes=notes)
    return Recording(dataset, name, played, palette)


def _differences(recipe: Recipe, task: Task) -> tuple[str, ...]:
    """The differences between a recipe and a task, none if the task was recorded with it."""
    there = {"size": recipe.shape[1:], "actions": recipe.action_nvec, "choices": recipe.choices}
    here = {"size": task.size, "actions": task.agent.action_nvec, "choices": choice_names(task)}
    if changes := differences(there, here):
        return changes
    same = recipe.task_fingerprint == fingerprint(task)
    return () if same else ("the task, its knobs or its rules have changed since, or it had more packs",)
