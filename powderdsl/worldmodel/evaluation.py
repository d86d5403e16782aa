"""Tests of trained networks on unseen worlds: comparisons with baselines, and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from powderdsl.experiments.runs import differences, misfit
from powderdsl.model.types import Ruleset
from powderdsl.simulation.draw import contact_sheet, palette, rgb, scale
from powderdsl.tasks.shipped import load_task
from powderdsl.worldmodel.config import HERE, DataConfig, Machine
from powderdsl.worldmodel.networks import without_actions
from powderdsl.worldmodel.scores import Network, Score, elements_of, frequent, outcomes, score, still
from powderdsl.worldmodel.training import Trained, check_slots, load_rules_of
from powderdsl.worldmodel.worlds import Pairs, Recording, TaskWorlds, inputs_of, pairs_of, unseen_seeds

FIT_WORLDS = 64
"""Maximum number of training worlds to fit baselines on."""

TRANSITIONS = 2048
"""Maximum number of recorded transitions to test a network on, and to fit baselines on."""

MODEL, STILL, FREQUENT = "model", "nothing changes", "most frequent outcome"
BLIND = "action hidden"
"""The same network with actions hidden."""


@dataclass(frozen=True)
class Tested:
    """The results of a test: each predictor's score by world; `missing` has the worlds that could not be tested."""

    rules: str
    task: str
    split: str
    only: tuple[str, ...]
    worlds: int
    """Number of worlds of each test, or of recorded transitions."""
    steps: int
    """Number of predicted steps."""
    scores: Mapping[str, Mapping[str, Score]]
    missing: Mapping[str, tuple[str, ...]]
    trained: Trained

    def mean(self, predictor: str) -> float:
        """The mean loss over worlds, unweighted."""
        return sum(scores[predictor].loss for scores in self.scores.values()) / len(self.scores)

    def plain(self) -> dict[str, Any]:
        """The results as plain values, for JSON."""
        names = list(next(iter(self.scores.values())))
        total = {name: reduce(add, [scores[name] for scores in self.scores.values()]) for name in names}
        return {
            "rules": self.rules,
            "task": self.task,
            "split": self.split,
            "only": list(self.only),
            "worlds_each": self.worlds,
            "iterations": self.trained.checkpoint.step,
            "steps": self.steps,
            "mean": {name: {**total[name].plain(), "loss": self.mean(name)} for name in names},
            "tests": {
                test: {name: scores[name].plain() for name in names} for test, scores in self.scores.items()
            },
            "elements": elements_of(total[MODEL], self.trained.palette),
            "reliability": total[MODEL].reliability(),
            "left_out": {name: list(lacking) for name, lacking in self.missing.items()},
        }


def ahead(predict: Network, times: int) -> Network:
    """A network for `times` the number of steps, which is applied to its own predictions."""

    def predicted(inputs: torch.Tensor) -> torch.Tensor:
        for _ in range(times - 1):
            ids = predict(inputs).argmax(1).to(torch.uint8)
            inputs = ids if inputs.ndim == 3 else torch.stack([ids, inputs[:, 1]], 1)  # laws stay
        return predict(inputs)

    return predicted


def evaluate(
    trained: Trained, *, worlds: int | None = None, times: int = 1, machine: Machine = HERE, **tested_on: Any
) -> Tested:
    """Test a network and both baselines on unseen worlds.

    Networks that learned from a dataset are tested by `evaluate_recording`.

    Args:
        worlds: number of worlds of a split, or of random futures of each of its stands; by default 32 and 4.
        times: number of times to apply the network. The baselines are fitted on all these steps at once.
        tested_on: see `unseen_worlds`.

    Raises:
        CompileError: as `unseen_worlds`.
    """
    unseen = unseen_worlds(trained, machine=machine, **tested_on)
    data, names, slots = trained.config.data, unseen.names, len(trained.palette)
    steps = data.steps * times
    seeds = torch.arange(min(FIT_WORLDS, data.states), device=machine.device)
    trained_on = TaskWorlds(data, **machine.simulation, palette=trained.palette)
    fit = pairs_of(trained_on, seeds, steps, data.pairs)
    model = ahead(trained.network, times)
    predictors: dict[str, Network] = {MODEL: model, **_baselines(fit, unseen.rules, slots)}
    count = worlds or (4 if len(names) > 1 else 32)
    scores = {}
    for name, seeds in zip(names, unseen_seeds(count, len(names)).view(len(names), count), strict=True):
        pairs = list(pairs_of(unseen, seeds.to(machine.device), steps, data.pairs))
        scores[name] = {who: score(predict, pairs, slots) for who, predict in predictors.items()}
    return Tested(
        rules=unseen.rules.name,
        task=unseen.config.task,
        split=unseen.config.split,
        only=unseen.config.only,
        worlds=count,
        steps=steps,
        scores=scores,
        missing={variant.name: variant.elements for variant in unseen.missing},
        trained=trained,
    )


def evaluate_recording(trained: Trained, recording: Recording, *, machine: Machine = HERE) -> Tested:
    """Test a network on recorded transitions: those of the test worlds if it was trained on this dataset, otherwise
    all.

    Besides both baselines, which are fitted on the dataset's training worlds, the network is also tested with actions
    hidden, unless it never sees them. At most `TRANSITIONS` evenly spread transitions are used.

    Raises:
        CompileError: PD623 if the network was not trained on a dataset, or the numbers of this one have another
            meaning.
    """
    known, here = trained.config.recorded, recording.recorded
    if known is None:
        raise misfit(trained.run.path, "it was trained on worlds, without actions")
    check_slots(trained.run.path, trained.palette, recording.rules)
    seen, shown = (
        {name: getattr(meaning, name) for name in ("channels", "steps", "speed")} for meaning in (known, here)
    )
    if why := differences(seen, shown):
        raise misfit(trained.run.path, *why)
    slots, predictors = len(trained.palette), dict[str, Network]({MODEL: trained.network})
    if known.actions:
        predictors[BLIND] = lambda inputs: trained.network(without_actions(inputs))
    predictors |= _baselines(recording.spread(recording.parts[0], TRANSITIONS), recording.rules, slots)
    rows = recording.parts[2] if known.digest == here.digest else recording.all
    pairs = recording.spread(rows, TRANSITIONS, machine.device)
    return Tested(
        rules=recording.rules.name,
        task=recording.task.name,
        split=recording.dataset.recipe.split,
        only=(),
        worlds=sum(len(ends) for _, ends in pairs),
        steps=known.steps,
        scores={
            "transitions": {name: score(predictor, pairs, slots) for name, predictor in predictors.items()}
        },
        missing={},
        trained=trained,
    )


def _baselines(fit: Iterable[Pairs], rules: Ruleset, slots: int) -> dict[str, Network]:
    counts, ids = outcomes(fit, slots), [element.id for element in rules.elements]
    return {STILL: still(counts, ids), FREQUENT: frequent(counts, ids)}


def unseen_worlds(trained: Trained, *, machine: Machine = HERE, **tested_on: Any) -> TaskWorlds:
    """Worlds to test a network on. Those that the rules cannot have are excluded, unless none remain.

    `tested_on`: see `unseen_data`. Raises CompileError: as `TaskWorlds`; PD623 if the network lacks slots for elements
    of the rules, or was trained on a dataset.
    """
    if trained.config.recorded is not None:
        raise misfit(trained.run.path, "it predicts recorded transitions, with actions")
    data = unseen_data(trained.config.data, **tested_on)
    check_slots(trained.run.path, trained.palette, load_rules_of(data, trained.palette))
    return TaskWorlds(data, **machine.simulation, partly=True, palette=trained.palette)


def unseen_data(
    data: DataConfig,
    *,
    task: str | None = None,
    split: str = "",
    rules: str | None = None,
    only: tuple[str, ...] | None = None,
    knobs: Mapping[str, int] | None = None,
) -> DataConfig:
    """Return the worlds on which to test a network that was trained on `data`.

    Args:
        task, rules, only, knobs: by default those of the training data; with another task, its own knobs.
        split: by default `designed` if the task has it, or else the split of the training data, with other seeds.
    """
    knobs = (data.knobs if task is None else {}) if knobs is None else knobs
    splits = [split.name for split in load_task(task or data.task, knobs=knobs).splits]
    split = split or next(name for name in ("designed", data.split, *splits) if name in splits)
    return replace(
        data,
        task=task or data.task,
        split=split,
        rules=data.rules if rules is None else rules,
        params=data.params if rules is None else {},
        only=data.only if only is None else only,
        knobs=knobs,
        rulesets=data.rulesets if task is None and split == data.split else 0,
    )


# Pictures

RIGHT, WRONG = np.array([(235, 235, 235), (200, 30, 30)], np.uint8)
"""Colors of correctly and wrongly predicted cells."""
TITLE = 14
"""Pixels of the line above a picture."""


@dataclass(frozen=True)
class Strip:
    """One test: ids uint8 [H, W] at the start, at the end, and as predicted."""

    name: str
    start: NDArray[np.uint8]
    truth: NDArray[np.uint8]
    predicted: NDArray[np.uint8]

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """The cells that were predicted wrongly: bool [H, W]."""
        return self.truth != self.predicted


@torch.no_grad()
def strips(predict: Network, worlds: TaskWorlds, *, step: int, times: int = 1, after: int = 0) -> list[Strip]:
    """A strip for each variant of a split, of worlds after `after` steps.

    The network was trained to predict `step` steps, and is applied `times` times.
    """
    seeds = unseen_seeds(1, len(worlds.names)).to(worlds.device)
    world = worlds.later(worlds.start(seeds), after)
    predicted = ahead(predict, times)(inputs_of(world)).argmax(1).to(torch.uint8)
    truth = worlds.later(world, step * times).ids
    three = [ids.cpu().numpy() for ids in (world.ids, truth, predicted)]
    return [Strip(name, *(ids[n] for ids in three)) for n, name in enumerate(worlds.names)]


@torch.no_grad()
def recorded_strips(predict: Network, recording: Recording, count: int = 8) -> list[Strip]:
    """Strips of transitions of test worlds, evenly spread."""
    strips: list[Strip] = []
    for inputs, ends in recording.spread(recording.parts[2], count):
        predicted = predict(inputs).argmax(1).to(torch.uint8)
        for three in zip(inputs[:, 0], ends, predicted, strict=True):
            strips.append(Strip(f"transition {len(strips) + 1}", *(ids.cpu().numpy() for ids in three)))
    return strips


def sheet(strips: list[Strip], rules: Ruleset, *, factor: int = 2) -> NDArray[np.uint8]:
    """Strips below one another, uint8 [H', W', 3]: start, truth, prediction, errors. A cell has `factor`² pixels.

    Each picture has a title. Colors do not follow fields, since networks only predict elements.
    """
    colors, font = palette(rules.elements), ImageFont.load_default()
    pictures = []
    for strip in strips:
        errors = np.where(strip.wrong[..., None], WRONG, RIGHT)
        worlds = [rgb(ids, colors) for ids in (strip.start, strip.truth, strip.predicted)]
        titles = (strip.name, "truth", "prediction", f"{strip.wrong.mean():.1%} wrong")
        for title, picture in zip(titles, [*worlds, errors], strict=True):
            image = Image.fromarray(np.pad(scale(picture, factor), ((TITLE, 0), (0, 0), (0, 0))))
            ImageDraw.Draw(image).text((2, 0), title, fill="white", font=font)
            pictures.append(np.asarray(image))
    return contact_sheet(pictures, columns=4, gap=4)
