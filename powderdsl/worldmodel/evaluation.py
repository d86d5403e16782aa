"""Tests of trained networks, beside baselines, on worlds that training never uses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Any, TypedDict, Unpack

import torch
from torch import Tensor

from powderdsl.experiments.runs import does_not_fit
from powderdsl.worldmodel.config import HERE, Machine
from powderdsl.worldmodel.networks import without_actions
from powderdsl.worldmodel.pairs import DataConfig, TaskWorlds, pairs_of, task_worlds, unseen_seeds
from powderdsl.worldmodel.recordings import Recording
from powderdsl.worldmodel.rulesets import UNSEEN_RULESETS, VariedWorlds
from powderdsl.worldmodel.scores import Network, Score, elements_of, frequent, outcomes, score, still
from powderdsl.worldmodel.trained import Trained
from powderdsl.worldmodel.training import check_palette, load_rules_of

FIT_WORLDS = 64
"""The most training worlds that baselines are fitted on."""

TRANSITIONS = 2048
"""The most recorded transitions that a network is tested on, and that baselines are fitted on."""

MODEL, STILL, FREQUENT = "model", "nothing changes", "most frequent outcome"
BLIND = "action hidden"
"""The same network, shown that nothing was done."""


@dataclass(frozen=True)
class Tested:
    """The results of a test: by world, the score of each predictor; `missing` has the worlds that could not be tested."""

    rules: str
    task: str
    split: str
    only: tuple[str, ...]
    worlds: int
    """Worlds of each test, or transitions that were recorded."""
    scores: Mapping[str, Mapping[str, Score]]
    missing: Mapping[str, tuple[str, ...]]
    palette: tuple[str | None, ...]
    step: int

    def mean(self, predictor: str) -> float:
        """The mean of the worlds' losses, each counted once."""
        return sum(one[predictor].loss for one in self.scores.values()) / len(self.scores)

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        names = list(next(iter(self.scores.values())))
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
            "reliability": whole[MODEL].reliability(),
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

    Networks that learned from a dataset are tested by `evaluate_recording`.

    Args:
        worlds: worlds of a split, or random futures of each of its stands; by default 32 and 4.
        split: ``designed`` unless another is given.
        task, rules, only, knobs: those of the training data unless others are given; with another task, its own knobs.
        rulesets: how many rulesets the worlds run under in turn, drawn as those of the training data were, and none of
            which training takes. 0: the rules as they are.

    Raises:
        CompileError: as `task_worlds`; PD623 if the rules have elements that the network has no slots for.
    """
    if trained.config.recorded is not None:
        raise does_not_fit(trained.run.path, "it predicts recorded transitions, with actions")
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


def evaluate_recording(trained: Trained, recording: Recording, *, machine: Machine = HERE) -> Tested:
    """Test a network on recorded transitions: those of the test worlds if it learned from this dataset, otherwise all.

    Beside both baselines, fitted on the training worlds' transitions of this dataset, the network is tested with its
    actions hidden, unless it never sees them. At most `TRANSITIONS` transitions, evenly spread, are used.

    Raises:
        CompileError: PD623 if the network did not learn from a dataset, or the numbers mean something else in this one.
    """
    known, here, device = trained.config.recorded, recording.recorded, machine.device
    if known is None:
        raise does_not_fit(trained.run.path, "it learned from worlds, without actions")
    check_palette(trained.run.path, trained.palette, recording.rules)
    names = ("channels", "steps", "speed")
    why = [
        f"`{name}` is {getattr(known, name)} there, {getattr(here, name)} in {recording.dataset.folder}"
        for name in names
        if getattr(known, name) != getattr(here, name)
    ]
    if why:
        raise does_not_fit(trained.run.path, *why)
    own = known.digest == here.digest
    slots, ids = len(trained.palette), [element.id for element in recording.rules.elements]
    fit = outcomes(
        ((starts[:, 0], ends) for starts, ends in recording.spread(recording.parts[0], TRANSITIONS)), slots
    )
    tables = {STILL: still(fit, ids), FREQUENT: frequent(fit, ids)}
    predictors: dict[str, Network] = {MODEL: trained.network}
    if known.actions:
        predictors[BLIND] = lambda inputs: trained.network(without_actions(inputs))
    for name, one in tables.items():
        predictors[name] = lambda inputs, one=one: one(inputs[:, 0])  # type: ignore[misc]
    pairs = recording.spread(recording.parts[2] if own else recording.all, TRANSITIONS, device)
    return Tested(
        rules=recording.rules.name,
        task=recording.task.name,
        split=recording.dataset.recipe.split,
        only=(),
        worlds=sum(len(ends) for _, ends in pairs),
        scores={"transitions": {name: score(one, pairs, slots) for name, one in predictors.items()}},
        missing={},
        palette=trained.palette,
        step=trained.checkpoint.step,
    )


def unseen_worlds(
    trained: Trained, *, machine: Machine = HERE, **tested_on: Unpack[TestedOn]
) -> TaskWorlds | VariedWorlds:
    """The worlds that `evaluate` tests on, which has the same arguments and errors.

    Worlds that the rules cannot have are left out, as long as others remain.
    """
    if trained.config.recorded is not None:
        raise does_not_fit(trained.run.path, "it predicts recorded transitions, with actions")
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
