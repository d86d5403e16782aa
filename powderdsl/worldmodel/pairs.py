"""Pairs of a world and itself some steps later, simulated by the compiled rules."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from powderdsl.compiler import load
from powderdsl.diagnostics import suggest
from powderdsl.model.composition.palette import Palette
from powderdsl.model.types import Ruleset
from powderdsl.simulation.simulator import World
from powderdsl.system.settings import check_bounds, setting
from powderdsl.system.writing import failure
from powderdsl.tasks.episodes import TaskProgram, compile_task
from powderdsl.tasks.shipped import check_split, load_task
from powderdsl.worldmodel.rulesets import MAX_RULESETS, RulesetSource, VariedWorlds, Variety
from powderdsl.worldmodel.watched import SplitWorlds, Watched, watched

TEST_SEEDS = 1 << 32
"""The first seed of worlds that models are tested on. Training takes seeds below it."""

VALIDATION_SEEDS = 1 << 33
"""The first seed of worlds that models are validated on during training: far beyond those of tests."""

VALIDATION_WORLDS = 64
"""The worlds that models are validated on, each at one time."""

Pairs = tuple[Tensor, Tensor]
"""Start and end, element ids uint8 [B, H, W] each."""


@dataclass(frozen=True)
class DataConfig:
    """Which pairs a network learns from. Plain values: ``dataclasses.asdict`` gives what a run's file keeps.

    The worlds are those of seeds 0 to `states` − 1. Each is run for `steps`·`pairs` steps and gives `pairs` pairs: the
    paper's 16 of 8 steps. `only` names packs: worlds draw no other pack's elements. The replay buffer holds `capacity`
    pairs, of which each iteration replaces `refresh`; if all pairs of all worlds fit in, it holds these and stays so.
    """

    task: str = "world-model"
    split: str = "train"
    rules: str = ""
    """As everywhere: a shipped ruleset, packs joined by ``+``, left out behind ``-``. Empty: the task's own."""
    only: tuple[str, ...] = ()
    knobs: Mapping[str, int] = field(default_factory=dict)
    params: Mapping[str, float | str] = field(default_factory=dict)
    states: int = setting(1_000_000, low=1)
    steps: int = setting(8, low=1)
    pairs: int = setting(16, low=1)
    rulesets: int = setting(0, low=0, high=MAX_RULESETS)
    """How many rulesets are drawn around `rules`; world s runs under number `first_ruleset` + s mod `rulesets`. 0: none."""
    first_ruleset: int = setting(0, low=0)
    variety: Variety = field(default_factory=Variety)
    """The differences between the rulesets."""
    capacity: int = setting(1024 * 256, low=1)
    refresh: int = setting(256, low=1)

    def __post_init__(self) -> None:
        """Raises ValueError for values out of range."""
        check_bounds(self)
        if self.states > TEST_SEEDS:
            raise ValueError(f"states must be at most {TEST_SEEDS:,}: tests begin there")

    @staticmethod
    def of(values: Mapping[str, Any]) -> DataConfig:
        """The configuration in a run's JSON. Raises TypeError, ValueError."""
        variety = Variety.of(values.get("variety", {}))
        return DataConfig(**{**values, "only": tuple(values.get("only", ())), "variety": variety})


class HasIds(Protocol):
    """A batch of worlds, for instance `World`."""

    @property
    def ids(self) -> Tensor:
        """Element ids, uint8 [B, H, W]."""


class Worlds(Protocol):
    """A source of worlds: `TaskWorlds`, or your own. The same seed gives the same world and the same future."""

    rules: Ruleset
    """The rules, with all elements of the worlds."""

    size: tuple[int, int]
    """Rows and columns."""

    def start(self, seeds: Tensor) -> Any:
        """The worlds of seeds, int64 [B], as a `HasIds`."""

    def later(self, world: Any, steps: int) -> Any:
        """The worlds some steps later; `world` does not change."""


class TaskWorlds(SplitWorlds):
    """The worlds of a task's split under some rules. Made by `task_worlds`."""

    def __init__(self, program: TaskProgram, found: Watched):
        super().__init__(found, program.simulator.device)
        self.program = program

    def start(self, seeds: Tensor) -> World:
        """The worlds of seeds, int64 [B]."""
        return self.program.start(seeds).world

    def later(self, world: World, steps: int) -> World:
        """The worlds some steps later."""
        return self.program.simulator.step(world, steps)


def task_worlds(
    config: DataConfig,
    *,
    device: str = "cpu",
    threads: int = 1,
    backend: str = "auto",
    partly: bool = False,
    palette: Palette | None = None,
) -> TaskWorlds | VariedWorlds:
    """The worlds of a configuration, ready to run.

    Args:
        partly: leave out worlds that the rules cannot have; `TaskWorlds.found.missing` says which.
        palette: the ids of a network's slots, as `compiler.load` takes them.

    Raises:
        CompileError: with all that is wrong in the task, the rules, the knobs or the parameters; PD604 where worlds need
            elements that the rules do not have; PD701 for a backend or device that is not there.
    """
    own = not config.rules
    task = load_task(config.task, knobs=config.knobs, params=config.params if own else None, palette=palette)
    check_split(task, config.split)
    rules = task.ruleset if own else load(config.rules, params=config.params, palette=palette)
    for pack in config.only:
        if pack not in rules.packs:
            helps = tuple(suggest(pack, rules.packs, "packs"))
            raise failure("PD304", f"the rules {rules.name} have no pack `{pack}`", helps=helps)
    machine: dict[str, Any] = {"backend": backend, "device": device, "threads": threads}
    if config.rulesets:
        source = RulesetSource(config.rules or task.rules, config.variety, config.params, palette)
        first, only = config.first_ruleset, config.only
        return VariedWorlds(task, config.split, source, config.rulesets, first=first, only=only, **machine)
    found = watched(task, config.split, rules, config.only, partly=partly)
    return TaskWorlds(compile_task(found.task, split=config.split, **machine), found)


def pairs_of(worlds: Worlds, seeds: Tensor, steps: int, pairs: int) -> Iterator[Pairs]:
    """The pairs of some worlds in the order of time: `pairs` batches of one pair per world."""
    world: HasIds = worlds.start(seeds)
    for _ in range(pairs):
        start = world.ids
        world = worlds.later(world, steps)
        yield start, world.ids


def validation_pairs(worlds: Worlds, config: DataConfig, device: str | torch.device = "cpu") -> list[Pairs]:
    """Pairs of worlds that neither training nor tests use: one of each world, at times that take turns."""
    number = torch.arange(VALIDATION_WORLDS, device=device)
    found = pairs_of(worlds, VALIDATION_SEEDS + number, config.steps, config.pairs)
    kept = [(number % config.pairs == moment, pair) for moment, pair in enumerate(found)]
    return [tuple(ids[mask.to(ids.device)] for ids in pair) for mask, pair in kept if mask.any()]  # type: ignore[misc]


def unseen_seeds(count: int, variants: int = 1) -> Tensor:
    """Seeds that training never uses, int64 [count·variants]: `count` of each variant, all of a variant together."""
    first = -(-TEST_SEEDS // variants) * variants
    grid = torch.arange(count)[None, :] * variants + torch.arange(variants)[:, None]
    return (first + grid).flatten()
