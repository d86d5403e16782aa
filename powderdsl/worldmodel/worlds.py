"""Worlds to learn from: those of a task without its agent, under other rules, and with fewer elements to draw."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from powderdsl.compiler import load
from powderdsl.diagnostics import CompileError, Reporter, Span, suggest
from powderdsl.model.composition.compose import Palette
from powderdsl.model.types import Ruleset
from powderdsl.simulation.programs import starting_backend
from powderdsl.simulation.simulator import World
from powderdsl.system.fingerprint import fingerprint
from powderdsl.system.writing import failure
from powderdsl.tasks.episodes import TaskProgram, compile_task
from powderdsl.tasks.shipped import check_split, load_task
from powderdsl.tasks.task import NO_CHANGE, NOTHING, Drawing, Generator, Goal, Split, Stamp, Task
from powderdsl.worldmodel.config import TEST_SEEDS, DataConfig
from powderdsl.worldmodel.rulesets import Drawn, RulesetSource, check_properties

VALIDATION_SEEDS = 1 << 33
"""The first seed of worlds that models are validated on during training: far beyond those of tests."""

VALIDATION_WORLDS = 64
"""The worlds that models are validated on, each at one time."""

Pairs = tuple[Tensor, Tensor]
"""Start and end, element ids uint8 [B, H, W] each."""


class Worlds(Protocol):
    """A source of worlds: `TaskWorlds`, or your own. The same seed gives the same world and the same future."""

    rules: Ruleset
    """The rules, with all elements of the worlds."""

    size: tuple[int, int]
    """Rows and columns."""

    def start(self, seeds: Tensor) -> Any:
        """The worlds of seeds, int64 [B], such as a `World`: its `ids` are the elements, uint8 [B, H, W]."""

    def later(self, world: Any, steps: int) -> Any:
        """The worlds some steps later; `world` does not change."""


class MixedPart(NamedTuple):
    """Worlds of one structure: their numbers in the batch, and their chances, float64 [worlds] by parameter."""

    world: World
    numbers: Tensor
    params: Mapping[str, Tensor]


@dataclass(frozen=True)
class MixedWorld:
    """A batch of worlds of several rulesets."""

    parts: tuple[MixedPart, ...]

    @property
    def ids(self) -> Tensor:
        """Element ids, uint8 [B, H, W]."""
        if len(self.parts) == 1:
            return self.parts[0].world.ids
        order = torch.cat([part.numbers for part in self.parts]).argsort()
        return torch.cat([part.world.ids for part in self.parts])[order]


class TaskWorlds:
    """The worlds of a configuration, ready to run: those of a task's split under some rules.

    World s runs under ruleset s mod the number of `rulesets`. Rulesets of one structure are compiled once and run
    together; their chances are parameters of each world.

    Args:
        partly: leave out worlds that the rules cannot have; `missing` says which.
        palette: the ids of a network's slots, as `compiler.load` takes them.
        machine: backend, device and threads, as `compile_task` takes them.

    Raises:
        CompileError: with all that is wrong in the task, the rules, the knobs or the parameters; PD604 where worlds need
            elements that the rules do not have; PD701 for a backend or device that is not there.
    """

    def __init__(
        self,
        config: DataConfig,
        *,
        partly: bool = False,
        palette: Palette | None = None,
        **machine: Any,
    ):
        params = None if config.rules else config.params
        task = load_task(config.task, knobs=config.knobs, params=params, palette=palette)
        source = None
        if config.rulesets:
            source = RulesetSource(config.rules or task.rules, config.variety, config.params, palette)
            rules = source.base
        elif config.rules:
            rules = load(config.rules, params=config.params, palette=palette)
        else:
            rules = task.ruleset
        check_data(config, task, rules)
        watched, self.missing = watch(task, config.split, rules, config.only, partly=partly)
        self.config, self.rules, self.size = config, rules, task.size
        self.names = tuple(variant.name for variant in watched.splits[0].variants)
        """The names of the variants: seed s gives variant s mod their number."""
        self.fingerprint = fingerprint(watched.splits)
        """A name for how these worlds start, besides their rules: another if the task's file has been changed."""
        self.device = torch.device(machine.get("device", "cpu"))
        """Where worlds are run."""
        self._task, self._source = task, source
        self._machine = machine
        self._programs: dict[tuple[Any, ...], TaskProgram] = {}
        if source is None:
            self.rulesets = [Drawn(0)]
            self._programs[self.rulesets[0].structure] = self._compiled(watched)
            return
        numbers = range(config.first_ruleset, config.first_ruleset + config.rulesets)
        self.rulesets = [source.draw(number) for number in numbers]
        if (
            machine.get("backend", "auto") == "auto"
        ):  # compiling many rulesets would take longer than running them
            self._machine = {**machine, "backend": starting_backend(str(self.device))}

    def start(self, seeds: Tensor) -> MixedWorld:
        """The worlds of seeds, int64 [B]."""
        groups: dict[tuple[Any, ...], list[int]] = {}
        rulesets = [self.rulesets[seed % len(self.rulesets)] for seed in seeds.tolist()]
        for number, drawn in enumerate(rulesets):
            groups.setdefault(drawn.structure, []).append(number)
        parts = []
        for members in groups.values():
            numbers = torch.tensor(members, device=seeds.device)
            world = self._program(rulesets[members[0]]).start(seeds[numbers]).world
            chances = [dict(rulesets[member].params) for member in members]
            params = {
                name: torch.tensor([own[name] for own in chances], dtype=torch.float64, device=seeds.device)
                for name in chances[0]
            }
            parts.append(MixedPart(world, numbers, params))
        return MixedWorld(tuple(parts))

    def later(self, world: MixedWorld, steps: int) -> MixedWorld:
        """The worlds some steps later."""
        later = [
            part._replace(world=part.world.sim.step(part.world, steps, params=part.params or None))
            for part in world.parts
        ]
        return MixedWorld(tuple(later))

    def _program(self, drawn: Drawn) -> TaskProgram:
        if drawn.structure not in self._programs:
            assert self._source is not None
            # Rules without some packs draw from the remaining elements; worlds that need others are replaced.
            rules = self._source.model(drawn)
            task, _ = watch(self._task, self.config.split, rules, self.config.only, partly=True)
            self._programs[drawn.structure] = self._compiled(task)
        return self._programs[drawn.structure]

    def _compiled(self, task: Task) -> TaskProgram:
        return compile_task(task, split=self.config.split, **self._machine)


task_worlds = TaskWorlds
"""The function that makes them."""


def check_data(config: DataConfig, task: Task, rules: Ruleset) -> None:
    """Raise CompileError if a task lacks a configuration's split, or rules its packs or properties."""
    check_split(task, config.split)
    for pack in config.only:
        if pack not in rules.packs:
            helps = suggest(pack, rules.packs, "packs")
            raise failure("PD304", f"the rules {rules.name} have no pack `{pack}`", helps=helps)
    check_properties(rules, config.variety.swaps)


# Pairs


def pairs_of(worlds: Worlds, seeds: Tensor, steps: int, pairs: int) -> Iterator[Pairs]:
    """The pairs of some worlds in the order of time: `pairs` batches of one pair per world."""
    world = worlds.start(seeds)
    for _ in range(pairs):
        start = world.ids
        world = worlds.later(world, steps)
        yield start, world.ids


def validation_pairs(worlds: Worlds, config: DataConfig, device: str | torch.device = "cpu") -> list[Pairs]:
    """Pairs of worlds that neither training nor tests use: one of each world, at times that take turns."""
    number = torch.arange(VALIDATION_WORLDS, device=device)
    chosen = []
    pairs = pairs_of(worlds, VALIDATION_SEEDS + number, config.steps, config.pairs)
    for moment, (starts, ends) in enumerate(pairs):
        mask = (number % config.pairs == moment).to(starts.device)
        if mask.any():
            chosen.append((starts[mask], ends[mask]))
    return chosen


def unseen_seeds(count: int, variants: int = 1) -> Tensor:
    """Seeds that training never uses, int64 [count·variants]: `count` of each variant, all of a variant together."""
    first = -(-TEST_SEEDS // variants) * variants
    grid = torch.arange(count)[None, :] * variants + torch.arange(variants)[:, None]
    return (first + grid).flatten()


# A task without an agent, under other rules


class Missing(NamedTuple):
    """A variant that rules cannot have: the names of elements that they lack, and where the first one is drawn."""

    name: str
    elements: tuple[str, ...]
    span: Span | None


def watch(
    task: Task, split: str, rules: Ruleset, only: Collection[str] = (), *, partly: bool = False
) -> tuple[Task, tuple[Missing, ...]]:
    """The worlds of a split under other rules, as a task of that split alone; and those that the rules cannot have.

    Elements are found by qualified name. A statement that draws one of several draws among those that the rules have,
    and also among the elements of packs that the task does not know; of these among the elements of the packs `only`,
    if any of them has elements. An element that is named alone must be there.

    Args:
        partly: leave out variants that the rules cannot have, as long as one remains.

    Raises:
        CompileError: PD604 if worlds need elements that the rules do not have.
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
    watched = Split(original.name, original.about, tuple(variants))
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
        self.added = tuple(
            element.id
            for element in rules.elements
            if element.pack not in own.packs and element.pack in chosen
        )
        self.missing: list[str] = []
        self.span: Span | None = None

    def generator(self, generator: Generator) -> Generator:
        drawn = {drawing.stamp for group in generator.groups for drawing in group.drawings}
        return replace(
            generator,
            fill=self.id(generator.fill),
            groups=tuple(
                replace(group, drawings=tuple(map(self.drawing, group.drawings)))
                for group in generator.groups
            ),
            stamps=tuple(self.stamp(stamp) for stamp in generator.stamps if stamp.name in drawn),
            targets=(),
        )

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
    under = f"{rules.name} with {', '.join(sorted(only))} alone" if only else rules.name
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
