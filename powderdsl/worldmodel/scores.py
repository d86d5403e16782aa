"""Scores of predictions: networks and baselines by the same measure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Any, TypedDict, Unpack

import torch
from torch import Tensor
from torch.nn import functional as F

from powderdsl.worldmodel.pairs import DataConfig, Pairs, TaskWorlds, pairs_of, task_worlds, unseen_seeds
from powderdsl.worldmodel.rulesets import UNSEEN_RULESETS, VariedWorlds
from powderdsl.worldmodel.training import HERE, Machine, Network, Trained, check_palette, load_rules_of

TOGETHER = 1 << 17
"""The most cells that a network is given at once."""

FIT_WORLDS = 64
"""The most training worlds that baselines are fitted on."""

MODEL, STILL, FREQUENT = "model", "nothing changes", "most frequent outcome"


@dataclass(frozen=True)
class Score:
    """Sums over cells. `confusion`, int64 [slots, slots], counts cells by what they became and what was predicted."""

    loss_sum: float
    confusion: Tensor
    changed: int
    changed_right: int

    @property
    def cells(self) -> int:
        return int(self.confusion.sum())

    def plain(self) -> dict[str, float | int | None]:
        """For JSON."""
        names = ("loss", "accuracy", "changed_accuracy", "cells", "changed")
        return {name: getattr(self, name) for name in names}

    @property
    def loss(self) -> float:
        """Cross-entropy a cell, in nats."""
        return self.loss_sum / max(self.cells, 1)

    @property
    def accuracy(self) -> float:
        return int(self.confusion.diagonal().sum()) / max(self.cells, 1)

    @property
    def changed_accuracy(self) -> float | None:
        """Of cells that hold another element at the end than at the start; None if there are none."""
        return self.changed_right / self.changed if self.changed else None

    def __add__(self, other: Score) -> Score:
        return Score(
            self.loss_sum + other.loss_sum,
            self.confusion + other.confusion,
            self.changed + other.changed,
            self.changed_right + other.changed_right,
        )


def score(predict: Network, pairs: Iterable[Pairs], slots: int) -> Score:
    """The score of a network, or of any callable from ids to logits [B, slots, H, W], on some pairs."""
    total = Score(0.0, torch.zeros(slots, slots, dtype=torch.int64), 0, 0)
    for starts, ends in pairs:
        few = max(1, TOGETHER // (starts.shape[1] * starts.shape[2]))
        for begin in range(0, len(starts), few):
            total = total + _score(predict, starts[begin : begin + few], ends[begin : begin + few], slots)
    return total


@torch.no_grad()
def _score(predict: Network, starts: Tensor, ends: Tensor, slots: int) -> Score:
    logits = predict(starts).float()
    truth = ends.long()
    loss = F.cross_entropy(logits, truth, reduction="none").double().sum()
    predicted = logits.argmax(1)
    changed = starts != ends
    right = (predicted == truth) & changed
    return Score(float(loss), _counts(truth, predicted, slots), int(changed.sum()), int(right.sum()))


class Table:
    """A baseline: log-probabilities of what a cell becomes, by what it holds. A callable as networks are.

    `chances` is float64 [slots, slots]: a row for each start element, which sums to 1.
    """

    def __init__(self, chances: Tensor):
        self.chances = chances

    def __call__(self, ids: Tensor) -> Tensor:
        return self.chances.log().float().to(ids.device)[ids.long()].permute(0, 3, 1, 2)


def outcomes(pairs: Iterable[Pairs], slots: int) -> Tensor:
    """How many cells went from each element to each: int64 [slots, slots]."""
    counts = torch.zeros(slots, slots, dtype=torch.int64)
    for starts, ends in pairs:
        counts += _counts(starts.long(), ends.long(), slots)
    return counts


def _counts(rows: Tensor, columns: Tensor, slots: int) -> Tensor:
    """How often each pair of numbers below `slots` occurs: int64 [slots, slots]."""
    both = (rows * slots + columns).flatten()
    return torch.bincount(both, minlength=slots * slots).view(slots, slots).cpu()


def still(counts: Tensor, ids: Sequence[int]) -> Table:
    """ "Nothing changes": a cell stays with one chance, and becomes each of the other elements with an equal share.

    The chance is the one with the lowest cross-entropy on the counted pairs: the share of cells that stayed, with one
    cell that stayed and one that did not counted besides. `ids` are those of the elements that there are.
    """
    stays = (int(counts.diagonal().sum()) + 1) / (int(counts.sum()) + 2)
    chances = torch.zeros(len(counts), len(counts), dtype=torch.float64)
    chances[:, list(ids)] = (1 - stays) / max(len(ids) - 1, 1)
    return Table(chances.fill_diagonal_(stays))


def frequent(counts: Tensor, ids: Sequence[int]) -> Table:
    """ "Most frequent outcome": for each start element the counted shares of what it became.

    One cell is counted besides for each element that it may become, those of `ids`, so that no chance of these is 0.
    """
    seen = counts.double()
    seen[:, list(ids)] += 1
    return Table(seen / seen.sum(1, keepdim=True))


@dataclass(frozen=True)
class Tested:
    """The results of a test: by world, the score of each predictor; `missing` has the worlds that could not be tested."""

    rules: str
    task: str
    split: str
    only: tuple[str, ...]
    worlds: int
    scores: Mapping[str, Mapping[str, Score]]
    missing: Mapping[str, tuple[str, ...]]
    palette: tuple[str | None, ...]
    step: int

    def mean(self, predictor: str) -> float:
        """The mean of the worlds' losses, each counted once."""
        return sum(one[predictor].loss for one in self.scores.values()) / len(self.scores)

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        names = [MODEL, STILL, FREQUENT]
        whole = {name: reduce(add, [one[name] for one in self.scores.values()]) for name in names}
        return {
            "rules": self.rules,
            "task": self.task,
            "split": self.split,
            "only": list(self.only),
            "worlds_each": self.worlds,
            "iterations": self.step,
            "mean": {name: {**whole[name].plain(), "loss": self.mean(name)} for name in names},
            "tests": {test: {name: one[name].plain() for name in names} for test, one in self.scores.items()},
            "elements": elements_of(whole[MODEL], self.palette),
            "left_out": {name: list(lacking) for name, lacking in self.missing.items()},
        }


class TestedOn(TypedDict, total=False):
    """What a network is tested on: see `evaluate`."""

    task: str | None
    split: str
    rules: str | None
    only: tuple[str, ...] | None
    knobs: Mapping[str, int] | None
    rulesets: int


def evaluate(
    trained: Trained, *, worlds: int | None = None, machine: Machine = HERE, **tested_on: Unpack[TestedOn]
) -> Tested:
    """Test a network and both baselines on worlds that training never uses.

    Args:
        worlds: worlds of a split, or random futures of each of its stands; by default 32 and 4.
        split: ``designed`` unless another is given.
        task, rules, only, knobs: those of the training data unless others are given; with another task, its own knobs.
        rulesets: how many rulesets the worlds run under in turn, drawn as those of the training data were, and none of
            which training takes. 0: the rules as they are.

    Raises:
        CompileError: as `task_worlds`; PD623 if the rules have elements that the network has no slots for.
    """
    fit = _counted(trained, machine)
    data = _data_of(trained, **tested_on)
    found = _worlds_of(trained, data, machine)
    slots, names = len(trained.palette), found.names
    ids = [element.id for element in found.rules.elements]
    predictors: dict[str, Network] = {
        MODEL: trained.network,
        STILL: still(fit, ids),
        FREQUENT: frequent(fit, ids),
    }
    many = worlds or (4 if len(names) > 1 else 32)
    scores = {}
    for name, seeds in zip(names, unseen_seeds(many, len(names)).view(len(names), many), strict=True):
        pairs = list(pairs_of(found, seeds.to(machine.device), data.steps, data.pairs))
        scores[name] = {who: score(predict, pairs, slots) for who, predict in predictors.items()}
    return Tested(
        rules=found.rules.name,
        task=data.task,
        split=data.split,
        only=data.only,
        worlds=many,
        scores=scores,
        missing={name: lacking for name, lacking, _ in found.found.missing},
        palette=trained.palette,
        step=trained.checkpoint.step,
    )


def unseen_worlds(
    trained: Trained, *, machine: Machine = HERE, **tested_on: Unpack[TestedOn]
) -> TaskWorlds | VariedWorlds:
    """The worlds that `evaluate` tests on, which has the same arguments and errors.

    Worlds that the rules cannot have are left out, as long as others remain.
    """
    return _worlds_of(trained, _data_of(trained, **tested_on), machine)


def _data_of(
    trained: Trained,
    task: str | None = None,
    split: str = "designed",
    rules: str | None = None,
    only: tuple[str, ...] | None = None,
    knobs: Mapping[str, int] | None = None,
    rulesets: int = 0,
) -> DataConfig:
    """The training data's configuration with the given changes."""
    data = trained.config.data
    return replace(
        data,
        task=task or data.task,
        split=split,
        rules=data.rules if rules is None else rules,
        params=data.params if rules is None else {},
        only=data.only if only is None else only,
        knobs=(data.knobs if task is None else {}) if knobs is None else knobs,
        rulesets=rulesets,
        first_ruleset=UNSEEN_RULESETS,
    )


def _worlds_of(trained: Trained, data: DataConfig, machine: Machine) -> TaskWorlds | VariedWorlds:
    check_palette(trained.run.path, trained.palette, load_rules_of(data, trained.palette))
    return task_worlds(data, **machine.simulation, partly=True, palette=trained.palette)


def _counted(trained: Trained, machine: Machine) -> Tensor:
    """Outcomes of some of the run's training worlds."""
    data = trained.config.data
    found = task_worlds(data, **machine.simulation, palette=trained.palette)
    seeds = torch.arange(min(FIT_WORLDS, data.states), device=machine.device)
    return outcomes(pairs_of(found, seeds, data.steps, data.pairs), len(trained.palette))


def elements_of(found: Score, palette: tuple[str | None, ...]) -> dict[str, dict[str, float | int | None]]:
    """By element: cells that ended as it, the share of these that was predicted (recall), and the share of cells
    predicted as it that were (precision). None where there are no such cells."""
    table: dict[str, dict[str, float | int | None]] = {}
    for slot, name in enumerate(palette):
        cells, predicted = int(found.confusion[slot].sum()), int(found.confusion[:, slot].sum())
        right = int(found.confusion[slot, slot])
        if name is not None and (cells or predicted):
            table[name] = {
                "cells": cells,
                "recall": right / cells if cells else None,
                "precision": right / predicted if predicted else None,
            }
    return table
