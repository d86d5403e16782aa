"""Training data: worlds of a task without its agent, possibly under other rules or with fewer elements; and transitions
recorded from a task, each a state, an action, and the next state.

A recorded input is uint8 [B, C + 3, H, W]: the C channels of the observation, and three for the action's effect on each
cell (see `tasks.tensors.actions.Hands`): the element that it places (`NO_ELEMENT` for none), and the rows and columns
of its speed plus 2 (0 where it does not blow). `ActionChannels` encodes it for networks.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn import functional as F

from powderdsl.compiler import load
from powderdsl.datasets.manifest import changed_params, choice_names
from powderdsl.diagnostics import CompileError, Reporter, Span, suggest
from powderdsl.experiments.runs import differences
from powderdsl.model.composition.compose import Palette
from powderdsl.model.types import Ruleset
from powderdsl.simulation.programs import starting_backend
from powderdsl.system.settings import fingerprint
from powderdsl.system.writing import failure
from powderdsl.tasks.episodes import Episodes, TaskProgram, compile_task
from powderdsl.tasks.laws import NUMBERS, tried_pairs
from powderdsl.tasks.shipped import check_split, load_task, shipped_tasks
from powderdsl.tasks.task import BLOW, NO_CHANGE, NOTHING, Drawing, Generator, Goal, Stamp, Task
from powderdsl.tasks.tensors.actions import cells_of
from powderdsl.worldmodel.config import TEST_SEEDS, DataConfig, Recorded, TrainConfig
from powderdsl.worldmodel.networks import NO_ELEMENT

if TYPE_CHECKING:
    from powderdsl.datasets import Dataset, Transitions

VALIDATION_SEEDS = 1 << 33
"""The first seed of validation worlds, far beyond those of test worlds."""

VALIDATION_WORLDS = 64
"""Number of validation worlds, each used at one time."""

Pairs = tuple[Tensor, Tensor]
"""Start, of `inputs_of`, and end, element ids uint8 [B, H, W]."""


class Worlds(Protocol):
    """A source of worlds: `TaskWorlds`, or your own. The same seed gives the same world with the same future."""

    rules: Ruleset
    """The rules, with all elements of the worlds."""

    size: tuple[int, int]
    """Rows and columns."""

    def start(self, seeds: Tensor) -> Any:
        """The worlds of seeds, int64 [B], such as a `World`: its `ids` are the elements, uint8 [B, H, W]."""

    def later(self, world: Any, steps: int) -> Any:
        """The worlds after some steps; `world` is not changed."""


@dataclass(frozen=True)
class WorldBatch:
    """Worlds with one seed each, possibly under different rulesets: their numbers and episodes by ruleset."""

    parts: tuple[tuple[Tensor, Episodes], ...]
    laws: Tensor | None = None
    """Bytes of each world's laws, uint8 [B, H, W], if the network observes them: see `law_plane`."""

    @property
    def ids(self) -> Tensor:
        """Element ids, uint8 [B, H, W]."""
        if len(self.parts) == 1:
            return self.parts[0][1].world.ids
        order = torch.cat([numbers for numbers, _ in self.parts]).argsort()
        return torch.cat([episodes.world.ids for _, episodes in self.parts])[order]


def law_plane(program: TaskProgram, episodes: Episodes, slots: int) -> Tensor:
    """The laws of a ruleset as bytes of cells, uint8 [H, W].

    Four bytes from 4·(slots·a + b) on are the outcomes of a square of element a inside element b (`tasks.laws.experiments`).
    """
    pairs = tried_pairs(program.task.ruleset)
    numbers = program.law_bytes(episodes)[0, : len(NUMBERS) * len(pairs)].view(len(pairs), len(NUMBERS))
    table = torch.full((slots, slots, len(NUMBERS)), 127, dtype=torch.uint8, device=numbers.device)
    table[pairs[:, 0], pairs[:, 1]] = numbers
    return F.pad(table.flatten(), (0, prod(program.task.size) - table.numel())).view(program.task.size)


def inputs_of(world: Any) -> Tensor:
    """Network inputs for worlds: ids, uint8 [B, H, W]; or ids and bytes of laws, uint8 [B, 2, H, W]."""
    laws = getattr(world, "laws", None)
    return world.ids if laws is None else torch.stack([world.ids, laws], 1)


class TaskWorlds:
    """The executable worlds of a configuration: those of a task's split under some rules.

    If the split has laws, each world has its own.

    Args:
        partly: exclude worlds that the rules cannot have, which are listed in `missing`.
        palette: the ids of a network's slots, as for `compiler.load`.
        machine: backend, device and threads, as for `compile_task`.

    Raises:
        CompileError: all mistakes in the task, the rules, the knobs and the parameters; PD604 if worlds need elements
            that the rules lack; PD701 for an unavailable backend or device.
    """

    def __init__(
        self, config: DataConfig, *, partly: bool = False, palette: Palette | None = None, **machine: Any
    ):
        params = None if config.rules else config.params
        task = load_task(config.task, knobs=config.knobs, params=params, palette=palette)
        check_split(task, config.split)
        laws = task.split(config.split)
        rules = load(config.rules, params=config.params, palette=palette) if config.rules else task.ruleset
        self.missing: tuple[Missing, ...] = ()
        if not laws.rulesets:
            if config.rulesets or config.observation == "laws":
                raise failure("PD801", f"{task.name} has no `rulesets` in {config.split}; universe-model has")
            check_data(config, task, rules)
            task, self.missing = watch(task, config.split, rules, config.only, partly=partly)
        elif config.rules or config.only:
            raise failure("PD801", f"the split {config.split} of {task.name} has its own rulesets")
        elif machine.get("backend", "auto") == "auto":
            # Compiling many rulesets would take longer than running them.
            machine = {**machine, "backend": starting_backend(str(machine.get("device", "cpu")))}
        self.config, self.rules, self.size = config, rules, task.size
        self._slots = len(palette or ()) or 1 + max(element.id for element in rules.elements)
        if config.observation == "laws" and len(NUMBERS) * self._slots**2 > prod(task.size):
            what = f"{len(NUMBERS) * self._slots**2} cells, to show the laws of {self._slots} elements"
            raise failure("PD801", f"the worlds of {task.name} are too small: they need {what}")
        split = task.split(config.split)
        self.names = tuple(variant.name for variant in split.variants)
        """The names of the variants: seed s gives variant s mod their number."""
        self.fingerprint = fingerprint((split,))
        """A digest of the start worlds and the laws that they draw, which changes with the task's file."""
        self.device = torch.device(machine.get("device", "cpu"))
        """The device of the worlds."""
        self._program = compile_task(task, split=config.split, rulesets=config.rulesets, **machine)

    def start(self, seeds: Tensor) -> WorldBatch:
        """The worlds of seeds, int64 [B]."""
        parts, laws = [], torch.zeros(len(seeds), *self.size, dtype=torch.uint8, device=self.device)
        shows = self.config.observation == "laws"
        for places, own in self._program.apart(seeds):
            episodes = own.start(seeds[places])
            parts.append((places, episodes))
            if shows:
                laws[places] = law_plane(own, episodes, self._slots)
        return WorldBatch(tuple(parts), laws if shows else None)

    def later(self, world: WorldBatch, steps: int) -> WorldBatch:
        def stepped(episodes: Episodes) -> Episodes:
            now = episodes.world
            return replace(episodes, world=now.sim.step(now, steps, params=episodes.params or None))

        return replace(world, parts=tuple((numbers, stepped(episodes)) for numbers, episodes in world.parts))


def check_data(config: DataConfig, task: Task, rules: Ruleset) -> None:
    """Raise CompileError if a task lacks a configuration's split, or rules its packs."""
    check_split(task, config.split)
    for pack in config.only:
        if pack not in rules.packs:
            helps = suggest(pack, rules.packs, "packs")
            raise failure("PD304", f"the rules {rules.name} have no pack `{pack}`", helps=helps)


# Pairs


def pairs_of(worlds: Worlds, seeds: Tensor, steps: int, pairs: int) -> Iterator[Pairs]:
    """The pairs of some worlds in the order of time: `pairs` batches of one pair per world."""
    world = worlds.start(seeds)
    for _ in range(pairs):
        start = inputs_of(world)
        world = worlds.later(world, steps)
        yield start, world.ids


def validation_pairs(worlds: Worlds, config: DataConfig, device: str | torch.device = "cpu") -> list[Pairs]:
    """Pairs of worlds unused by training and tests: one per world, at alternating times."""
    number = torch.arange(VALIDATION_WORLDS, device=device)
    chosen = []
    pairs = pairs_of(worlds, VALIDATION_SEEDS + number, config.steps, config.pairs)
    for moment, (starts, ends) in enumerate(pairs):
        mask = (number % config.pairs == moment).to(starts.device)
        if mask.any():
            chosen.append((starts[mask], ends[mask]))
    return chosen


def unseen_seeds(count: int, variants: int = 1) -> Tensor:
    """Seeds that training never uses, int64 [count·variants]: `count` of each variant, grouped by variant."""
    first = -(-TEST_SEEDS // variants) * variants
    grid = torch.arange(count)[None, :] * variants + torch.arange(variants)[:, None]
    return (first + grid).flatten()


# A task without an agent, under other rules


class Missing(NamedTuple):
    """A variant that rules cannot have: the names of missing elements, and the location of the first one."""

    name: str
    elements: tuple[str, ...]
    span: Span | None


def watch(
    task: Task, split: str, rules: Ruleset, only: Collection[str] = (), *, partly: bool = False
) -> tuple[Task, tuple[Missing, ...]]:
    """The worlds of a split under other rules, as a task with only that split; and those that the rules cannot have.

    Elements are looked up by qualified name. A statement that draws one of several elements uses those that the rules
    have, plus the elements of packs that the task does not know, limited to the packs `only` if any of these has
    elements. An element that is named alone must exist.

    `partly`: exclude variants that the rules cannot have, unless none remain. Raises CompileError (PD604) if worlds
    need elements that the rules lack.
    """
    original = task.split(split)
    variants, missing = [], []
    for variant in original.variants:
        narrowing = _Narrowing(task.ruleset, rules, only)
        narrowed = narrowing.generator(variant)
        if narrowing.missing:
            names = tuple(dict.fromkeys(narrowing.missing))
            missing.append(Missing(variant.name, names, narrowing.span))
        else:
            variants.append(narrowed)
    if missing and not (partly and variants):
        raise _missing_elements(task, rules, missing, only)
    agent = replace(task.agent, choices=(NO_CHANGE,), speed_field=None)
    watched = replace(original, variants=tuple(variants))
    nothing = Goal(None, None, None, None)
    return replace(task, ruleset=rules, agent=agent, goal=nothing, splits=(watched,)), tuple(missing)


class _Narrowing:
    """Generators with the ids of other rules. Names of elements that these rules lack are collected."""

    def __init__(self, own: Ruleset, rules: Ruleset, only: Collection[str]):
        others = {element.id: rules.element(element.qualified) for element in own.elements}
        self.ids = {number: other.id for number, other in others.items() if other is not None}
        self.names = {element.id: element.name for element in own.elements}
        packs = {element.pack for element in rules.elements}
        chosen = (packs & {*only}) or packs
        self.drawn = {
            element.id for element in own.elements if element.id in self.ids and element.pack in chosen
        }
        chosen -= {*own.packs}
        self.added = tuple(element.id for element in rules.elements if element.pack in chosen)
        self.missing: list[str] = []
        self.span: Span | None = None

    def generator(self, generator: Generator) -> Generator:
        drawn = {drawing.stamp for group in generator.groups for drawing in group.drawings}
        fill = self.id(generator.fill)
        groups = [
            replace(group, drawings=tuple(map(self.drawing, group.drawings))) for group in generator.groups
        ]
        stamps = tuple(self.stamp(stamp) for stamp in generator.stamps if stamp.name in drawn)
        return replace(generator, fill=fill, groups=tuple(groups), stamps=stamps, targets=())

    def drawing(self, drawing: Drawing) -> Drawing:
        if len(drawing.ids) > 1:
            ids = tuple(self.ids[number] for number in drawing.ids if number in self.drawn) + self.added
            if not ids:
                self.lack(drawing.ids, drawing.span)
        else:
            ids = tuple(self.id(number, drawing.span) for number in drawing.ids)
        over = drawing.over
        if over is not None:
            over = frozenset(self.ids[number] for number in over if number in self.ids)
        return replace(drawing, ids=ids, over=over)

    def stamp(self, stamp: Stamp) -> Stamp:
        rows = tuple(
            tuple(number if number == NOTHING else self.id(number) for number in row) for row in stamp.rows
        )
        return replace(stamp, rows=rows)

    def id(self, number: int, span: Span | None = None) -> int:
        if number not in self.ids:
            self.lack((number,), span)
        return self.ids.get(number, 0)

    def lack(self, ids: Sequence[int], span: Span | None) -> None:
        self.missing += [self.names[number] for number in ids]
        self.span = self.span or span


def _missing_elements(
    task: Task, rules: Ruleset, missing: Sequence[Missing], only: Collection[str]
) -> CompileError:
    reporter = Reporter()
    under = f"{rules.name} with only {', '.join(sorted(only))}" if only else rules.name
    for name, elements, span in missing:
        reporter.error(
            "PD604",
            f"the worlds `{name}` of {task.name} need elements that are not in {under}",
            span,
            "none of these can be drawn" if span else "",
            notes=[f"they need {', '.join(elements)}"],
            helps=["add the packs that have them, or choose another split or task"],
        )
    return CompileError(reporter.diagnostics)


PARTS = (0.8, 0.1, 0.1)
"""The shares of worlds for training, validation and tests."""


class Recording:
    """A dataset of a task's transitions to learn from, opened by `open_recording`.

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
            helps = ("record episodes of more worlds: a hundred are enough",)
            message = f"{dataset.folder} has too few worlds"
            raise failure("PD631", message, notes=(str(error),), helps=helps) from None

    @cached_property
    def recorded(self) -> Recorded:
        """The description of this recording in a run's file."""
        agent, recipe = self.task.agent, self.dataset.recipe
        rows = [row.sha256 for row in self.dataset.manifest.shards]
        text = json.dumps([asdict(recipe), rows], sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()
        return Recorded(digest, recipe.channels, agent.steps_per_action, agent.speed)

    def configured(self, config: TrainConfig) -> TrainConfig:
        """A configuration changed to train on this dataset, with or without recorded actions as before."""
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
        """The numbers of transitions of `steps_per_action` steps, int64 [n]; a last action may have free steps."""
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
        """Return the channels of actions, integers [B, 5], per cell: uint8 [B, 3, H, W]."""
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
        """A uniformly drawn batch of the training worlds' transitions, determined by seed and iteration."""
        from powderdsl.datasets.dataset import drawn

        chosen = torch.from_numpy(drawn(seed % (1 << 62), iteration, count, len(self.training)))
        return self.pairs(self.parts[0], self.training[chosen], device)

    @cached_property
    def training(self) -> Tensor:
        """The numbers of the eligible transitions of training worlds."""
        return self.eligible(self.parts[0])


def open_recording(folder: str | Path, task: str | None = None) -> Recording:
    """The recording in a dataset's folder.

    `task`: the file of the recorded task, unless it is a shipped one. Raises CompileError: PD630 for a folder
    that is not a dataset, or is damaged; PD631 if it was recorded from another task, or has too few worlds; what
    `load_task` raises.
    """
    from powderdsl.datasets import Dataset

    dataset = Dataset.open(folder)
    recipe = dataset.recipe
    if task is None and recipe.task not in shipped_tasks():
        # A name in the manifest must not lead to a file.
        message = f"{folder} was recorded from the task `{recipe.task}`, which is not a shipped one"
        raise failure("PD631", message, helps=("pass its file, too",))
    name = task or recipe.task
    ids = {int(number): element for number, element in recipe.palette.items()}
    palette = tuple(ids.get(number) for number in range(max(ids) + 1))
    params = changed_params(recipe, load_task(name))
    played = load_task(name, knobs=recipe.knobs, params=params, palette=palette)
    there = {"size": recipe.shape[1:], "actions": recipe.action_nvec, "choices": recipe.choices}
    here = {"size": played.size, "actions": played.agent.action_nvec, "choices": choice_names(played)}
    notes = differences(there, here)
    if not notes and recipe.task_fingerprint != fingerprint(played):
        notes = ("the task, its knobs or its rules have changed since, or packs had been added",)
    if notes:
        raise failure("PD631", f"{folder} does not fit the task {played.name}", notes=notes)
    return Recording(dataset, name, played, palette)
