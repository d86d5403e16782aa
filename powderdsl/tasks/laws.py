"""A description of worlds' laws: outcomes of small experiments, and the parameters that worlds draw."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations

import torch
from torch import Tensor

from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import compile as compile_ruleset
from powderdsl.tasks.task import Task

SIDE, BLOCK, STEPS, SAMPLES = 16, 4, 8, 4
"""An experiment: a square of one element in the middle of a world of another, repeated in several worlds."""

NUMBERS = ("down", "right", "inner", "outer")
"""The measurements of an experiment: the displacement of the square, and the amounts of both elements."""


def tried_pairs(ruleset: Ruleset) -> Tensor:
    """The ids of the square and of its surroundings in each experiment, int64 [pairs, 2]."""
    return torch.tensor(list(permutations(sorted(element.id for element in ruleset.elements), 2)))


def experiments(ruleset: Ruleset) -> Tensor:
    """The outcomes of experiments with every pair of elements, in the order of ids: uint8 [pairs · 4].

    127 or 128 means no change; 255 means a move by `STEPS` cells down or right, or twice the amount.
    """
    # All backends agree. Native code would take longer to compile than these steps.
    simulator, pairs = compile_ruleset(ruleset), tried_pairs(ruleset)
    inner, outer = pairs.repeat_interleave(SAMPLES, 0).T
    first = (SIDE - BLOCK) // 2
    ids = outer[:, None, None].repeat(1, SIDE, SIDE)
    ids[:, first : first + BLOCK, first : first + BLOCK] = inner[:, None, None]
    seeds = torch.arange(SAMPLES).repeat(len(pairs))
    world = simulator.step(simulator.world(ids.to(torch.uint8), seeds), STEPS)
    after = world.ids.long().cpu()
    place = torch.arange(SIDE, dtype=torch.float64) - (SIDE - 1) / 2
    is_inner = (after == inner[:, None, None]).double()
    count = is_inner.sum((1, 2))
    moved = [(is_inner.sum(axis) @ place) / count.clamp(min=1) / STEPS for axis in (2, 1)]
    left = count / BLOCK**2, (after == outer[:, None, None]).double().sum((1, 2)) / (SIDE**2 - BLOCK**2)
    numbers = torch.stack([*moved, *(share - 1 for share in left)], 1)
    mean = numbers.view(len(pairs), SAMPLES, len(NUMBERS)).mean(1)
    return ((mean.clamp(-1, 1) + 1) * 127.5).round().to(torch.uint8).flatten()


class Laws:
    """Encodes the laws of a task's worlds as bytes: experiments, if rulesets differ between worlds, then parameters."""

    def __init__(self, task: Task, ruleset: Ruleset):
        self._ruleset, self._experiments = ruleset, torch.zeros(0, dtype=torch.uint8)
        elements = ruleset.elements
        self._tries = len(elements) * (len(elements) - 1) * len(NUMBERS)
        self._mixed = any(split.rulesets for split in task.splits)
        ranges: dict[str, tuple[float, float]] = {}
        for part in (part for split in task.splits for part in split.params):
            low, high = ranges.get(part.name, (part.low, part.high))
            ranges[part.name] = min(low, part.low), max(high, part.high)
        self._ranges = ranges

    def __len__(self) -> int:
        return self._tries * self._mixed + len(self._ranges)

    def of(self, params: Mapping[str, Tensor], worlds: int) -> Tensor:
        """The laws of worlds, uint8 [B, n], with some parameters, float64 [B] each, and defaults for the others."""
        if self._mixed and not len(self._experiments):
            self._experiments = experiments(self._ruleset)
        defaults = {param.name: float(param.default) for param in self._ruleset.params}
        values = [self._experiments.expand(worlds, -1)]
        for name, (low, high) in self._ranges.items():
            value = torch.as_tensor(params.get(name, defaults[name]), dtype=torch.float64).cpu()
            share = (value.expand(worlds) - low) / max(high - low, 1e-9)
            values.append((share.clamp(0, 1) * 255).round().to(torch.uint8)[:, None])
        return torch.cat(values, 1)
